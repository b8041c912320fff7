#include "array/arrays.h"

#include <functional>
#include <numeric>

namespace armlab {
namespace {

std::string shape_text(const npy_intp *shape, int ndim) {
  std::string text = "(";
  for (int i = 0; i < ndim; ++i) text += (i ? ", " : "") + std::to_string(shape[i]);
  return text + (ndim == 1 ? ",)" : ")");
}

bool is_plain(PyObject *value, int flags) {
  if (!PyArray_CheckExact(value)) return false;
  PyArrayObject *array = as_array(value);
  return PyArray_TYPE(array) == NPY_DOUBLE && PyArray_CHKFLAGS(array, flags) &&
         PyArray_ISNOTSWAPPED(array);
}

bool overlap(PyArrayObject *out, const double *data, npy_intp size) {
  const double *a = static_cast<const double *>(PyArray_DATA(out));
  return a < data + size && data < a + PyArray_SIZE(out);
}

int width_of(const Tail &tail) {
  return static_cast<int>(
      std::accumulate(tail.shape, tail.shape + tail.axes, npy_intp{1}, std::multiplies<>()));
}

}  // namespace

void raise(const char *error, const std::string &sentence) {
  nb::object type = nb::module_::import_("armlab.errors").attr(error);
  PyErr_SetString(type.ptr(), sentence.c_str());
  throw nb::python_error();
}

void raise_shape_error(const std::string &sentence) { raise("ShapeError", sentence); }

std::string place(const std::string &name, npy_intp number, const npy_intp *shape, int axes) {
  if (axes == 0) return name;
  std::string text;
  for (int k = axes - 1; k >= 0; number /= shape[k--])
    text = std::to_string(number % shape[k]) + (text.empty() ? "" : ", ") + text;
  return name + "[" + text + "]";
}

void require_finite(const Input &input) {
  for (npy_intp i = 0; i < input.size(); ++i)
    if (!std::isfinite(input.data()[i]))
      raise_shape_error(std::string("Expected finite ") + input.name() +
                        ", got NaN or Inf at number " + std::to_string(i) + ". Correct it.");
}

static void require_finite_from(
    const char *name, const double *values, npy_intp count, bool zero, const char *range) {
  for (npy_intp i = 0; i < count; ++i)
    if (!((zero ? values[i] >= 0.0 : values[i] > 0.0) && std::isfinite(values[i])))
      raise_shape_error(std::string("Expected finite ") + name + range +
                        ", got an invalid value at number " + std::to_string(i) + ". Correct it.");
}

void require_positive(const char *name, const double *values, npy_intp count) {
  require_finite_from(name, values, count, false, " above zero");
}

void require_not_negative(const char *name, const double *values, npy_intp count) {
  require_finite_from(name, values, count, true, " not below zero");
}

int thread_count(nb::handle threads) {
  const bool counts = PyIndex_Check(threads.ptr()) && !PyBool_Check(threads.ptr());
  const Py_ssize_t count = counts ? PyNumber_AsSsize_t(threads.ptr(), nullptr) : 0;
  if (count >= 1 && count <= max_threads) return static_cast<int>(count);
  PyErr_Clear();
  raise("ConfigError", "Expected threads to be an integer from 1 to " +
                           std::to_string(max_threads) + ", got " + nb::repr(threads).c_str() +
                           ".");
}

nb::object fresh_of_type(int type, int ndim, const npy_intp *shape) {
  nb::object array = nb::steal(PyArray_SimpleNew(ndim, shape, type));
  if (!array.is_valid()) throw nb::python_error();
  return array;
}

nb::object fresh_array(int ndim, const npy_intp *shape, const double *data) {
  nb::object array = fresh_of_type(NPY_DOUBLE, ndim, shape);
  if (data) std::copy_n(data, PyArray_SIZE(as_array(array)), numbers(array));
  return array;
}

nb::object fresh_mask(int n, const bool *values) {
  const npy_intp size = n;
  nb::object array = fresh_of_type(NPY_BOOL, 1, &size);
  std::copy_n(values, n, numbers<npy_bool>(array));
  return array;
}

Input::Input(nb::handle value, const char *name) : name_(name) {
  if (is_plain(value.ptr(), NPY_ARRAY_CARRAY_RO)) {
    array_ = nb::borrow(value);
    return;
  }
  // Convert without a dtype first: NumPy would read None as NaN and strings of digits as numbers.
  nb::object any = nb::steal(PyArray_FromAny(value.ptr(), nullptr, 0, 0, 0, nullptr));
  PyObject *converted = nullptr;
  if (any && PyArray_CanCastSafely(PyArray_TYPE(as_array(any)), NPY_DOUBLE))
    converted = PyArray_FromAny(any.ptr(), PyArray_DescrFromType(NPY_DOUBLE), 0, 0,
        NPY_ARRAY_CARRAY_RO | NPY_ARRAY_NOTSWAPPED, nullptr);
  if (!converted) {
    if (PyErr_Occurred() && !PyErr_ExceptionMatches(PyExc_TypeError) &&
        !PyErr_ExceptionMatches(PyExc_ValueError))
      throw nb::python_error();
    PyErr_Clear();
    raise_shape_error(std::string("Expected ") + name + " to be an array of real numbers, got " +
                      Py_TYPE(value.ptr())->tp_name +
                      " that does not convert to float64. Pass a NumPy array or nested "
                      "lists of equal length.");
  }
  array_ = nb::steal(converted);
}

std::string Input::shape_text() const { return armlab::shape_text(shape(), ndim()); }

void Input::require_exactly(std::initializer_list<npy_intp> wanted) const {
  const int n = static_cast<int>(wanted.size());
  if (ndim() == n && std::equal(wanted.begin(), wanted.end(), shape())) return;
  raise_shape_error(std::string("Expected ") + name_ + " of shape " +
                    armlab::shape_text(wanted.begin(), n) + ", got " + shape_text() + ".");
}

void Input::require_tail(std::initializer_list<npy_intp> tail) const {
  const int n = static_cast<int>(tail.size());
  if (ndim() >= n && std::equal(tail.begin(), tail.end(), shape() + ndim() - n)) return;
  std::string wanted = "(...";
  for (npy_intp length : tail) wanted += ", " + std::to_string(length);
  raise_shape_error(
      std::string("Expected ") + name_ + " of shape " + wanted + "), got " + shape_text() + ".");
}

Samples::Samples(nb::handle value, const char *name, std::initializer_list<npy_intp> tail)
    : Input(value, name), tail_axes_(static_cast<int>(tail.size())), width_(width_of(tail)) {
  require_tail(tail);
}

void Samples::broadcast(std::initializer_list<Samples *> elements) {
  npy_intp shape[NPY_MAXDIMS + 2];
  const Samples &first = **elements.begin();
  int axes = 0;
  bool equal = true;
  for (const Samples *element : elements) {
    equal &= element->batch_axes() == first.batch_axes() &&
             std::equal(first.shape(), first.shape() + first.batch_axes(), element->shape());
    axes = std::max(axes, element->batch_axes());
  }
  if (equal) return;
  std::fill(shape, shape + axes, npy_intp{1});
  std::string sentence = "Expected leading axes that broadcast, got ";
  bool fits = true;
  for (const Samples *element : elements) {
    sentence += (element == &first ? "" : ", ") + std::string(element->name()) + " of shape " +
                element->shape_text();
    for (int i = 1; i <= element->batch_axes(); ++i) {
      const npy_intp length = element->shape()[element->batch_axes() - i];
      npy_intp &wanted = shape[axes - i];
      if (wanted == 1) wanted = length;
      fits &= length == 1 || length == wanted;
    }
  }
  if (!fits) raise_shape_error(sentence + ".");
  const nb::object broadcast_to = nb::module_::import_("numpy").attr("broadcast_to");
  for (Samples *element : elements) {
    nb::list wanted;
    for (int i = 0; i < axes; ++i) wanted.append(shape[i]);
    for (int i = element->batch_axes(); i < element->ndim(); ++i)
      wanted.append(element->shape()[i]);
    static_cast<Input &>(*element) =
        Input(broadcast_to(element->array_, nb::tuple(wanted)), element->name_);
  }
}

nb::handle part_of(nb::handle out, std::size_t k, std::size_t count) {
  if (count == 1 || out.is_none()) return out;
  if (!PyTuple_Check(out.ptr()) || PyTuple_GET_SIZE(out.ptr()) != static_cast<npy_intp>(count))
    raise_shape_error("Expected out to be a tuple of " + std::to_string(count) +
                      " arrays, one for each result, got a different type or length.");
  return PyTuple_GET_ITEM(out.ptr(), k);
}

Output::Output(nb::handle out, const char *name, const Tail &tail,
    std::initializer_list<const Samples *> inputs)
    : name_(name) {
  const Samples &first = **inputs.begin();
  const int batch = first.batch_axes(), ndim = batch + tail.axes;
  npy_intp shape[NPY_MAXDIMS + 2];
  std::copy_n(tail.shape, tail.axes, std::copy(first.shape(), first.shape() + batch, shape));
  width_ = width_of(tail);
  if (out.is_none()) {
    array_ = fresh_array(ndim, shape);
    return;
  }
  const auto refuse = [&](const std::string &what_came) {
    raise_shape_error(std::string("Expected ") + name +
                      " to be a writable C-contiguous float64 array of shape " +
                      shape_text(shape, ndim) + ", got " + what_came +
                      ". Create it with numpy.empty, or omit it.");
  };
  if (!is_plain(out.ptr(), NPY_ARRAY_CARRAY)) refuse("a different object");
  array_ = nb::borrow(out);
  if (PyArray_NDIM(pointer()) != ndim || !std::equal(shape, shape + ndim, PyArray_DIMS(pointer())))
    refuse("shape " + shape_text(PyArray_DIMS(pointer()), PyArray_NDIM(pointer())));
  for (const Samples *input : inputs)
    if (overlap(pointer(), input->data(), input->size()))
      refuse(std::string("an array that shares memory with ") + input->name());
  // Streaming stores halve the time for outputs too large for the caches, such as a million
  // Jacobians. They do not help with fresh memory, because the system has just cleared its pages,
  // which are still in a cache.
  const auto address = reinterpret_cast<std::uintptr_t>(PyArray_DATA(pointer()));
  streams_ = PyArray_NBYTES(pointer()) >= 16'000'000 && width_ % 2 == 0 && address % 16 == 0;
}

void Output::require_apart_from(std::initializer_list<const Input *> inputs) const {
  for (const Input *input : inputs)
    if (overlap(pointer(), input->data(), input->size()))
      raise_shape_error(std::string("Expected ") + name_ + " not to share memory with " +
                        input->name() +
                        ", got overlapping arrays. Create it with numpy.empty, or omit it.");
}

void Output::require_apart_from(const Output &other) const {
  if (overlap(pointer(), numbers(other.array_), PyArray_SIZE(other.pointer())))
    raise_shape_error(std::string("Expected ") + name_ + " and " + other.name_ +
                      " not to share memory, got overlapping arrays. Create each with numpy.empty, "
                      "or omit them.");
}

}  // namespace armlab
