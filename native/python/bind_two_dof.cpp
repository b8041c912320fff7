// Python class TwoDof: checks arguments; mathematics in two_dof.cpp.
#include "array/arrays.h"
#include "math/motion/two_dof.h"

namespace armlab::python {
namespace {

std::vector<double> row(nb::handle value, const char *name, npy_intp length) {
  const Input input(value, name, {length});
  return {input.data(), input.data() + length};
}

std::vector<double> finite_row(nb::handle value, const char *name, npy_intp length) {
  require_finite(Input(value, name, {length}));
  return row(value, name, length);
}

void construct(TwoDof *self, const Primitive &primitive, double tau, nb::handle y0, nb::handle g,
    nb::handle scale, nb::handle gains_, nb::handle dead_zone, nb::handle unit) {
  const int n = primitive.n;
  if (n > max_joints)
    raise_shape_error("Expected at most " + std::to_string(max_joints) + " coordinates, got " +
                      std::to_string(n) + ".");
  const auto start = finite_row(y0, "y0", n), goal = finite_row(g, "g", n),
             factor = finite_row(scale, "scale", n);
  const auto gains = row(gains_, "gains", 5), zone = row(dead_zone, "dead_zone", n),
             units = row(unit, "unit", n);
  require_positive("tau", &tau, 1);
  require_positive("unit", units.data(), n);
  require_not_negative("gains", gains.data(), 4);
  require_not_negative("dead_zone", zone.data(), n);
  if (!(gains[4] > 0.0))
    raise_shape_error("Expected e_max above zero, got a smaller number or NaN.");
  new (self) TwoDof({primitive, tau, gains[0], gains[1], gains[2], gains[3], gains[4], start, goal,
      factor, zone, units});
}

nb::object copied(const TwoDof &self, nb::handle state_) {
  const Input state(state_, "state", {self.size()});
  return fresh_array(1, state.shape(), state.data());
}

TwoDof::Speed speed_of(nb::handle value) {
  const Input speed(value, "speed", {3});
  return {speed.data()[0], speed.data()[1], speed.data()[2]};
}

void check_step(double dt, long steps) {
  if (!(dt >= 0.0 && std::isfinite(dt)) || steps < 1)
    raise_shape_error("Expected a finite dt >= 0 and at least one step, got other values.");
}

nb::object advance(
    TwoDof &self, nb::handle state_, double dt, long steps, nb::handle driven_, nb::handle speed_) {
  const nb::object state = copied(self, state_);
  const Input driven(driven_, "driven", {self.n()});
  const auto speed = speed_of(speed_);
  check_step(dt, steps);
  self.advance(numbers(state), dt, steps, driven.data(), speed);
  return state;
}

nb::object reference(TwoDof &self, nb::handle state_, nb::handle speed) {
  const Input state(state_, "state", {self.size()});
  const nb::object out = fresh_array({3, self.n()});
  self.reference(state.data(), speed_of(speed), numbers(out));
  return out;
}

nb::object slopes(TwoDof &self, nb::handle state_, nb::handle speed) {
  const Input state(state_, "state", {self.size()});
  const nb::object out = fresh_array(1, state.shape());
  self.slopes(state.data(), speed_of(speed), numbers(out));
  return out;
}

nb::object follow(TwoDof &self, nb::handle state_, double dt, long steps, nb::handle speed_,
    nb::handle ya_, nb::handle yad_) {
  const nb::object state = copied(self, state_);
  const auto speed = speed_of(speed_);
  check_step(dt, steps);
  const Input ya(ya_, "ya", {self.n()}), yad(yad_, "yad", {self.n()});
  const nb::object out = fresh_array({3, self.n()});
  self.follow(numbers(state), dt, steps, speed, ya.data(), yad.data(), numbers(out));
  return nb::make_tuple(state, out);
}

double time_constant(const TwoDof &self, nb::handle state_) {
  const Input state(state_, "state", {self.size()});
  return self.time_constant(state.data());
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_two_dof(nb::module_ &m) {
  nb::class_<TwoDof>(m, "TwoDof", "Two-degree-of-freedom control; see tests/oracles/two_dof.py.")
      .def("__init__", &construct, arg("primitive"), arg("tau"), array("y0"), array("g"),
          array("scale"), array("gains"), array("dead_zone"), array("unit"))
      .def_prop_ro("n", &TwoDof::n)
      .def("advance", &advance, array("state"), arg("dt"), arg("steps"), array("driven"),
          array("speed"))
      .def("reference", &reference, array("state"), array("speed"))
      .def("slopes", &slopes, array("state"), array("speed"))
      .def("follow", &follow, array("state"), arg("dt"), arg("steps"), array("speed"), array("ya"),
          array("yad"))
      .def("time_constant", &time_constant, array("state"));
}
