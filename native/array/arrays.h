// NumPy arrays in and out of the kernels.
//
// Fresh arrays come from the NumPy C-API (about 0.1 us; nanobind's ndarray takes 0.4 us). Arguments
// are checked here, once, and every refusal is an armlab.errors.ShapeError: a sentence with what
// was expected, what came and what to do.
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
#include <limits>
#include <string>
#include <string_view>

#include "array/batch.h"

namespace nb = nanobind;

namespace armlab {

using nb::arg;

[[noreturn]] void raise_shape_error(const std::string &sentence);

class Input;

// Refuse numbers that are not finite, or not above zero, or below it.
void require_finite(const Input &input);
void require_positive(const char *name, const double *values, npy_intp count);
void require_not_negative(const char *name, const double *values, npy_intp count);

// The argument `threads`: an integer from 1 to max_threads, otherwise an armlab.errors.ConfigError.
int thread_count(nb::handle threads);

// An argument that is an array; None passes nanobind, to be refused in the words of `Input`.
inline auto array(const char *name) { return nb::arg(name).none(); }

// name[i, j]: sample `number` of a batch of `axes` axes; the name alone without a batch.
std::string place(const std::string &name, npy_intp number, const npy_intp *shape, int axes);

inline PyArrayObject *as_array(nb::handle array) {
  return reinterpret_cast<PyArrayObject *>(array.ptr());
}

// A fresh array; with the values of `data` when that is given.
nb::object fresh_of_type(int type, int ndim, const npy_intp *shape);
nb::object fresh_array(int ndim, const npy_intp *shape, const double *data = nullptr);
inline nb::object fresh_array(std::initializer_list<npy_intp> shape, const double *data = nullptr) {
  return fresh_array(static_cast<int>(shape.size()), shape.begin(), data);
}
nb::object fresh_mask(int n, const bool *values);

// The memory of a fresh array.
template <class Number = double>
Number *numbers(const nb::object &array) {
  return static_cast<Number *>(PyArray_DATA(as_array(array)));
}

// A C-contiguous float64 array for reading: the argument itself if it is one, else a copy.
class Input {
 public:
  Input(nb::handle value, const char *name);
  Input(nb::handle value, const char *name, std::initializer_list<npy_intp> shape)
      : Input(value, name) {
    require_exactly(shape);
  }

  const char *name() const { return name_; }
  const nb::object &object() const { return array_; }
  const double *data() const { return static_cast<const double *>(PyArray_DATA(array())); }
  int ndim() const { return PyArray_NDIM(array()); }
  const npy_intp *shape() const { return PyArray_DIMS(array()); }
  npy_intp size() const { return PyArray_SIZE(array()); }
  std::string shape_text() const;

  void require_exactly(std::initializer_list<npy_intp> shape) const;
  void require_last_axis(npy_intp n) const;
  void require_shape_of(const Input &other) const;
  void require_tail(std::initializer_list<npy_intp> tail) const;

 protected:
  PyArrayObject *array() const { return as_array(array_); }

  nb::object array_;
  const char *name_;
};

// Samples (n,), given as (..., n); the leading axes are the batch, which every output keeps.
struct Samples : Input {
  Samples(nb::handle value, const char *name, int n) : Samples(value, name, 1, n) {
    require_last_axis(n);
  }
  Samples(nb::handle value, const char *name, const Samples &same)
      : Samples(value, name, 1, same.width_) {
    require_shape_of(same);
  }

  int batch_axes() const { return ndim() - tail_axes_; }
  Reading samples() const { return {data(), width_}; }

 protected:
  Samples(nb::handle value, const char *name, int tail_axes, int width)
      : Input(value, name), tail_axes_(tail_axes), width_(width) {}

  int tail_axes_;
  int width_;
};

// Samples of any shape, given as (..., tail).
struct Elements : Samples {
  Elements(nb::handle value, const char *name, std::initializer_list<npy_intp> tail);

  // Gives all of them the same leading axes, by the rules of NumPy.
  static void broadcast(std::initializer_list<Elements *> elements);
};

// An array of shape batch + tail to write into: `out` when given (float64, C-contiguous, writable,
// apart from the inputs), a fresh one when `out` is None.
class Output {
 public:
  Output(nb::handle out, const char *name, std::initializer_list<npy_intp> tail,
      std::initializer_list<const Samples *> inputs);

  // The inputs that are no samples, and the other outputs.
  void require_apart_from(std::initializer_list<const Input *> inputs) const;
  void require_apart_from(const Output &other) const;

  const nb::object &array() const { return array_; }
  Writing samples() const {
    return {static_cast<double *>(PyArray_DATA(pointer())), width_, streams_};
  }

 private:
  PyArrayObject *pointer() const { return as_array(array_); }

  nb::object array_;
  const char *name_;
  int width_;
  bool streams_ = false;
};

// Runs a kernel over all samples of `first`, without the GIL when that pays, in `threads` threads
// when each gets enough to pay for its start. The parts are several per thread, for when one is
// held up, but large: threads that write into one page of fresh memory both have to clear it.
template <std::size_t Ins, std::size_t Outs, class Kernel>
void compute(const Samples &first, const std::array<Reading, Ins> &ins,
    const std::array<Writing, Outs> &outs, Kernel kernel, int threads = 1) {
  const std::ptrdiff_t count = first.size() / first.samples().width;
  if (count < 32) return run_batch(count, ins, outs, kernel);
  nb::gil_scoped_release released;
  const std::ptrdiff_t grain = std::max<std::ptrdiff_t>(4096, count / (8 * threads));
  const auto from = [](auto views, std::ptrdiff_t begin) {
    for (auto &view : views) view.data += begin * view.width;
    return views;
  };
  run_parallel(count, grain, threads, [&](std::ptrdiff_t begin, std::ptrdiff_t end) {
    run_batch(end - begin, from(ins, begin), from(outs, begin), kernel);
  });
}

// Each topic binds its own kernels: bind_chain(m), ...
// clang-format off: a table
#define ARMLAB_TOPICS(DO) \
  DO(chain) DO(datagrams) DO(drive) DO(egm) DO(estimator) DO(inverse) DO(lie) DO(limits) \
  DO(messages) DO(obstacles) DO(primitive) DO(row_encoder) DO(row_packer) DO(signals) DO(two_dof)
// clang-format on
namespace python {
#define ARMLAB_BINDS(topic) void bind_##topic(nb::module_ &m);
ARMLAB_TOPICS(ARMLAB_BINDS)
}  // namespace python

}  // namespace armlab
