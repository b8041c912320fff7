// Conversion between NumPy arrays and kernel arguments.
//
// The NumPy C-API creates arrays in about 0.1 us (nanobind's ndarray takes 0.4 us). Arguments are
// validated only here. Errors are one-sentence armlab.errors.ShapeError: expected, got, advice.
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
#include <optional>
#include <string>
#include <string_view>
#include <tuple>

#include "array/batch.h"

namespace nb = nanobind;

namespace armlab {

using nb::arg;

[[noreturn]] void raise(const char *error, const std::string &sentence);  // class in armlab.errors
[[noreturn]] void raise_shape_error(const std::string &sentence);

class Input;

// Reject numbers that are not finite; the second and third also reject numbers <= 0 and < 0,
// respectively.
void require_finite(const Input &input);
void require_positive(const char *name, const double *values, npy_intp count);
void require_not_negative(const char *name, const double *values, npy_intp count);

// The argument `threads`: an integer from 1 to max_threads, otherwise armlab.errors.ConfigError.
int thread_count(nb::handle threads);

// An array argument. nanobind accepts None, which `Input` then rejects.
inline auto array(const char *name) { return nb::arg(name).none(); }

// name[i, j] of sample `number` in a batch with `axes` axes; only the name if there is no batch.
std::string place(const std::string &name, npy_intp number, const npy_intp *shape, int axes);

inline PyArrayObject *as_array(nb::handle array) {
  return reinterpret_cast<PyArrayObject *>(array.ptr());
}

// A fresh array, initialised with `data` if given.
nb::object fresh_of_type(int type, int ndim, const npy_intp *shape);
nb::object fresh_array(int ndim, const npy_intp *shape, const double *data = nullptr);
inline nb::object fresh_array(std::initializer_list<npy_intp> shape, const double *data = nullptr) {
  return fresh_array(static_cast<int>(shape.size()), shape.begin(), data);
}
nb::object fresh_mask(int n, const bool *values);

// The data of a fresh array.
template <class Number = double>
Number *numbers(const nb::object &array) {
  return static_cast<Number *>(PyArray_DATA(as_array(array)));
}

// A C-contiguous float64 array for reading: the argument itself if possible, otherwise a copy.
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

  // Replaces the array with a copy, and returns the copy.
  const nb::object &copy() { return array_ = fresh_array(ndim(), shape(), data()); }

  void require_exactly(std::initializer_list<npy_intp> shape) const;
  void require_tail(std::initializer_list<npy_intp> tail) const;

 protected:
  PyArrayObject *array() const { return as_array(array_); }

  nb::object array_;
  const char *name_;
};

// Samples of shape (..., tail). The leading axes are the batch; outputs have the same batch axes.
struct Samples : Input {
  Samples(nb::handle value, const char *name, std::initializer_list<npy_intp> tail);

  int batch_axes() const { return ndim() - tail_axes_; }
  Reading samples() const { return {data(), width_}; }

  // Broadcasts the leading axes by the rules of NumPy.
  static void broadcast(std::initializer_list<Samples *> samples);

 private:
  int tail_axes_;
  int width_;
};

// The shape of a kernel result for one sample.
struct Tail {
  npy_intp shape[3];
  int axes;

  Tail() = default;
  Tail(std::initializer_list<npy_intp> lengths) : axes(static_cast<int>(lengths.size())) {
    std::copy(lengths.begin(), lengths.end(), shape);
  }
};

// An output array of shape batch + tail: `out` if given (float64, C-contiguous, writable, not
// overlapping the inputs), otherwise a new one.
class Output {
 public:
  Output(nb::handle out, const char *name, const Tail &tail,
      std::initializer_list<const Samples *> inputs);

  // Reject overlap with inputs that are not samples, and with other outputs.
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

// Runs a kernel over all samples of `first`. Releases the GIL and uses up to `threads` threads if
// the work is large enough. Several parts per thread balance the load; they are large, because
// threads that write to the same page of fresh memory both have to clear it.
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

// Array k of the tuple `out` of `count` arrays; None if `out` is None.
nb::handle part_of(nb::handle out, std::size_t k, std::size_t count);

// Runs kernel(in, out) over the samples of `given`, whose leading axes broadcast. Returns the array
// or tuple of arrays with shapes `tails` per sample. `fixed`: inputs that are not samples.
template <std::size_t Outs, class Kernel, class... Given>
nb::object over(nb::handle out, const std::array<Tail, Outs> &tails,
    std::initializer_list<const Input *> fixed, int threads, const Kernel &kernel,
    Given &&...given) {
  static const char *const names[] = {"out[0]", "out[1]", "out[2]"};
  Samples::broadcast({&given...});
  std::array<std::optional<Output>, Outs> outs;
  std::array<Writing, Outs> to;
  for (std::size_t k = 0; k < Outs; ++k) {
    const char *name = Outs == 1 ? "out" : names[k];
    const Output &own = outs[k].emplace(
        part_of(out, k, Outs), name, tails[k], std::initializer_list<const Samples *>{&given...});
    own.require_apart_from(fixed);
    for (std::size_t j = 0; j < k; ++j) own.require_apart_from(*outs[j]);
    to[k] = own.samples();
  }
  compute<sizeof...(Given), Outs>(
      std::get<0>(std::tie(given...)), {given.samples()...}, to, kernel, threads);
  if constexpr (Outs == 1) return outs[0]->array();
  if constexpr (Outs == 2) return nb::make_tuple(outs[0]->array(), outs[1]->array());
  if constexpr (Outs == 3)
    return nb::make_tuple(outs[0]->array(), outs[1]->array(), outs[2]->array());
}

// Each topic binds its own kernels: bind_chain(m), ...
// clang-format off: table
#define ARMLAB_TOPICS(DO) \
  DO(chain) DO(datagrams) DO(drive) DO(egm) DO(estimator) DO(inverse) DO(lie) DO(limits) \
  DO(messages) DO(obstacles) DO(primitive) DO(rigid_body) DO(row_encoder) DO(row_packer) \
  DO(signals) DO(two_dof)
// clang-format on
namespace python {
#define ARMLAB_BINDS(topic) void bind_##topic(nb::module_ &m);
ARMLAB_TOPICS(ARMLAB_BINDS)
}  // namespace python

}  // namespace armlab
