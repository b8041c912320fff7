// Python class SignalOperator: checks arguments; mathematics in signals.cpp.
#include "array/arrays.h"
#include "math/motion/signals.h"

namespace armlab::python {
namespace {

const char *const kinds[] = {
    "trapezoid", "euler", "difference", "exponential", "lowpass", "slope", "notch"};

struct PySignalOperator {
  SignalOperator kernel;
  std::vector<npy_intp> shape;  // shape of one sample, once known
};

std::vector<double> values_of(nb::handle init) {
  if (init.is_none()) return {};
  const Input values(init, "init");
  for (npy_intp i = 0; i < values.size(); ++i)
    if (!std::isfinite(values.data()[i]))
      raise_shape_error("Expected a finite init, got NaN or Inf.");
  return {values.data(), values.data() + values.size()};
}

void construct(
    PySignalOperator *self, const char *kind, double a, double b, double dt, nb::handle init) {
  for (int i = 0; i < 7; ++i)
    if (kind == std::string(kinds[i])) {
      new (self) PySignalOperator{
          SignalOperator(static_cast<SignalKind>(i), a, b, dt, values_of(init)), {}};
      return;
    }
  raise_shape_error("Expected the name of a signal operator, got '" + std::string(kind) + "'.");
}

void check_shape(PySignalOperator &self, int ndim, const npy_intp *shape, npy_intp size,
    const std::string &text) {
  const std::vector<npy_intp> now(shape, shape + ndim);
  const std::size_t init = self.kernel.init().size();
  if (self.kernel.channels() ? now == self.shape
                             : init <= 1 || static_cast<npy_intp>(init) == size) {
    self.shape = now;
    return;
  }
  raise_shape_error("Expected samples with the shape of the first one and of init, got " + text +
                    ". Reset the operator before a different signal.");
}

void check_status(SignalStatus status, npy_intp row) {
  if (status == SignalStatus::ok) return;
  const char *const sentences[] = {
      "Expected a time stamp later than the last one, got an earlier or equal one. Drop repeated "
      "samples, or reset the operator for a new record",
      "Expected a time stamp with every sample, got none. Pass t, as with the first sample, or "
      "dt when creating the operator",
      "Expected no time stamps after a first sample without one, got one. Pass t with every "
      "sample or with none"};
  raise_shape_error(sentences[static_cast<int>(status) - 1] +
                    (row < 0 ? std::string() : ", in row " + std::to_string(row)) + ".");
}

nb::object step(PySignalOperator &self, nb::handle x_, nb::handle t_) {
  const Input x(x_, "x");
  if (self.kernel.channels() != static_cast<std::size_t>(x.size()) ||
      self.shape.size() != std::size_t(x.ndim()) ||
      !std::equal(self.shape.begin(), self.shape.end(), x.shape()))
    check_shape(self, x.ndim(), x.shape(), x.size(), x.shape_text());
  double t = 0.0;
  if (!t_.is_none()) {
    t = PyFloat_AsDouble(t_.ptr());
    if (t == -1.0 && PyErr_Occurred()) throw nb::python_error();
  }
  const nb::object out = fresh_array(x.ndim(), x.shape());
  double *data = numbers(out);
  check_status(self.kernel.step(x.size(), x.data(), t_.is_none() ? nullptr : &t, data), -1);
  return x.ndim() ? out : nb::steal(PyFloat_FromDouble(*data));
}

nb::object run(PySignalOperator &self, nb::handle x_, nb::handle t_) {
  const Input x(x_, "x");
  if (x.ndim() < 1)
    raise_shape_error(
        "Expected samples (N, ...) along axis 0, got a number. Use step for one sample.");
  const npy_intp N = x.shape()[0], size = N ? x.size() / N : 0;
  if (N) check_shape(self, x.ndim() - 1, x.shape() + 1, size, x.shape_text());
  const nb::object out = fresh_array(x.ndim(), x.shape());
  double *data = numbers(out);
  nb::object stamps;
  const double *t = nullptr;
  if (!t_.is_none()) {
    const Input given(t_, "t", {N});
    stamps = given.object();
    t = given.data();
  }
  SignalStatus status = SignalStatus::ok;
  npy_intp k = 0;
  {
    nb::gil_scoped_release released;
    for (; k < N; ++k) {
      status = self.kernel.step(size, x.data() + k * size, t ? t + k : nullptr, data + k * size);
      if (status != SignalStatus::ok) break;
    }
  }
  check_status(status, k);
  return out;
}

void reset(PySignalOperator &self, nb::handle init) {
  self.kernel.reset(init.is_none() ? self.kernel.init() : values_of(init));
}

nb::tuple state_of(const PySignalOperator &self) {
  const std::vector<double> memory = self.kernel.memory();
  const npy_intp count = static_cast<npy_intp>(memory.size());
  const nb::object numbers_ = fresh_array(1, &count);
  std::copy(memory.begin(), memory.end(), numbers(numbers_));
  nb::list shape;
  for (npy_intp entry : self.shape) shape.append(entry);
  return nb::make_tuple(numbers_, nb::tuple(shape));
}

void restore(PySignalOperator *self, const nb::tuple &state) {
  const Input memory(state[0], "state");
  std::vector<npy_intp> shape;
  for (nb::handle entry : nb::tuple(state[1])) shape.push_back(nb::cast<npy_intp>(entry));
  new (self) PySignalOperator{
      SignalOperator::of_memory({memory.data(), memory.data() + memory.size()}), shape};
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_signals(nb::module_ &m) {
  const auto count = [](auto member) {
    return [member](const PySignalOperator &self) { return self.kernel.*member; };
  };
  nb::class_<PySignalOperator>(
      m, "SignalOperator", "Streaming operator on a signal; see tests/oracles/signals.py.")
      .def("__init__", &construct, arg("kind"), arg("a"), arg("b"), arg("dt"),
          arg("init").none() = nb::none())
      .def("step", &step, array("x"), arg("t").none() = nb::none())
      .def("run", &run, array("x"), arg("t").none() = nb::none())
      .def("__getstate__", &state_of)
      .def("__setstate__", &restore)
      .def("reset", &reset, arg("init").none() = nb::none())
      .def_prop_ro("gaps", count(&SignalOperator::gaps))
      .def_prop_ro("longest_gap", count(&SignalOperator::longest_gap))
      .def_prop_ro("skipped", count(&SignalOperator::skipped));
}
