// Python classes Primitive, PrimitiveStepper and RotationStepper, and function rotation_rollout:
// checks arguments; mathematics in primitive.cpp and rotation_primitive.cpp.
#include "array/arrays.h"
#include "math/motion/obstacles.h"
#include "math/motion/rotation_primitive.h"

namespace armlab::python {
namespace {

constexpr double longest_spring = 1e7;  // time constants of the spring per call

const char *const phases[] = {"canonical", "time", "position", "periodic"};

void construct(Primitive *self, nb::handle centres_, nb::handle widths_, nb::handle weights_,
    double alpha, double stiffness, double decay, double pace, const char *phase) {
  const Input centres(centres_, "centres"), widths(widths_, "widths"), weights(weights_, "weights");
  const npy_intp m = centres.size();
  if (m < 1) raise_shape_error("Expected at least one kernel, got none.");
  centres.require_exactly({m});
  widths.require_exactly({m});
  if (weights.ndim() != 2 || weights.shape()[0] != m || weights.shape()[1] < 1)
    raise_shape_error("Expected weights of shape (" + std::to_string(m) +
                      ", n), one row per kernel, got " + weights.shape_text() + ".");
  require_finite(centres);
  require_finite(weights);
  require_positive("widths", widths.data(), m);
  const double rates[] = {alpha, stiffness, decay, pace};
  require_positive("alpha, stiffness, decay and pace", rates, 4);
  const auto found = std::find(std::begin(phases), std::end(phases), std::string(phase));
  if (found == std::end(phases))
    raise_shape_error("Expected canonical, time, position or periodic as phase, got '" +
                      std::string(phase) + "'.");
  Primitive p{static_cast<int>(weights.shape()[1]), static_cast<int>(m), alpha, stiffness, decay,
      pace, static_cast<PhaseKind>(found - std::begin(phases)),
      {centres.data(), centres.data() + m}, {}, {weights.data(), weights.data() + weights.size()}};
  for (npy_intp j = 0; j < m; ++j)
    p.curvatures.push_back(0.5 / (widths.data()[j] * widths.data()[j]));
  new (self) Primitive(p);
}

nb::object basis(const Primitive &p, nb::handle x_, nb::handle out_) {
  const Samples x(x_, "x", {});
  require_finite(x);
  const Output out(out_, "out", {p.m}, {&x});
  double *to = out.samples().data;
  std::fill(to, to + x.size() * p.m, 0.0);
  p.basis(x.size(), x.data(), nullptr, p.m, 1, to);
  return out.array();
}

nb::object design(
    const Primitive &p, nb::handle x_, nb::handle factors_, npy_intp rows, npy_intp columns) {
  const Input x(x_, "x"), factors(factors_, "factors");
  const npy_intp N = x.size();
  for (const Input *input : {&x, &factors}) {
    input->require_exactly({N});
    require_finite(*input);
  }
  if (rows < N || columns < p.m)
    raise_shape_error("Expected room for all phases and kernels, got too few rows or columns.");
  const nb::object matrix = fresh_array({columns, rows});
  std::fill(numbers(matrix), numbers(matrix) + rows * columns, 0.0);
  p.basis(N, x.data(), factors.data(), 1, rows, numbers(matrix));
  return matrix;
}

nb::object forcing(const Primitive &p, nb::handle x_, nb::handle out_) {
  std::vector<double> psi(p.m);
  std::vector<int> index(p.m);
  const auto evaluate = [&](const Samples &x, auto force) {
    require_finite(x);
    const Output out(out_, "out", {p.n}, {&x});
    const int width = x.samples().width;
    for (npy_intp k = 0; k * width < x.size(); ++k)
      force(x.data() + k * width, out.samples().data + k * p.n);
    return out.array();
  };
  if (p.phase == PhaseKind::position)
    return evaluate(Samples(x_, "x", {p.n}),
        [&](const double *x, double *f) { p.forcing_each(x, index.data(), psi.data(), f); });
  return evaluate(Samples(x_, "x", {}),
      [&](const double *x, double *f) { p.forcing(*x, index.data(), psi.data(), f); });
}

// Increasing times (N), N at least 1.
npy_intp read_times(const Input &t) {
  const npy_intp N = t.size();
  t.require_exactly({N});
  if (N < 1) raise_shape_error("Expected at least one time, got none.");
  require_finite(t);
  for (npy_intp k = 1; k < N; ++k)
    if (!(t.data()[k] > t.data()[k - 1]))
      raise_shape_error("Expected increasing times, got one that does not increase at row " +
                        std::to_string(k) + ". Drop repeated samples.");
  return N;
}

void require_steps(const Primitive &p, double span, double tau, bool coupled = false) {
  if ((coupled || p.phase == PhaseKind::position) &&
      !(span / tau * std::max(p.alpha, std::sqrt(p.stiffness)) < longest_spring))
    raise_shape_error(
        "Expected less than 1e7 time constants of the spring, got more. Shorten the motion.");
}

nb::object run(const Primitive &p, nb::handle t_, double tau, nb::handle y0_, nb::handle v0_,
    nb::handle g_, nb::handle scale_, nb::handle weights_) {
  const Input t(t_, "t");
  const npy_intp N = read_times(t), n = p.n;
  require_positive("tau", &tau, 1);
  require_steps(p, t.data()[N - 1] - t.data()[0], tau);
  Samples y0(y0_, "y0", {n}), v0(v0_, "v0", {n}), g(g_, "g", {n}), scale(scale_, "scale", {n});
  Samples::broadcast({&y0, &v0, &g, &scale});
  for (const Input *input : {&y0, &v0, &g, &scale}) require_finite(*input);
  if (y0.ndim() > 2)
    raise_shape_error("Expected y0 of shape (n,) or (K, n), got " + y0.shape_text() + ".");
  const npy_intp K = y0.ndim() == 2 ? y0.shape()[0] : 1;
  nb::object own;
  const double *weights = nullptr;
  if (!weights_.is_none()) {
    const Input given(weights_, "weights", {K, p.m, n});
    require_finite(given);
    own = given.object();
    weights = given.data();
  }
  const npy_intp single[2] = {N, n}, many[3] = {N, K, n};
  const int axes = y0.ndim() + 1;
  const auto fresh = [&] { return fresh_array(axes, axes == 2 ? single : many); };
  const nb::object y = fresh(), yd = fresh(), ydd = fresh(), x = fresh_array({N}), f = fresh();
  {
    nb::gil_scoped_release released;
    rollout(p, N, t.data(), tau, K, y0.data(), v0.data(), g.data(), scale.data(), weights,
        numbers(y), numbers(yd), numbers(ydd), numbers(x), numbers(f));
  }
  return nb::make_tuple(y, yd, ydd, x, f);
}

nb::object responses(const Primitive &p, nb::handle t_, double tau, double longest) {
  const Input t(t_, "t");
  const npy_intp N = read_times(t);
  const double positive[] = {tau, longest};
  require_positive("tau and longest step", positive, 2);
  if (p.phase == PhaseKind::position)
    raise_shape_error(
        "Expected a phase that does not depend on the motion, got 'position': its response is not "
        "linear.");
  const nb::object y = fresh_array({N, p.m + 3}), yd = fresh_array({N, p.m + 3});
  {
    nb::gil_scoped_release released;
    response(p, N, t.data(), tau, longest, numbers(y), numbers(yd));
  }
  return nb::make_tuple(y, yd);
}

void construct_stepper(
    PrimitiveStepper *self, const Primitive &p, double filter, Obstacles *around) {
  require_not_negative("filter", &filter, 1);
  if (around && around->n() != p.n)
    raise_shape_error("Expected obstacles for " + std::to_string(p.n) + " coordinates, got " +
                      std::to_string(around->n()) + ".");
  new (self) PrimitiveStepper(p);
  self->filter = filter;
  self->coupling = around;
}

void start(PrimitiveStepper &self, nb::handle y0_, nb::handle v0_, nb::handle g_, nb::handle scale_,
    double tau) {
  const npy_intp n = self.primitive.n;
  const Input y0(y0_, "y0", {n}), v0(v0_, "v0", {n}), g(g_, "g", {n}), scale(scale_, "scale", {n});
  for (const Input *input : {&y0, &v0, &g, &scale}) require_finite(*input);
  require_positive("tau", &tau, 1);
  self.start(y0.data(), v0.data(), g.data(), scale.data(), tau);
}

nb::object outputs(const PrimitiveStepper &self) {
  const npy_intp n = self.primitive.n;
  const nb::object y = fresh_array({n}), yd = fresh_array({n}), ydd = fresh_array({n});
  self.outputs(numbers(y), numbers(yd), numbers(ydd), nullptr);
  return nb::make_tuple(y, yd, ydd);
}

nb::object step(PrimitiveStepper &self, double dt) {
  require_positive("dt", &dt, 1);
  require_steps(self.primitive, dt, self.tau(), self.coupling);
  self.step(dt);
  return outputs(self);
}

// The states at times (N,), starting with the current time: y, yd, ydd and f, each (N, n).
nb::object follow(PrimitiveStepper &self, nb::handle t_) {
  const Input t(t_, "t");
  const npy_intp N = read_times(t), n = self.primitive.n;
  require_steps(self.primitive, t.data()[N - 1] - t.data()[0], self.tau(), self.coupling);
  const auto fresh = [&] { return fresh_array({N, n}); };
  const nb::object y = fresh(), yd = fresh(), ydd = fresh(), f = fresh();
  {
    nb::gil_scoped_release released;
    for (npy_intp k = 0; k < N; ++k) {
      if (k > 0) self.step(t.data()[k] - t.data()[k - 1]);
      self.outputs(
          numbers(y) + k * n, numbers(yd) + k * n, numbers(ydd) + k * n, numbers(f) + k * n);
    }
  }
  return nb::make_tuple(y, yd, ydd, f);
}

void change_goal(PrimitiveStepper &self, nb::handle g_, nb::handle scale_, nb::handle limit_) {
  const Input g(g_, "g", {self.primitive.n}), scale(scale_, "scale", {self.primitive.n});
  for (const Input *input : {&g, &scale}) require_finite(*input);
  if (limit_.is_none()) return self.change_goal(g.data(), scale.data(), nullptr);
  const Input limit(limit_, "limit", {self.primitive.n});
  require_not_negative("limit", limit.data(), limit.size());
  self.change_goal(g.data(), scale.data(), limit.data());
}

nb::object stepper_forcing(const PrimitiveStepper &self) {
  return fresh_array({self.primitive.n}, self.force().data());
}

// A finite array of exactly this shape.
struct Finite : Input {
  Finite(nb::handle value, const char *name, std::initializer_list<npy_intp> shape)
      : Input(value, name, shape) {
    require_finite(*this);
  }
};

// A normalisable quaternion.
struct Orientation : Finite {
  Orientation(nb::handle value, const char *name) : Finite(value, name, {4}) {
    const double *q = data(), square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    if (!(square > 1e-12 && square < 1e12))
      raise_shape_error(std::string("Expected a unit quaternion wxyz as ") + name + ", got norm " +
                        std::to_string(std::sqrt(square)) + ".");
  }
};

void require_primitive(const Primitive &p) {
  if (p.n != 3 || p.phase == PhaseKind::position)
    raise_shape_error(
        "Expected a primitive of three coordinates whose phase depends only on time, got another "
        "primitive. Fit it again.");
}

void start_rotation(RotationStepper &self, nb::handle q0_, nb::handle w0_, nb::handle goal_,
    nb::handle map_, double tau) {
  const Orientation q0(q0_, "q0"), goal(goal_, "goal");
  const Finite w0(w0_, "w0", {3}), map(map_, "map", {3, 3});
  require_positive("tau", &tau, 1);
  self.start(q0.data(), w0.data(), goal.data(), map.data(), tau);
}

nb::object rotation_outputs(const RotationStepper &self) {
  const nb::object q = fresh_array({4}), w = fresh_array({3}), wd = fresh_array({3});
  self.outputs(numbers(q), numbers(w), numbers(wd));
  return nb::make_tuple(q, w, wd);
}

void construct_rotation(RotationStepper *self, const Primitive &p) {
  require_primitive(p);
  new (self) RotationStepper(p);
}

nb::object rotation_step(RotationStepper &self, double dt) {
  require_positive("dt", &dt, 1);
  require_steps(self.primitive, dt, self.tau(), true);
  self.step(dt);
  return rotation_outputs(self);
}

void change_rotation_goal(RotationStepper &self, nb::handle goal_, nb::handle map_) {
  const Orientation goal(goal_, "goal");
  const Finite map(map_, "map", {3, 3});
  self.change_goal(goal.data(), map.data());
}

nb::object rotation_rollout(const Primitive &p, nb::handle t_, double tau, nb::handle q0,
    nb::handle w0, nb::handle goal, nb::handle map) {
  require_primitive(p);
  const Input t(t_, "t");
  const npy_intp N = read_times(t);
  RotationStepper stepper(p);
  start_rotation(stepper, q0, w0, goal, map, tau);
  require_steps(p, t.data()[N - 1] - t.data()[0], tau, true);
  const nb::object q = fresh_array({N, 4}), w = fresh_array({N, 3}), wd = fresh_array({N, 3});
  double *to_q = numbers(q), *to_w = numbers(w), *to_wd = numbers(wd);
  {
    nb::gil_scoped_release released;
    for (npy_intp k = 0; k < N; ++k) {
      if (k) stepper.step(t.data()[k] - t.data()[k - 1]);
      stepper.outputs(to_q + 4 * k, to_w + 3 * k, to_wd + 3 * k);
    }
  }
  return nb::make_tuple(q, w, wd);
}

template <class Stepper>
void bind_time(nb::class_<Stepper> &stepper) {
  const auto change_tau = [](Stepper &self, double tau) {
    require_positive("tau", &tau, 1);
    self.change_tau(tau);
  };
  stepper.def("change_tau", change_tau, arg("tau"))
      .def_prop_ro("tau", &Stepper::tau)
      .def_prop_ro("elapsed", &Stepper::elapsed);
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_primitive(nb::module_ &m) {
  nb::class_<Primitive>(
      m, "Primitive", "Spring, damper and forcing; see tests/oracles/primitive.py.")
      .def("__init__", &construct, array("centres"), array("widths"), array("weights"),
          arg("alpha"), arg("stiffness"), arg("decay"), arg("pace"), arg("phase"))
      .def("basis", &basis, array("x"), arg("out").none() = nb::none())
      .def("design", &design, array("x"), array("factors"), arg("rows"), arg("columns"))
      .def("forcing", &forcing, array("x"), arg("out").none() = nb::none())
      .def("rollout", &run, array("t"), arg("tau"), array("y0"), array("v0"), array("g"),
          array("scale"), arg("weights").none() = nb::none())
      .def("response", &responses, array("t"), arg("tau"), arg("longest"));
  auto stepper =
      nb::class_<PrimitiveStepper>(
          m, "PrimitiveStepper", "One run, sample by sample; see tests/oracles/primitive.py.")
          .def("__init__", &construct_stepper, arg("primitive"), arg("filter") = 0.0,
              arg("around").none() = nb::none(), nb::keep_alive<1, 4>())
          .def("start", &start, array("y0"), array("v0"), array("g"), array("scale"), arg("tau"))
          .def("step", &step, arg("dt"))
          .def("follow", &follow, array("t"))
          .def("outputs", &outputs)
          .def("change_goal", &change_goal, array("g"), array("scale"),
              arg("limit").none() = nb::none())
          .def_prop_ro("forcing", &stepper_forcing);
  bind_time(stepper);
  auto rotation = nb::class_<RotationStepper>(
      m, "RotationStepper", "One run of orientations, sample by sample; _native.pyi documents it.")
                      .def("__init__", &construct_rotation, arg("primitive"))
                      .def("start", &start_rotation, array("q0"), array("w0"), array("goal"),
                          array("map"), arg("tau"))
                      .def("step", &rotation_step, arg("dt"))
                      .def("outputs", &rotation_outputs)
                      .def("change_goal", &change_rotation_goal, array("goal"), array("map"));
  bind_time(rotation);
  m.def("rotation_rollout", &rotation_rollout, arg("primitive"), array("t"), arg("tau"),
      array("q0"), array("w0"), array("goal"), array("map"));
}
