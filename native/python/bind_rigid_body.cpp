// Python class RigidBody: checks arguments; mathematics in rigid_body.h.
#include "array/arrays.h"
#include "math/arm/rigid_body.h"

namespace armlab::python {
namespace {

void construct_body(RigidBody *self, const Chain &chain, nb::handle gravity_, nb::handle links_,
    nb::handle motors_) {
  const npy_intp n = chain.n;
  const Input gravity(gravity_, "gravity", {3}), links(links_, "pi", {n, 10});
  new (self) RigidBody{chain, {}, {}, {}};
  std::copy_n(gravity.data(), 3, self->gravity.begin());
  std::copy_n(links.data(), 10 * n, self->links.begin());
  if (motors_.is_none()) return;
  const Input motors(motors_, "motors", {n, n});
  self->motors.assign(motors.data(), motors.data() + n * n);
}

// Raises an error for the first q whose mass matrix is not positive definite, including NaN.
void refuse_massless(const Bodies &arm, const Samples &q) {
  const int n = arm.chain.n;
  const double still[max_joints]{};
  double qdd[max_joints];
  for (npy_intp k = 0; k < q.size() / n; ++k)
    if (finite(q.data() + k * n, n) &&
        !forward_dynamics<double>(arm, q.data() + k * n, still, still, nullptr, qdd))
      raise("RobotError",
          "Expected a positive definite mass matrix, got another matrix at " +
              place("q", k, q.shape(), q.batch_axes()) +
              ": some joint motion moves no mass. Give every moving link a mass and moments of "
              "inertia, or make a model physical with identify.physically_consistent.");
}

constexpr double weightless[3]{};

Samples joints(const RigidBody &self, nb::handle value, const char *name) {
  return Samples(value, name, {self.chain.n});
}

// Defines a method that runs kernel(arm, in, wrench, to) on the first `count` of q, qd and a third
// quantity. With all three, `wrench` is f_ext, or null if it is not given. Results have shape
// (n,) * axes. The kernel returns whether M is positive definite.
template <int count, std::size_t Outs, class Kernel>
void def(nb::class_<RigidBody> &body, const char *name, const char *third,
    std::array<int, Outs> axes, Kernel kernel) {
  const auto run = [=](const RigidBody &self, nb::handle out, bool pushed, auto... given) {
    const Bodies arm = self.bodies();
    bool definite = true;
    const auto of_arm = [&](const auto &in, const auto &to) {
      std::decay_t<decltype(in[0])> wrench = nullptr;
      if constexpr (sizeof...(given) == 4) wrench = pushed ? in[3] : nullptr;
      definite &= kernel(arm, in, wrench, to);
    };
    std::array<Tail, Outs> shapes{};
    for (std::size_t k = 0; k < Outs; ++k)
      (shapes[k] = Tail{arm.chain.n, arm.chain.n}).axes = axes[k];
    const nb::object found = over(out, shapes, {}, 1, of_arm, given...);
    if (!definite) refuse_massless(arm, std::get<0>(std::tie(given...)));
    return found;
  };
  const auto none = [](const char *argument) { return arg(argument) = nb::none(); };
  if constexpr (count == 1) {
    const auto of = [=](const RigidBody &self, nb::handle q, nb::handle out) {
      return run(self, out, false, joints(self, q, "q"));
    };
    body.def(name, of, array("q"), none("out"));
  } else if constexpr (count == 2) {
    const auto of = [=](const RigidBody &self, nb::handle q_, nb::handle qd_, nb::handle out) {
      const Samples q = joints(self, q_, "q"), qd = joints(self, qd_, "qd");
      return run(self, out, false, q, qd);
    };
    body.def(name, of, array("q"), array("qd"), none("out"));
  } else {
    const auto of = [=](const RigidBody &self, nb::handle q_, nb::handle qd_, nb::handle x_,
                        nb::handle f_ext, nb::handle out) {
      const Samples q = joints(self, q_, "q"), qd = joints(self, qd_, "qd"),
                    x = joints(self, x_, third);
      const bool pushed = !f_ext.is_none();  // if not, q is a placeholder
      return run(self, out, pushed, q, qd, x, pushed ? Samples(f_ext, "f_ext", {6}) : q);
    };
    body.def(name, of, array("q"), array("qd"), array(third), none("f_ext"), none("out"));
  }
}

nb::object reduce_body(nb::handle self) {
  const RigidBody &body = nb::cast<const RigidBody &>(self);
  const npy_intp n = body.chain.n;
  return nb::make_tuple(
      self.type(), nb::make_tuple(body.chain, fresh_array({3}, body.gravity.data()),
                       fresh_array({n, 10}, body.links.data()),
                       body.motors.empty() ? nb::none() : fresh_array({n, n}, body.motors.data())));
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_rigid_body(nb::module_ &m) {
  auto body =
      nb::class_<RigidBody>(m, "RigidBody", "A chain with masses; _native.pyi documents it.");
  body.def("__init__", &construct_body, arg("chain"), array("gravity"), array("pi"),
          arg("motors") = nb::none())
      .def("__reduce__", &reduce_body);
  def<3>(body, "rnea", "qdd", std::array{1}, [](auto &arm, auto &in, auto wrench, auto &to) {
    rnea(arm, in[0], in[1], in[2], to[0], wrench);
    return true;
  });
  def<3>(body, "rnea_derivatives", "qdd", std::array{2, 2, 2},
      [](auto &arm, auto &in, auto wrench, auto &to) {
        rnea_derivatives(arm, in[0], in[1], in[2], wrench, to[0], to[1]);
        mass_matrix(arm, in[0], to[2]);
        return true;
      });
  def<3>(body, "forward_dynamics", "tau", std::array{1},
      [](auto &arm, auto &in, auto wrench, auto &to) {
        return forward_dynamics(arm, in[0], in[1], in[2], wrench, to[0]);
      });
  def<3>(body, "forward_dynamics_derivatives", "tau", std::array{2, 2, 2},
      [](auto &arm, auto &in, auto wrench, auto &to) {
        std::decay_t<decltype(*to[0])> qdd[max_joints];
        return forward_dynamics(arm, in[0], in[1], in[2], wrench, qdd, to[0], to[1], to[2]);
      });
  def<1>(body, "gravity_torque", "", std::array{1}, [](auto &arm, auto &in, auto, auto &to) {
    gravity_torque(arm, in[0], to[0]);
    return true;
  });
  def<2>(
      body, "coriolis_torque", "", std::array{1}, [](auto &arm, auto &in, auto wrench, auto &to) {
        const std::decay_t<decltype(*to[0])> still[max_joints]{};
        rnea({arm.chain, weightless, arm.links}, in[0], in[1], still, to[0], wrench);
        return true;
      });
  def<2>(
      body, "coriolis_matrix", "", std::array{2}, [](auto &arm, auto &in, auto wrench, auto &to) {
        using Real = std::decay_t<decltype(*to[0])>;
        const Real still[max_joints]{};
        rnea_derivatives<Real>(arm, in[0], in[1], still, wrench, nullptr, to[0]);
        for (int k = 0; k < arm.chain.n * arm.chain.n; ++k) to[0][k] = Real(0.5) * to[0][k];
        return true;
      });
  def<1>(body, "mass_matrix", "", std::array{2}, [](auto &arm, auto &in, auto, auto &to) {
    mass_matrix(arm, in[0], to[0]);
    return true;
  });
  def<2>(body, "momentum", "", std::array{1, 1}, [](auto &arm, auto &in, auto, auto &to) {
    momentum(arm, in[0], in[1], to[0], to[1]);
    return true;
  });
  def<2>(body, "energy", "", std::array{0, 0}, [](auto &arm, auto &in, auto, auto &to) {
    energy(arm, in[0], in[1], to[0], to[1]);
    return true;
  });
}
