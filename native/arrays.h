// NumPy arrays in and out of the kernels.
//
// Fresh arrays come from the NumPy C-API (about 0.1 us; nanobind's ndarray takes 0.4 us). Arguments are checked here, once,
// and every refusal is an armlab.errors.ShapeError: a sentence that says what was expected, what came and what to do.
#pragma once

#define PY_ARRAY_UNIQUE_SYMBOL armlab_numpy_api
#ifndef ARMLAB_IMPORTS_NUMPY
#define NO_IMPORT_ARRAY
#endif
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#define NPY_TARGET_VERSION NPY_2_0_API_VERSION

#include <nanobind/nanobind.h>
#include <numpy/arrayobject.h>

#include <initializer_list>
#include <string>

namespace nb = nanobind;

namespace armlab {

[[noreturn]] void raise_shape_error(const std::string &sentence);

// A C-contiguous float64 array for reading: the argument itself when it already is one, otherwise a converted copy.
class Input {
 public:
  Input(nb::handle value, const char *name);

  const double *data() const { return static_cast<const double *>(PyArray_DATA(array())); }
  int ndim() const { return PyArray_NDIM(array()); }
  const npy_intp *shape() const { return PyArray_DIMS(array()); }
  npy_intp size() const { return PyArray_SIZE(array()); }
  const char *name() const { return name_; }

  // Refuse a shape that does not end with `tail`; `exact` refuses leading axes too.
  void require_tail(std::initializer_list<npy_intp> tail, bool exact = false) const;
  void require_shape_of(const Input &other) const;

 private:
  PyArrayObject *array() const { return reinterpret_cast<PyArrayObject *>(array_.ptr()); }

  nb::object array_;
  const char *name_;
};

// The leading axes of an input, which every output keeps.
struct Batch {
  Batch(const Input &input, int tail_ndim);

  int ndim;
  npy_intp count;
  const npy_intp *dims;
};

// An array of shape batch + tail to write into: `out` when given (float64, C-contiguous, writable, apart from the inputs),
// a fresh one when `out` is None.
class Output {
 public:
  Output(nb::handle out, const char *name, const Batch &batch, std::initializer_list<npy_intp> tail,
         std::initializer_list<const Input *> inputs);

  double *data() const { return static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array_.ptr()))); }
  nb::object take() { return std::move(array_); }

 private:
  nb::object array_;
};

// Lets other Python threads run while a batch is computed; for a few samples the hand-over would cost more than the work.
class BatchWithoutGil {
 public:
  explicit BatchWithoutGil(npy_intp count) : state_(count >= 32 ? PyEval_SaveThread() : nullptr) {}
  ~BatchWithoutGil() {
    if (state_) PyEval_RestoreThread(state_);
  }
  BatchWithoutGil(const BatchWithoutGil &) = delete;
  BatchWithoutGil &operator=(const BatchWithoutGil &) = delete;

 private:
  PyThreadState *state_;
};

}  // namespace armlab
