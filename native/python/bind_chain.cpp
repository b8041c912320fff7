// Python class Chain: checks arguments; mathematics in kinematics.h and rigid_body.h.
#include "array/arrays.h"
#include "math/arm/rigid_body.h"

namespace armlab::python {
namespace {

// Orthonormalises R by Newton steps towards the nearest rotation. Raises if the error exceeds 1e-6;
// keeps R if it is orthonormal to rounding.
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
          "determinant 1, last row 0 0 0 1), got an invalid one: frames[" +
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

nb::object forward(const Chain &self, nb::handle q, nb::handle out, nb::handle threads) {
  const auto kernel = [&](const auto &in, const auto &to) { armlab::forward(self, in[0], to[0]); };
  return over(
      out, std::array{Tail{4, 4}}, {}, thread_count(threads), kernel, Samples(q, "q", {self.n}));
}

nb::object jacobian(
    const Chain &self, nb::handle q, bool tool, nb::handle out, nb::handle threads) {
  const auto kernel = [&](const auto &in, const auto &to) {
    armlab::jacobian(self, in[0], tool, to[0]);
  };
  return over(out, std::array{Tail{6, self.n}}, {}, thread_count(threads), kernel,
      Samples(q, "q", {self.n}));
}

nb::object forward_jacobian(
    const Chain &self, nb::handle q, bool tool, nb::handle out, nb::handle threads) {
  const auto kernel = [&](const auto &in, const auto &to) {
    armlab::jacobian(self, in[0], tool, to[1]).write(to[0]);
  };
  return over(out, std::array{Tail{4, 4}, Tail{6, self.n}}, {}, thread_count(threads), kernel,
      Samples(q, "q", {self.n}));
}

nb::object link_transforms(const Chain &self, nb::handle q, nb::handle out) {
  const auto kernel = [&](const auto &in, const auto &to) {
    armlab::link_transforms(self, in[0], to[0]);
  };
  return over(out, std::array{Tail{self.n, 4, 4}}, {}, 1, kernel, Samples(q, "q", {self.n}));
}

nb::object jacobian_derivative(
    const Chain &self, nb::handle q_, nb::handle qd_, bool tool, nb::handle out) {
  const Samples q(q_, "q", {self.n}), qd(qd_, "qd", {self.n});
  const auto kernel = [&](const auto &in, const auto &to) {
    armlab::jacobian_derivative(self, in[0], in[1], tool, to[0]);
  };
  return over(out, std::array{Tail{6, self.n}}, {}, 1, kernel, Samples(q), Samples(qd));
}

nb::object rigid_regressor(const Chain &self, nb::handle q_, nb::handle qd_, nb::handle qdd_,
    nb::handle gravity_, nb::handle out) {
  const npy_intp n = self.n;
  const Samples q(q_, "q", {n}), qd(qd_, "qd", {n}), qdd(qdd_, "qdd", {n});
  const Input gravity(gravity_, "gravity", {3});
  const auto kernel = [&](const auto &in, const auto &to) {
    armlab::rigid_regressor(self, in[0], in[1], in[2], gravity.data(), to[0]);
  };
  return over(out, std::array{Tail{n, 10 * n}}, {&gravity}, 1, kernel, Samples(q), Samples(qd),
      Samples(qdd));
}

nb::object torque_of(const Chain &self, nb::handle q_, nb::handle qd_, nb::handle qdd_,
    nb::handle gravity_, nb::handle links_, nb::handle out) {
  const npy_intp n = self.n;
  const Samples q(q_, "q", {n}), qd(qd_, "qd", {n}), qdd(qdd_, "qdd", {n});
  const Input gravity(gravity_, "gravity", {3}), links(links_, "pi", {n, 10});
  const auto kernel = [&](const auto &in, const auto &to) {
    armlab::rnea({self, gravity.data(), links.data()}, in[0], in[1], in[2], to[0]);
  };
  return over(out, std::array{Tail{n}}, {&gravity, &links}, 1, kernel, Samples(q), Samples(qd),
      Samples(qdd));
}

nb::object reduce(nb::handle self) {
  const Chain &chain = nb::cast<const Chain &>(self);
  return nb::make_tuple(self.type(), nb::make_tuple(frames(chain), prismatic(chain)));
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_chain(nb::module_ &m) {
  const auto out = [] { return arg("out") = nb::none(); };
  const auto threads = [] { return arg("threads").none() = 1; };
  auto chain =
      nb::class_<Chain>(m, "Chain", "A serial chain, immutable; _native.pyi documents it.");
  chain.def("__init__", &construct, array("frames"), array("prismatic"))
      .def_ro("n", &Chain::n)
      .def_prop_ro("frames", &frames)
      .def_prop_ro("prismatic", &prismatic)
      .def("__reduce__", &reduce)
      .def("forward", &forward, array("q"), out(), threads())
      .def("jacobian", &jacobian, array("q"), arg("tool") = false, out(), threads())
      .def("forward_jacobian", &forward_jacobian, array("q"), arg("tool") = false, out(), threads())
      .def("link_transforms", &link_transforms, array("q"), out())
      .def("jacobian_derivative", &jacobian_derivative, array("q"), array("qd"),
          arg("tool") = false, out())
      .def("rigid_regressor", &rigid_regressor, array("q"), array("qd"), array("qdd"),
          array("gravity"), out())
      .def("rnea", &torque_of, array("q"), array("qd"), array("qdd"), array("gravity"), array("pi"),
          out());
}
