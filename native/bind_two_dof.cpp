// Python class TwoDof: arguments are checked here, the mathematics is in two_dof.cpp.
#include <cmath>
#include <string>
#include <vector>

#include "arrays.h"
#include "two_dof.h"

namespace armlab {
namespace {

Phase phase_of(const std::string &name) {
  if (name == "canonical") return Phase::canonical;
  if (name == "time") return Phase::time;
  if (name == "position") return Phase::position;
  raise_shape_error("Expected the phase canonical, time or position, got '" + name + "'.");
}

std::vector<double> row(nb::handle value, const char *name, npy_intp length) {
  const Input input(value, name);
  input.require_exactly({length});
  return {input.data(), input.data() + length};
}

void construct(TwoDof *self, const char *phase, nb::handle centres, nb::handle widths, nb::handle weights_, nb::handle y0,
               nb::handle g, nb::handle spring_, nb::handle gains_, nb::handle dead_zone, nb::handle scale) {
  TwoDof::Parameters p;
  p.phase = phase_of(phase);
  const Input weights(weights_, "weights");
  if (weights.ndim() != 2 || weights.shape()[0] < 1 || weights.shape()[1] < 1 || weights.shape()[1] > max_joints)
    raise_shape_error("Expected weights of shape (m, n) with n up to " + std::to_string(max_joints) + ", got " +
                      weights.shape_text() + ".");
  p.m = static_cast<int>(weights.shape()[0]);
  p.n = static_cast<int>(weights.shape()[1]);
  p.weights.assign(weights.data(), weights.data() + weights.size());
  p.centres = row(centres, "centres", p.m);
  p.widths = row(widths, "widths", p.m);
  p.y0 = row(y0, "y0", p.n);
  p.g = row(g, "g", p.n);
  const std::vector<double> spring = row(spring_, "spring", 5), gains = row(gains_, "gains", 5);
  p.dead_zone = row(dead_zone, "dead_zone", p.n);
  p.scale = row(scale, "scale", p.n);
  require_positive("widths", p.widths.data(), p.m);
  require_positive("spring", spring.data(), 5);
  require_positive("scale", p.scale.data(), p.n);
  require_not_negative("gains", gains.data(), 4);
  require_not_negative("dead_zone", p.dead_zone.data(), p.n);
  if (!(gains[4] > 0.0)) raise_shape_error("Expected e_max above zero, got another number.");
  p.alpha_z = spring[0], p.beta_z = spring[1], p.alpha_x = spring[2], p.tau = spring[3], p.duration = spring[4];
  p.kp = gains[0], p.kv = gains[1], p.kc = gains[2], p.alpha_e = gains[3], p.e_max = gains[4];
  new (self) TwoDof(p);
}

double *numbers(const nb::object &array) {
  return static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.ptr())));
}

nb::object copied(const TwoDof &self, nb::handle state_) {
  const Input state(state_, "state");
  state.require_exactly({self.size()});
  return fresh_array(1, state.shape(), state.data());
}

TwoDof::Speed speed_of(nb::handle value) {
  const Input speed(value, "speed");
  speed.require_exactly({3});
  return {speed.data()[0], speed.data()[1], speed.data()[2]};
}

void check_step(double dt, long steps) {
  if (!(dt >= 0.0 && std::isfinite(dt)) || steps < 1)
    raise_shape_error("Expected a finite dt from 0 in at least one step, got others.");
}

nb::object advance(TwoDof &self, nb::handle state_, double dt, long steps, nb::handle driven_, nb::handle speed_) {
  const nb::object state = copied(self, state_);
  const Input driven(driven_, "driven");
  driven.require_exactly({self.n()});
  const auto speed = speed_of(speed_);
  check_step(dt, steps);
  self.advance(numbers(state), dt, steps, driven.data(), speed);
  return state;
}

nb::object reference(TwoDof &self, nb::handle state_, nb::handle speed) {
  const Input state(state_, "state");
  state.require_exactly({self.size()});
  const npy_intp shape[2] = {3, self.n()};
  const nb::object out = fresh_array(2, shape);
  self.reference(state.data(), speed_of(speed), numbers(out));
  return out;
}

nb::object follow(TwoDof &self, nb::handle state_, double dt, long steps, nb::handle speed_, nb::handle ya_,
                  nb::handle yad_) {
  const nb::object state = copied(self, state_);
  const auto speed = speed_of(speed_);
  check_step(dt, steps);
  const Input ya(ya_, "ya"), yad(yad_, "yad");
  ya.require_exactly({self.n()});
  yad.require_exactly({self.n()});
  const npy_intp shape[2] = {3, self.n()};
  const nb::object out = fresh_array(2, shape);
  self.follow(numbers(state), dt, steps, speed, ya.data(), yad.data(), numbers(out));
  return nb::make_tuple(state, out);
}

double time_constant(const TwoDof &self, nb::handle state_) {
  const Input state(state_, "state");
  state.require_exactly({self.size()});
  return self.time_constant(state.data());
}

}  // namespace
}  // namespace armlab

void bind_two_dof(nb::module_ &m) {
  using namespace armlab;
  using nb::arg;
  nb::class_<TwoDof>(m, "TwoDof", "Two-degree-of-freedom control; see armlab/kernels/_reference/two_dof.py.")
      .def("__init__", &construct, arg("phase"), array("centres"), array("widths"), array("weights"), array("y0"),
           array("g"), array("spring"), array("gains"), array("dead_zone"), array("scale"))
      .def_prop_ro("n", &TwoDof::n, "Number of coordinates.")
      .def("advance", &advance, array("state"), arg("dt"), arg("steps"), array("driven"), array("speed"),
           "Return the state after dt seconds.")
      .def("reference", &reference, array("state"), array("speed"), "Return (3, n) yc', yc'' and ya_ref''.")
      .def("follow", &follow, array("state"), arg("dt"), arg("steps"), array("speed"), array("ya"), array("yad"),
           "Return the state when ya and ya' are measured, and its reference.")
      .def("time_constant", &time_constant, array("state"), "Return tau_a [s] of a state.");
}
