// Python class RotationStepper and function rotation_rollout; the mathematics is in
// rotation_primitive.cpp.
#include <algorithm>
#include <cmath>
#include <string>

#include "array/arrays.h"
#include "math/motion/rotation_primitive.h"

namespace armlab::python {
namespace {

constexpr double longest_spring =
    1e7;  // time constants of the spring that are integrated in one call

// A finite array of exactly that shape.
struct Finite : Input {
  Finite(nb::handle value, const char *name, std::initializer_list<npy_intp> shape)
      : Input(value, name, shape) {
    require_finite(*this);
  }
};

// A quaternion that has a direction.
struct Orientation : Finite {
  Orientation(nb::handle value, const char *name) : Finite(value, name, {4}) {
    const double *q = data(), square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    if (!(square > 1e-12 && square < 1e12))
      raise_shape_error(std::string("Expected a quaternion wxyz of length 1 as ") + name +
                        ", got another length.");
  }
};

void require_primitive(const Primitive &p) {
  if (p.n != 3 || p.phase == PhaseKind::position)
    raise_shape_error(
        "Expected a primitive of three coordinates with a phase of time, got another. Fit it "
        "again.");
}

void require_steps(const Primitive &p, double span, double tau) {
  if (!(span / tau * std::max(p.alpha, std::sqrt(p.stiffness)) < longest_spring))
    raise_shape_error(
        "Expected less than 1e7 time constants of the spring, got more. Ask for a shorter motion.");
}

void start(RotationStepper &self, nb::handle q0_, nb::handle w0_, nb::handle goal_, nb::handle map_,
    double tau) {
  const Orientation q0(q0_, "q0"), goal(goal_, "goal");
  const Finite w0(w0_, "w0", {3}), map(map_, "map", {3, 3});
  require_positive("tau", &tau, 1);
  self.start(q0.data(), w0.data(), goal.data(), map.data(), tau);
}

nb::object outputs(const RotationStepper &self) {
  const npy_intp four = 4, three = 3;
  const nb::object q = fresh_array(1, &four), w = fresh_array(1, &three),
                   wd = fresh_array(1, &three);
  self.outputs(numbers(q), numbers(w), numbers(wd));
  return nb::make_tuple(q, w, wd);
}

void construct(RotationStepper *self, const Primitive &p) {
  require_primitive(p);
  new (self) RotationStepper(p);
}

nb::object step(RotationStepper &self, double dt) {
  require_positive("dt", &dt, 1);
  require_steps(self.primitive, dt, self.tau());
  self.step(dt);
  return outputs(self);
}

void change_goal(RotationStepper &self, nb::handle goal_, nb::handle map_) {
  const Orientation goal(goal_, "goal");
  const Finite map(map_, "map", {3, 3});
  self.change_goal(goal.data(), map.data());
}

nb::object rotation_rollout(const Primitive &p, nb::handle t_, double tau, nb::handle q0,
    nb::handle w0, nb::handle goal, nb::handle map) {
  require_primitive(p);
  const Input shape(t_, "t");
  const npy_intp N = shape.size();
  const Finite t(t_, "t", {N});
  if (N < 1) raise_shape_error("Expected at least one time, got none.");
  for (npy_intp k = 1; k < N; ++k)
    if (!(t.data()[k] > t.data()[k - 1]))
      raise_shape_error("Expected times that increase, got one that does not at row " +
                        std::to_string(k) + ". Drop repeated samples.");
  RotationStepper stepper(p);
  start(stepper, q0, w0, goal, map, tau);
  require_steps(p, t.data()[N - 1] - t.data()[0], tau);
  const npy_intp four[2] = {N, 4}, three[2] = {N, 3};
  const nb::object q = fresh_array(2, four), w = fresh_array(2, three), wd = fresh_array(2, three);
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

}  // namespace
}  // namespace armlab::python

void bind_rotation_primitive(nb::module_ &m) {
  using namespace armlab;
  using nb::arg;
  nb::class_<RotationStepper>(
      m, "RotationStepper", "One run of orientations, sample by sample; _native.pyi documents it.")
      .def("__init__", &python::construct, arg("primitive"))
      .def("start", &python::start, array("q0"), array("w0"), array("goal"), array("map"),
          arg("tau"), "Begin at phase time 0.")
      .def("step", &python::step, arg("dt"), "Advance by dt and return q, w, wd.")
      .def("outputs", &python::outputs, "q, w and wd as they are now.")
      .def("change_goal", &python::change_goal, array("goal"), array("map"),
          "Another goal from now on.")
      .def(
          "change_tau",
          [](RotationStepper &self, double tau) {
            require_positive("tau", &tau, 1);
            self.change_tau(tau);
          },
          arg("tau"), "Another time constant from now on.")
      .def_prop_ro("tau", &RotationStepper::tau, "Time constant [s].")
      .def_prop_ro("elapsed", &RotationStepper::elapsed, "Phase time in units of tau.");
  m.def("rotation_rollout", &python::rotation_rollout, arg("primitive"), array("t"), arg("tau"),
      array("q0"), array("w0"), array("goal"), array("map"),
      "Orientations q (N, 4), angular velocities and accelerations (N, 3) over times (N,).");
}
