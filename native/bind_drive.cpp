// Python class Drive and functions presliding and model_torque: arguments are checked here, the mathematics is in drive.h.
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "arrays.h"
#include "drive.h"
#include "rigid_body.h"

namespace armlab {
namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

bool finite(const double *values, int n) {
  return std::all_of(values, values + n, [](double x) { return std::isfinite(x); });
}

void construct(Drive *self, nb::handle friction_, nb::handle ripple_) {
  const Input friction(friction_, "friction"), ripple(ripple_, "ripple");
  if (friction.ndim() != 2 || friction.shape()[1] < 1 || friction.shape()[1] > max_joints)
    raise_shape_error("Expected friction of shape (10, n) with n from 1 to " + std::to_string(max_joints) +
                      " joints, got " + friction.shape_text() + ".");
  const int n = static_cast<int>(friction.shape()[1]);
  friction.require_exactly({10, n});
  ripple.require_exactly({3, n});
  Drive drive;
  drive.n = n;
  const double *f = friction.data(), *r = ripple.data();
  for (int i = 0; i < n; ++i) {
    const auto row = [&](int k) { return f[k * n + i]; };
    drive.friction[i] = {row(0), row(1), row(2), row(3), row(4), row(5), row(6), row(7), row(8), row(9)};
    drive.ripple[i] = {r[i], r[n + i], r[2 * n + i]};
  }
  new (self) Drive(drive);
}

nb::object torque(const Drive &self, nb::handle q_, nb::handle qd_, nb::handle z_, nb::handle out) {
  const Samples q(q_, "q", self.n), qd(qd_, "qd", q), z(z_, "z", q);
  const Output tau(out, "out", {self.n}, {&q, &qd, &z});
  double *to = tau.samples().data;
  for (npy_intp k = 0; k < q.size(); ++k) {
    DriveState state;
    state.z = z.data()[k];
    to[k] = self.torque(static_cast<int>(k % self.n), q.data()[k], qd.data()[k], state, 1.0);
  }
  return tau.array();
}

// Adds the torque of the drives along a record to tau (N, n). Rows of which something is not finite become NaN and
// leave the states alone.
void add_drive_torque(const Drive &drive, npy_intp N, const double *q, const double *qd, const double *qdd, double *tau) {
  const int n = drive.n;
  std::array<DriveState, max_joints> states;
  bool first = true;
  for (npy_intp k = 0; k < N; ++k, q += n, qd += n, qdd += n, tau += n) {
    if (!finite(q, n) || !finite(qd, n) || !finite(qdd, n)) {
      std::fill(tau, tau + n, nan);
      continue;
    }
    for (int i = 0; i < n; ++i) {
      if (first) states[i].start(q[i]);
      drive.move(i, q[i], states[i]);
      tau[i] += drive.torque(i, q[i], qd[i], states[i], 1.0);
    }
    first = false;
  }
}

nb::object model_torque(const Chain &chain, nb::handle gravity_, nb::handle links_, nb::handle rotor_,
                        const Drive &drive, nb::handle q_, nb::handle qd_, nb::handle qdd_, nb::handle out) {
  const int n = chain.n;
  const Input gravity(gravity_, "gravity"), links(links_, "links"), rotor(rotor_, "rotor");
  gravity.require_exactly({3});
  links.require_exactly({n, 10});
  rotor.require_exactly({n});
  if (drive.n != n)
    raise_shape_error("Expected a drive of " + std::to_string(n) + " joints like the chain, got " + std::to_string(drive.n) + ".");
  const Samples q(q_, "q", n), qd(qd_, "qd", q), qdd(qdd_, "qdd", q);
  const npy_intp N = q.size() / n;
  q.require_exactly({N, n});
  const Output tau(out, "out", {n}, {&q, &qd, &qdd});
  const double *inertia = rotor.data();
  compute<3, 1>(q, {q.samples(), qd.samples(), qdd.samples()}, {tau.samples()}, [&](const auto &in, const auto &to) {
    rnea(chain, in[0], in[1], in[2], gravity.data(), links.data(), to[0]);
    for (int i = 0; i < n; ++i) to[0][i] = to[0][i] + inertia[i] * in[2][i];
  });
  nb::gil_scoped_release released;
  add_drive_torque(drive, N, q.data(), qd.data(), qdd.data(), tau.samples().data);
  return tau.array();
}

nb::object presliding(nb::handle q_, nb::handle delta_, nb::handle resolution_) {
  const Input q(q_, "q"), delta(delta_, "delta"), resolution(resolution_, "resolution");
  const npy_intp n = delta.size(), N = n ? q.size() / n : 0;
  q.require_exactly({N, n});
  delta.require_exactly({n});
  resolution.require_exactly({n});
  const npy_intp shape[2] = {N, n};
  const nb::object array = fresh_array(2, shape);
  double *z = static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.ptr())));
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
  return array;
}

}  // namespace
}  // namespace armlab

void bind_drive(nb::module_ &m) {
  using namespace armlab;
  using nb::arg;
  nb::class_<Drive>(m, "Drive", "Torque of the drives; armlab/kernels/_reference/drive.py documents it.")
      .def("__init__", &construct, arg("friction"), arg("ripple"))
      .def_ro("n", &Drive::n)
      .def("torque", &torque, arg("q"), arg("qd"), arg("z"), arg("out") = nb::none(),
           "Torque (..., n) at given presliding states.");
  m.def("model_torque", &model_torque, arg("chain"), arg("gravity"), arg("links"), arg("rotor"), arg("drive"), arg("q"),
        arg("qd"), arg("qdd"), arg("out") = nb::none(), "Torque (N, n) of the arm and its drives along a record.");
  m.def("presliding", &presliding, arg("q"), arg("delta"), arg("resolution"),
        "Presliding friction state z (N, n) along positions q (N, n); see armlab/kernels/_reference/drive.py.");
}
