// Python class Drive and functions basis_weights, model_torque and presliding: checks arguments;
// mathematics in drive.h.
#include <cstring>

#include "array/arrays.h"
#include "math/contact/drive.h"
#include "math/arm/rigid_body.h"

namespace armlab::python {
namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

// Reads a tuple of arrays.
std::vector<Input> parts(nb::handle tuple, std::initializer_list<const char *> names) {
  if (!PyTuple_Check(tuple.ptr()) ||
      PyTuple_GET_SIZE(tuple.ptr()) != static_cast<npy_intp>(names.size()))
    raise_shape_error("Expected a part of the drive as a tuple of " + std::to_string(names.size()) +
                      " arrays, got a different type or length.");
  std::vector<Input> inputs;
  for (const char *name : names)
    inputs.emplace_back(PyTuple_GET_ITEM(tuple.ptr(), inputs.size()), name);
  return inputs;
}

std::vector<double> copied(const Input &input) {
  return {input.data(), input.data() + input.size()};
}

int centres(const Input &input, int n) {
  if (input.ndim() != 2 || input.shape()[0] != n || input.shape()[1] < 1 ||
      input.shape()[1] > max_centres)
    raise_shape_error("Expected " + std::string(input.name()) + " of shape (" + std::to_string(n) +
                      ", m) with m from 1 to " + std::to_string(max_centres) + ", got " +
                      input.shape_text() + ".");
  return static_cast<int>(input.shape()[1]);
}

RippleLines read_lines(nb::handle tuple, int n) {
  const auto in = parts(
      tuple, {"line joints", "line cycles", "line speeds", "line widths", "line coefficients"});
  RippleLines lines;
  const npy_intp L = in[0].size();
  lines.speeds = centres(in[2], n);
  in[0].require_exactly({L});
  in[1].require_exactly({L});
  in[3].require_exactly({n, lines.speeds});
  lines.sides = in[4].ndim() == 4 && in[4].shape()[1] == 2 ? 2 : 1;
  in[4].require_exactly({L, lines.sides, lines.speeds, 2});
  for (npy_intp k = 0; k < L; ++k) {
    const double joint = in[0].data()[k];
    if (!(joint >= (k ? in[0].data()[k - 1] : 0.0) && joint < n))
      raise_shape_error(
          "Expected torque ripple lines in ascending order of joints, got another order.");
    for (int i = static_cast<int>(joint) + 1; i <= n; ++i) ++lines.first[i];
  }
  lines.cycles = copied(in[1]);
  lines.centres = copied(in[2]);
  lines.widths = copied(in[3]);
  lines.coefficients = copied(in[4]);
  return lines;
}

FrictionMap read_map(nb::handle tuple, int n) {
  const auto in = parts(tuple, {"map positions", "map position widths", "map speeds",
                                   "map speed widths", "map coefficients"});
  FrictionMap map;
  map.positions = centres(in[0], n);
  map.speeds = centres(in[2], n);
  in[1].require_exactly({n, map.positions});
  in[3].require_exactly({n, map.speeds});
  in[4].require_exactly({n, 2, map.positions, map.speeds});
  map.position_centres = copied(in[0]);
  map.position_widths = copied(in[1]);
  map.speed_centres = copied(in[2]);
  map.speed_widths = copied(in[3]);
  map.coefficients = copied(in[4]);
  return map;
}

void construct(Drive *self, nb::handle friction_, nb::handle ripple_, nb::handle lines,
    nb::handle map, nb::handle warm_up_) {
  const Input friction(friction_, "friction"), ripple(ripple_, "ripple");
  if (friction.ndim() != 2 || friction.shape()[1] < 1 || friction.shape()[1] > max_joints)
    raise_shape_error("Expected friction of shape (" + std::to_string(friction_rows) +
                      ", n) with n from 1 to " + std::to_string(max_joints) + " joints, got " +
                      friction.shape_text() + ".");
  const int n = static_cast<int>(friction.shape()[1]);
  friction.require_exactly({friction_rows, n});
  ripple.require_exactly({3, n});
  Drive drive;
  drive.n = n;
  const double *f = friction.data(), *r = ripple.data();
  for (int i = 0; i < n; ++i) {
    double rows[friction_rows];
    for (int k = 0; k < friction_rows; ++k) rows[k] = f[k * n + i];
    std::memcpy(&drive.friction[i], rows, sizeof rows);
    drive.ripple[i] = {r[i], r[n + i], r[2 * n + i]};
  }
  if (!lines.is_none()) drive.lines = read_lines(lines, n);
  if (!map.is_none()) drive.map = read_map(map, n);
  if (!warm_up_.is_none()) {
    const Input warm_up(warm_up_, "warm_up", {5, n});
    const double *w = warm_up.data();
    for (int i = 0; i < n; ++i)
      drive.warm_up[i] = {w[i], w[n + i], w[2 * n + i], w[3 * n + i], w[4 * n + i]};
  }
  new (self) Drive(drive);
}

nb::object weights(nb::handle x_, nb::handle centres_, nb::handle widths_) {
  const Input x(x_, "x"), middle(centres_, "centres"), widths(widths_, "widths");
  const npy_intp m = middle.size();
  if (m < 1 || m > max_centres)
    raise_shape_error("Expected 1 to " + std::to_string(max_centres) + " centres, got " +
                      std::to_string(m) + ".");
  middle.require_exactly({m});
  widths.require_exactly({m});
  x.require_exactly({x.size()});
  const nb::object array = fresh_array({x.size(), m});
  double *to = numbers(array);
  {
    nb::gil_scoped_release released;
    for (npy_intp k = 0; k < x.size(); ++k)
      basis_weights(x.data()[k], static_cast<int>(m), middle.data(), widths.data(), to + m * k);
  }
  return array;
}

nb::object torque(const Drive &self, nb::handle q_, nb::handle qd_, nb::handle z_, nb::handle out) {
  Samples q(q_, "q", {self.n}), qd(qd_, "qd", {self.n}), z(z_, "z", {self.n});
  Samples::broadcast({&q, &qd, &z});
  const Output tau(out, "out", {self.n}, {&q, &qd, &z});
  double *to = tau.samples().data;
  for (npy_intp k = 0; k < q.size(); ++k) {
    const int i = static_cast<int>(k % self.n);
    to[k] =
        self.torque(i, q.data()[k], qd.data()[k], {0.0, z.data()[k], self.warm_up[i].start}, 1.0);
  }
  return tau.array();
}

// Adds the torque of the drives along a record to tau (N, n), which contains the torque of the
// links. Without dt (N), there is no warm-up. Rows that are not finite become NaN and do not change
// the states.
void add_drive_torque(const Drive &drive, npy_intp N, const double *rotor, const double *q,
    const double *qd, const double *qdd, const double *dt, double *tau) {
  const int n = drive.n;
  std::array<DriveState, max_joints> states;
  bool first = true;
  for (npy_intp k = 0; k < N; ++k, q += n, qd += n, qdd += n, tau += n) {
    if (!finite(q, n) || !finite(qd, n) || !finite(qdd, n) || (dt && !finite(dt + k, 1))) {
      std::fill(tau, tau + n, nan);
      continue;
    }
    for (int i = 0; i < n; ++i) {
      if (first) states[i] = drive.start(i, q[i]);
      drive.move(i, q[i], states[i]);
      const double load = tau[i];
      tau[i] += rotor[i] * qdd[i];
      tau[i] +=
          drive.torque(i, q[i], qd[i], states[i], 1.0) + drive.of_load(i, load, qd[i], states[i]);
      if (dt) drive.heat(i, qd[i], dt[k], states[i]);
    }
    first = false;
  }
}

nb::object model_torque(const Chain &chain, nb::handle gravity_, nb::handle links_,
    nb::handle rotor_, const Drive &drive, nb::handle q_, nb::handle qd_, nb::handle qdd_,
    nb::handle dt_, nb::handle out) {
  const int n = chain.n;
  const Input gravity(gravity_, "gravity", {3}), links(links_, "links", {n, 10}),
      rotor(rotor_, "rotor", {n});
  if (drive.n != n)
    raise_shape_error("Expected a drive of " + std::to_string(n) + " joints like the chain, got " +
                      std::to_string(drive.n) + ".");
  Samples q(q_, "q", {n}), qd(qd_, "qd", {n}), qdd(qdd_, "qdd", {n});
  Samples::broadcast({&q, &qd, &qdd});
  const npy_intp N = q.size() / n;
  q.require_exactly({N, n});
  std::vector<double> dt;
  if (!dt_.is_none()) dt = copied(Input(dt_, "dt", {N}));
  const Output tau(out, "out", {n}, {&q, &qd, &qdd});
  tau.require_apart_from({&gravity, &links, &rotor});
  compute<3, 1>(q, {q.samples(), qd.samples(), qdd.samples()}, {tau.samples()},
      [&](const auto &in, const auto &to) {
        rnea({chain, gravity.data(), links.data()}, in[0], in[1], in[2], to[0]);
      });
  {
    // this scope ends before `return`, which adds a reference to the array
    nb::gil_scoped_release released;
    add_drive_torque(drive, N, rotor.data(), q.data(), qd.data(), qdd.data(),
        dt_.is_none() ? nullptr : dt.data(), tau.samples().data);
  }
  return tau.array();
}

nb::object presliding(nb::handle q_, nb::handle delta_, nb::handle resolution_) {
  const Input q(q_, "q"), delta(delta_, "delta");
  const npy_intp n = delta.size(), N = n ? q.size() / n : 0;
  q.require_exactly({N, n});
  delta.require_exactly({n});
  const Input resolution(resolution_, "resolution", {n});
  const nb::object array = fresh_array({N, n});
  double *z = numbers(array);
  {
    nb::gil_scoped_release released;
    std::vector<double> state(n, 0.0), play;
    for (npy_intp k = 0; k < N; ++k, z += n) {
      const double *row = q.data() + n * k;
      if (!finite(row, static_cast<int>(n))) {
        std::fill(z, z + n, nan);
        continue;
      }
      if (play.empty()) play.assign(row, row + n);
      for (npy_intp i = 0; i < n; ++i) {
        const double dy = follow(play[i], row[i], resolution.data()[i]);
        z[i] = state[i] = slide(state[i], dy, delta.data()[i]);
      }
    }
  }
  return array;
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_drive(nb::module_ &m) {
  nb::class_<Drive>(m, "Drive", "Torque of the drives; tests/oracles/drive.py documents it.")
      .def("__init__", &construct, array("friction"), array("ripple"), arg("lines") = nb::none(),
          arg("map") = nb::none(), arg("warm_up") = nb::none())
      .def_ro("n", &Drive::n)
      .def("torque", &torque, array("q"), array("qd"), array("z"), arg("out") = nb::none());
  m.def("basis_weights", &weights, array("x"), array("centres"), array("widths"));
  m.def("model_torque", &model_torque, arg("chain"), array("gravity"), array("links"),
      array("rotor"), arg("drive"), array("q"), array("qd"), array("qdd"), arg("dt") = nb::none(),
      arg("out") = nb::none());
  m.def("presliding", &presliding, array("q"), array("delta"), array("resolution"));
}
