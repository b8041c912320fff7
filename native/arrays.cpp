#include "arrays.h"

#include <algorithm>

namespace armlab {
namespace {

std::string shape_text(const npy_intp *shape, int ndim, const char *prefix = "") {
  std::string text = "(";
  text += prefix;
  for (int i = 0; i < ndim; ++i) {
    if (i || *prefix) text += ", ";
    text += std::to_string(shape[i]);
  }
  return text + (ndim == 1 && !*prefix ? ",)" : ")");
}

bool is_plain(PyObject *value, int flags) {
  if (!PyArray_CheckExact(value)) return false;
  auto *array = reinterpret_cast<PyArrayObject *>(value);
  return PyArray_TYPE(array) == NPY_DOUBLE && PyArray_CHKFLAGS(array, flags) && PyArray_ISNOTSWAPPED(array);
}

bool overlap(PyArrayObject *out, const Input &input) {
  const char *a = PyArray_BYTES(out), *b = reinterpret_cast<const char *>(input.data());
  return a < b + input.size() * sizeof(double) && b < a + PyArray_NBYTES(out);
}

}  // namespace

void raise_shape_error(const std::string &sentence) {
  nb::object type = nb::module_::import_("armlab.errors").attr("ShapeError");
  PyErr_SetString(type.ptr(), sentence.c_str());
  throw nb::python_error();
}

Input::Input(nb::handle value, const char *name) : name_(name) {
  if (is_plain(value.ptr(), NPY_ARRAY_CARRAY_RO)) {
    array_ = nb::borrow(value);
    return;
  }
  PyObject *converted = PyArray_FromAny(value.ptr(), PyArray_DescrFromType(NPY_DOUBLE), 0, 0,
                                        NPY_ARRAY_CARRAY_RO | NPY_ARRAY_NOTSWAPPED, nullptr);
  if (!converted) {
    if (!PyErr_ExceptionMatches(PyExc_TypeError) && !PyErr_ExceptionMatches(PyExc_ValueError)) throw nb::python_error();
    PyErr_Clear();
    raise_shape_error(std::string("Expected ") + name + " to be an array of real numbers, got " +
                      Py_TYPE(value.ptr())->tp_name + " that does not convert to float64. Give a NumPy array or nested "
                      "lists of equal length.");
  }
  array_ = nb::steal(converted);
}

void Input::require_tail(std::initializer_list<npy_intp> tail, bool exact) const {
  int n = static_cast<int>(tail.size());
  if (ndim() >= n && (!exact || ndim() == n) && std::equal(tail.begin(), tail.end(), shape() + ndim() - n)) return;
  raise_shape_error(std::string("Expected ") + name_ + " of shape " + shape_text(tail.begin(), n, exact ? "" : "...") +
                    ", got " + shape_text(shape(), ndim()) +
                    (exact ? "." : ". Put the joints on the last axis, batches before it."));
}

void Input::require_shape_of(const Input &other) const {
  if (ndim() == other.ndim() && std::equal(shape(), shape() + ndim(), other.shape())) return;
  raise_shape_error(std::string("Expected ") + name_ + " of the same shape as " + other.name_ + ", " +
                    shape_text(other.shape(), other.ndim()) + ", got " + shape_text(shape(), ndim()) +
                    ". Broadcast them first with numpy.broadcast_arrays.");
}

Batch::Batch(const Input &input, int tail_ndim) : ndim(input.ndim() - tail_ndim), count(1), dims(input.shape()) {
  for (int i = 0; i < ndim; ++i) count *= dims[i];
}

Output::Output(nb::handle out, const char *name, const Batch &batch, std::initializer_list<npy_intp> tail,
               std::initializer_list<const Input *> inputs) {
  npy_intp shape[NPY_MAXDIMS];
  const int ndim = batch.ndim + static_cast<int>(tail.size());
  if (ndim > NPY_MAXDIMS) raise_shape_error("Expected fewer leading axes: the result would have more than NumPy allows.");
  std::copy(tail.begin(), tail.end(), std::copy(batch.dims, batch.dims + batch.ndim, shape));
  if (out.is_none()) {
    PyObject *fresh = PyArray_SimpleNew(ndim, shape, NPY_DOUBLE);
    if (!fresh) throw nb::python_error();
    array_ = nb::steal(fresh);
    return;
  }
  const std::string wanted = std::string("Expected ") + name + " to be a writable C-contiguous float64 array of shape " +
                             shape_text(shape, ndim);
  if (!is_plain(out.ptr(), NPY_ARRAY_CARRAY))
    raise_shape_error(wanted + ", got an object that is not. Make it with numpy.empty, or leave it out.");
  auto *array = reinterpret_cast<PyArrayObject *>(out.ptr());
  if (PyArray_NDIM(array) != ndim || !std::equal(shape, shape + ndim, PyArray_DIMS(array)))
    raise_shape_error(wanted + ", got shape " + shape_text(PyArray_DIMS(array), PyArray_NDIM(array)) + ".");
  for (const Input *input : inputs)
    if (overlap(array, *input))
      raise_shape_error(wanted + " apart from the inputs, got one that shares memory with " + input->name() +
                        ". Give another array.");
  array_ = nb::borrow(out);
}

}  // namespace armlab
