// Python class Chain: arguments are checked here, mathematics: kinematics.h and rigid_body.h.
#include "array/arrays.h"
#include "math/arm/rigid_body.h"

namespace armlab::python {
namespace {

// Makes R orthonormal by Newton steps towards the nearest rotation. Refuses what is off by more
// than 1e-6, leaves alone what is orthonormal to rounding.
bool make_rigid(double *E) {
  const double bottom[4] = {0.0, 0.0, 0.0, 1.0};
  if (!std::equal(bottom, bottom + 4, E + 12) || !std::isfinite(E[3] + E[7] + E[11])) return false;
  for (int round = 0; round < 2; ++round) {
    Pose<double> T(E);
    const double xx = dot(T.x, T.x), yy = dot(T.y, T.y), zz = dot(T.z, T.z);
    const double xy = dot(T.x, T.y), xz = dot(T.x, T.z), yz = dot(T.y, T.z);
    double off = 0.0;
    for (double error : {xx - 1.0, yy - 1.0, zz - 1.0, xy, xz, yz}) {
      if (!(std::fabs(error) <= 1e-6)) return false;
      off = std::max(off, std::fabs(error));
    }
    if (dot(cross(T.x, T.y), T.z) < 0.0) return false;
    if (off <= 1e-14) return true;
    const Pose<double> nearer{0.5 * ((3.0 - xx) * T.x - xy * T.y - xz * T.z),
        0.5 * ((3.0 - yy) * T.y - xy * T.x - yz * T.z),
        0.5 * ((3.0 - zz) * T.z - xz * T.x - yz * T.y), T.p};
    nearer.write(E);
  }
  return true;
}

void construct(Chain *self, nb::handle frames_, nb::handle prismatic_) {
  const Input prismatic(prismatic_, "prismatic");
  if (prismatic.ndim() != 1 || prismatic.size() < 1 || prismatic.size() > max_joints)
    raise_shape_error("Expected prismatic of shape (n,) with n from 1 to " +
                      std::to_string(max_joints) + " joints, got " + prismatic.shape_text() + ".");
  const int n = static_cast<int>(prismatic.size());
  const Input frames(frames_, "frames", {n + 1, 4, 4});
  std::vector<double> rigid(frames.data(), frames.data() + frames.size());
  for (int i = 0; i <= n; ++i)
    if (!make_rigid(&rigid[16 * i]))
      raise_shape_error(
          "Expected every frame to be a rigid transformation (rotation orthonormal to 1e-6, "
          "determinant 1, last row 0 0 0 1), got one that is not: frames[" +
          std::to_string(i) + "]. Normalise quaternions and rotations first.");
  bool slides[max_joints];
  std::transform(
      prismatic.data(), prismatic.data() + n, slides, [](double kind) { return kind != 0.0; });
  new (self) Chain(n, rigid.data(), slides);
}

nb::object frames(const Chain &self) { return fresh_array({self.n + 1, 4, 4}, self.frames.data()); }

nb::object prismatic(const Chain &self) {
  bool slides[max_joints];
  for (int i = 0; i < self.n; ++i) slides[i] = self.steps[i].slides;
  return fresh_mask(self.n, slides);
}

nb::object forward(const Chain &self, nb::handle q_, nb::handle out, nb::handle threads_) {
  const int threads = thread_count(threads_);
  const Samples q(q_, "q", self.n);
  const Output T(out, "out", {4, 4}, {&q});
  compute<1, 1>(
      q, {q.samples()}, {T.samples()},
      [&](const auto &in, const auto &to) { armlab::forward(self, in[0], to[0]); }, threads);
  return T.array();
}

nb::object jacobian(
    const Chain &self, nb::handle q_, bool tool, nb::handle out, nb::handle threads_) {
  const int threads = thread_count(threads_);
  const Samples q(q_, "q", self.n);
  const Output J(out, "out", {6, self.n}, {&q});
  compute<1, 1>(
      q, {q.samples()}, {J.samples()},
      [&](const auto &in, const auto &to) { armlab::jacobian(self, in[0], tool, to[0]); }, threads);
  return J.array();
}

// The two arrays of `out`, or None twice.
std::array<nb::handle, 2> pair_of(nb::handle out, const char *names) {
  if (out.is_none()) return {out, out};
  if (!PyTuple_Check(out.ptr()) || PyTuple_GET_SIZE(out.ptr()) != 2)
    raise_shape_error("Expected out to be a pair of arrays " + std::string(names) +
                      ", got something else. Give a tuple of two arrays.");
  return {PyTuple_GET_ITEM(out.ptr(), 0), PyTuple_GET_ITEM(out.ptr(), 1)};
}

nb::object forward_jacobian(
    const Chain &self, nb::handle q_, bool tool, nb::handle out, nb::handle threads_) {
  const int threads = thread_count(threads_);
  const auto [out_T, out_J] = pair_of(out, "(T, J)");
  const Samples q(q_, "q", self.n);
  const Output T(out_T, "out[0]", {4, 4}, {&q}), J(out_J, "out[1]", {6, self.n}, {&q});
  J.require_apart_from(T);
  compute<1, 2>(
      q, {q.samples()}, {T.samples(), J.samples()},
      [&](const auto &in, const auto &to) {
        armlab::jacobian(self, in[0], tool, to[1]).write(to[0]);
      },
      threads);
  return nb::make_tuple(T.array(), J.array());
}

nb::object link_transforms(const Chain &self, nb::handle q_, nb::handle out) {
  const Samples q(q_, "q", self.n);
  const Output T(out, "out", {self.n, 4, 4}, {&q});
  compute<1, 1>(q, {q.samples()}, {T.samples()},
      [&](const auto &in, const auto &to) { armlab::link_transforms(self, in[0], to[0]); });
  return T.array();
}

nb::object jacobian_derivative(
    const Chain &self, nb::handle q_, nb::handle qd_, bool tool, nb::handle out) {
  const Samples q(q_, "q", self.n), qd(qd_, "qd", q);
  const Output Jd(out, "out", {6, self.n}, {&q, &qd});
  compute<2, 1>(
      q, {q.samples(), qd.samples()}, {Jd.samples()}, [&](const auto &in, const auto &to) {
        armlab::jacobian_derivative(self, in[0], in[1], tool, to[0]);
      });
  return Jd.array();
}

nb::object rnea(const Chain &self, nb::handle q_, nb::handle qd_, nb::handle qdd_,
    nb::handle gravity_, nb::handle pi_, nb::handle out) {
  const Samples q(q_, "q", self.n), qd(qd_, "qd", q), qdd(qdd_, "qdd", q);
  const Input gravity(gravity_, "gravity", {3}), pi(pi_, "pi", {self.n, 10});
  const Output tau(out, "out", {self.n}, {&q, &qd, &qdd});
  tau.require_apart_from({&gravity, &pi});
  compute<3, 1>(q, {q.samples(), qd.samples(), qdd.samples()}, {tau.samples()},
      [&](const auto &in, const auto &to) {
        armlab::rnea(self, in[0], in[1], in[2], gravity.data(), pi.data(), to[0]);
      });
  return tau.array();
}

nb::object rigid_regressor(const Chain &self, nb::handle q_, nb::handle qd_, nb::handle qdd_,
    nb::handle gravity_, nb::handle out) {
  const Samples q(q_, "q", self.n), qd(qd_, "qd", q), qdd(qdd_, "qdd", q);
  const Input gravity(gravity_, "gravity", {3});
  const Output Y(out, "out", {self.n, 10 * self.n}, {&q, &qd, &qdd});
  Y.require_apart_from({&gravity});
  compute<3, 1>(q, {q.samples(), qd.samples(), qdd.samples()}, {Y.samples()},
      [&](const auto &in, const auto &to) {
        armlab::rigid_regressor(self, in[0], in[1], in[2], gravity.data(), to[0]);
      });
  return Y.array();
}

nb::object mass_matrix(const Chain &self, nb::handle q_, nb::handle pi_, nb::handle out) {
  const Samples q(q_, "q", self.n);
  const Input pi(pi_, "pi", {self.n, 10});
  const Output M(out, "out", {self.n, self.n}, {&q});
  M.require_apart_from({&pi});
  compute<1, 1>(q, {q.samples()}, {M.samples()},
      [&](const auto &in, const auto &to) { armlab::mass_matrix(self, in[0], pi.data(), to[0]); });
  return M.array();
}

nb::object momentum(
    const Chain &self, nb::handle q_, nb::handle qd_, nb::handle pi_, nb::handle out) {
  const auto [out_p, out_beta] = pair_of(out, "(p, beta)");
  const Samples q(q_, "q", self.n), qd(qd_, "qd", q);
  const Input pi(pi_, "pi", {self.n, 10});
  const Output p(out_p, "out[0]", {self.n}, {&q, &qd}),
      beta(out_beta, "out[1]", {self.n}, {&q, &qd});
  for (const Output *output : {&p, &beta}) output->require_apart_from({&pi});
  beta.require_apart_from(p);
  compute<2, 2>(q, {q.samples(), qd.samples()}, {p.samples(), beta.samples()},
      [&](const auto &in, const auto &to) {
        armlab::momentum(self, in[0], in[1], pi.data(), to[0], to[1]);
      });
  return nb::make_tuple(p.array(), beta.array());
}

nb::object reduce(nb::handle self) {
  const Chain &chain = nb::cast<const Chain &>(self);
  return nb::make_tuple(self.type(), nb::make_tuple(frames(chain), prismatic(chain)));
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_chain(nb::module_ &m) {
  nb::class_<Chain>(m, "Chain", "A serial chain, immutable; _native.pyi documents it.")
      .def("__init__", &construct, array("frames"), array("prismatic"))
      .def_ro("n", &Chain::n)
      .def_prop_ro("frames", &frames)
      .def_prop_ro("prismatic", &prismatic)
      .def("__reduce__", &reduce)
      .def("forward", &forward, array("q"), arg("out") = nb::none(), arg("threads").none() = 1)
      .def("jacobian", &jacobian, array("q"), arg("tool") = false, arg("out") = nb::none(),
          arg("threads").none() = 1)
      .def("forward_jacobian", &forward_jacobian, array("q"), arg("tool") = false,
          arg("out") = nb::none(), arg("threads").none() = 1)
      .def("link_transforms", &link_transforms, array("q"), arg("out") = nb::none())
      .def("jacobian_derivative", &jacobian_derivative, array("q"), array("qd"),
          arg("tool") = false, arg("out") = nb::none())
      .def("rnea", &rnea, array("q"), array("qd"), array("qdd"), array("gravity"), array("pi"),
          arg("out") = nb::none())
      .def("rigid_regressor", &rigid_regressor, array("q"), array("qd"), array("qdd"),
          array("gravity"), arg("out") = nb::none())
      .def("mass_matrix", &mass_matrix, array("q"), array("pi"), arg("out") = nb::none())
      .def("momentum", &momentum, array("q"), array("qd"), array("pi"), arg("out") = nb::none());
}
