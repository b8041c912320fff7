// Python class Obstacles: checks arguments; mathematics in obstacles.cpp.
#include "array/arrays.h"
#include "math/motion/obstacles.h"

namespace armlab::python {
namespace {

Input finite(nb::handle value, const char *name, npy_intp width, npy_intp rows = -1) {
  Input input(value, name);
  if (rows >= 0) input.require_exactly({rows, width});
  else input.require_exactly({width});
  require_finite(input);
  return input;
}

npy_intp rows_of(nb::handle value, const char *name) {
  const Input input(value, name);
  return input.ndim() == 2 ? input.shape()[0] : 0;
}

Capsule capsule(const double *row, bool moves) {
  if (row[6] < 0.0) raise_shape_error("Expected a radius >= 0, got a negative one. Correct it.");
  const auto point = [&](int at) { return Point{row[at], row[at + 1], row[at + 2]}; };
  return {point(0), point(3), row[6], moves ? point(7) : Point{0.0, 0.0, 0.0}};
}

Obstacles::Rule rule_of(double clearance, double reach, bool by_potential) {
  if (!(clearance >= 0.0 && clearance < reach && std::isfinite(reach)))
    raise_shape_error("Expected 0 <= clearance < reach, got other values. Correct them.");
  return {clearance, reach, by_potential ? Obstacles::Form::potential : Obstacles::Form::steering};
}

void construct(Obstacles *self, nb::handle arm, nb::handle links_, nb::handle bodies_,
    double clearance, double reach, bool by_potential) {
  const Obstacles::Rule rule = rule_of(clearance, reach, by_potential);
  if (!nb::isinstance<Chain>(arm)) {
    const long n = nb::isinstance<nb::int_>(arm) ? nb::cast<long>(arm) : 0;
    if (n != 2 && n != 3)
      raise_shape_error("Expected 2 or 3 dimensions, or a Chain, got another value.");
    new (self) Obstacles(static_cast<int>(n), rule);
    return;
  }
  const Chain &chain = nb::cast<const Chain &>(arm);
  const npy_intp count = rows_of(bodies_, "bodies");
  const Input bodies = finite(bodies_, "bodies", 7, count), links = finite(links_, "links", count);
  std::vector<Obstacles::Body> found;
  for (npy_intp i = 0; i < count; ++i) {
    const double link = links.data()[i];
    if (!(link >= 1.0 && link <= chain.n && link == std::floor(link)))
      raise_shape_error(
          "Expected links from 1 to " + std::to_string(chain.n) + ", got a different number.");
    found.push_back({static_cast<int>(link), capsule(bodies.data() + 7 * i, false)});
  }
  new (self) Obstacles(chain, found, rule);
}

void put(Obstacles &self, nb::handle capsules_) {
  const npy_intp count = rows_of(capsules_, "capsules");
  const Input capsules = finite(capsules_, "capsules", 10, count);
  std::vector<Capsule> found;
  for (npy_intp i = 0; i < count; ++i) found.push_back(capsule(capsules.data() + 10 * i, true));
  self.place(found);
}

nb::object distance(Obstacles &self, nb::handle y_) {
  const Samples y(y_, "y", {self.n()});
  const nb::object out = fresh_array(y.ndim() - 1, y.shape());
  for (npy_intp i = 0; i < y.size() / self.n(); ++i)
    numbers(out)[i] = self.distance(y.data() + self.n() * i);
  return out;
}

nb::object add(Obstacles &self, nb::handle y_, nb::handle yd_, nb::handle g_, nb::handle ydd_) {
  const int n = self.n();
  const Input y = finite(y_, "y", n), yd = finite(yd_, "yd", n), g = finite(g_, "g", n),
              ydd = finite(ydd_, "ydd", n);
  const nb::object out = fresh_array({n}, ydd.data());
  self.add(y.data(), yd.data(), g.data(), numbers(out));
  return out;
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_obstacles(nb::module_ &m) {
  nb::class_<Obstacles>(m, "Obstacles", "Obstacle avoidance; see docs/theory/obstacles.md.")
      .def("__init__", &construct, arg("arm"), array("links"), array("bodies"), arg("clearance"),
          arg("reach"), arg("by_potential") = false)
      .def("place", &put, array("capsules"))
      .def("distance", &distance, array("y"))
      .def("add", &add, array("y"), array("yd"), array("g"), array("ydd"))
      .def(
          "advance",
          [](Obstacles &self, double dt) {
            require_not_negative("dt", &dt, 1);
            self.advance(dt);
          },
          arg("dt"));
}
