// Python functions of the Lie groups: arguments are checked in lie_arguments, the mathematics is in
// lie.h and se3.h.
#include "array/arrays.h"
#include "math/lie/euler.h"
#include "math/lie/lie.h"
#include "array/lie_arguments.h"
#include "math/lie/se3.h"

namespace armlab::python {
namespace {

using Tail = std::initializer_list<npy_intp>;

// Runs a kernel that tells whether its arguments look right; says whether all did.
template <std::size_t Ins, class Kernel>
bool looks_right(
    const Samples &first, const std::array<Reading, Ins> &ins, const Output &out, Kernel kernel) {
  bool right = true;
  compute<Ins, 1>(first, ins, {out.samples()},
      [&right, kernel](const auto &in, const auto &to) { right &= kernel(in, to[0]); });
  return right;
}

// kernel(numbers, out) of vectors, of which none is wrong.
template <class Kernel>
nb::object of_vectors(
    nb::handle value, const char *name, npy_intp n, nb::handle out_, Tail tail, Kernel kernel) {
  const Elements w(value, name, {n});
  const Output out(out_, "out", tail, {&w});
  compute<1, 1>(w, {w.samples()}, {out.samples()},
      [kernel](const auto &in, const auto &to) { kernel(in[0], to[0]); });
  return out.array();
}

// kernel(Rotation, out).
template <class Kernel>
nb::object of_rotations(
    nb::handle value, const char *name, nb::handle out_, Tail tail, Kernel kernel) {
  const Elements R(value, name, {3, 3});
  const Output out(out_, "out", tail, {&R});
  const bool right = looks_right<1>(R, {R.samples()}, out, [kernel](const auto &in, auto *to) {
    const auto rotation = rotation_at(in[0], 3);
    kernel(rotation, to);
    return looks_orthonormal(rotation);
  });
  if (!right) refuse_no_rotation(R, name);
  return out.array();
}

// kernel(Pose, out).
template <class Kernel>
nb::object of_poses(nb::handle value, const char *name, nb::handle out_, Tail tail, Kernel kernel) {
  const Elements T(value, name, {4, 4});
  const Output out(out_, "out", tail, {&T});
  const bool right = looks_right<1>(T, {T.samples()}, out, [kernel](const auto &in, auto *to) {
    kernel(pose_at(in[0]), to);
    return looks_rigid(in[0]);
  });
  if (!right) refuse_no_pose(T, name);
  return out.array();
}

nb::object rotations(nb::handle value, const char *name) {
  const Elements R(value, name, {3, 3});
  bool right = true;
  compute<1, 0>(R, {R.samples()}, {}, [&right](const auto &in, const auto &) {
    right &= looks_orthonormal(rotation_at(in[0], 3));
  });
  if (!right) refuse_no_rotation(R, name);
  return R.object();
}

nb::object poses(nb::handle value, const char *name) {
  const Elements T(value, name, {4, 4});
  bool right = true;
  compute<1, 0>(T, {T.samples()}, {},
      [&right](const auto &in, const auto &) { right &= looks_rigid(in[0]); });
  if (!right) refuse_no_pose(T, name);
  return T.object();
}

nb::object so3_exp(nb::handle w_, nb::handle out) {
  return of_vectors(
      w_, "w", 3, out, {3, 3}, [](auto *w, auto *R) { armlab::so3_exp(vector_at(w)).write(R, 3); });
}

nb::object so3_log(nb::handle R_, nb::handle out) {
  return of_rotations(
      R_, "R", out, {3}, [](const auto &R, auto *w) { write(armlab::so3_log(R), w); });
}

nb::object so3_angle(nb::handle R_a_, nb::handle R_b_, nb::handle out_) {
  Elements R_a(R_a_, "R_a", {3, 3}), R_b(R_b_, "R_b", {3, 3});
  Elements::broadcast({&R_a, &R_b});
  const Output out(out_, "out", {}, {&R_a, &R_b});
  const bool right =
      looks_right<2>(R_a, {R_a.samples(), R_b.samples()}, out, [](const auto &in, auto *angle) {
        const auto a = rotation_at(in[0], 3), b = rotation_at(in[1], 3);
        *angle = armlab::so3_angle(a.inverse() * b);
        return looks_orthonormal(a) & looks_orthonormal(b);
      });
  if (!right) {
    refuse_no_rotation(R_a, "R_a");
    refuse_no_rotation(R_b, "R_b");
  }
  return out.array();
}

nb::object so3_interpolate(nb::handle R_a_, nb::handle R_b_, nb::handle s_, nb::handle out_) {
  Elements R_a(R_a_, "R_a", {3, 3}), R_b(R_b_, "R_b", {3, 3}), s(s_, "s", {});
  Elements::broadcast({&R_a, &R_b, &s});
  const Output out(out_, "out", {3, 3}, {&R_a, &R_b, &s});
  const auto ins = std::array{R_a.samples(), R_b.samples(), s.samples()};
  const bool right = looks_right<3>(R_a, ins, out, [](const auto &in, auto *R) {
    const auto a = rotation_at(in[0], 3), b = rotation_at(in[1], 3);
    armlab::so3_interpolate(a, b, *in[2]).write(R, 3);
    return looks_orthonormal(a) & looks_orthonormal(b);
  });
  if (!right) {
    refuse_no_rotation(R_a, "R_a");
    refuse_no_rotation(R_b, "R_b");
  }
  return out.array();
}

nb::object so3_left_jacobian(nb::handle w_, nb::handle out) {
  return of_vectors(w_, "w", 3, out, {3, 3}, [](auto *numbers, auto *J) {
    const auto w = vector_at(numbers);
    const Angle t(w);
    polynomial(w, t.versine(), cubic(t)).write(J, 3);
  });
}

nb::object so3_left_jacobian_inv(nb::handle w_, nb::handle out) {
  return of_vectors(w_, "w", 3, out, {3, 3}, [](auto *numbers, auto *J) {
    const auto w = vector_at(numbers);
    const auto f = left_jacobian_inv_polynomial(Angle(w));
    polynomial(w, f.a, f.b).write(J, 3);
  });
}

nb::object se3_exp(nb::handle xi_, nb::handle out) {
  return of_vectors(xi_, "xi", 6, out, {4, 4},
      [](auto *xi, auto *T) { armlab::se3_exp(vector_at(xi), vector_at(xi + 3)).write(T); });
}

nb::object se3_log(nb::handle T_, nb::handle out) {
  return of_poses(T_, "T", out, {6}, [](const auto &T, auto *xi) {
    auto v = T.p, w = T.p;
    armlab::se3_log(T, v, w);
    write(v, xi);
    write(w, xi + 3);
  });
}

nb::object se3_inv(nb::handle T_, nb::handle out) {
  return of_poses(
      T_, "T", out, {4, 4}, [](const auto &T, auto *inverse) { pose_inverse(T).write(inverse); });
}

nb::object se3_adjoint(nb::handle T_, nb::handle out) {
  return of_poses(T_, "T_a_b", out, {6, 6}, [](const auto &T, auto *Ad) {
    const auto p = T.p;
    write_blocks({T.x, T.y, T.z}, {cross(p, T.x), cross(p, T.y), cross(p, T.z)}, Ad);
  });
}

nb::object se3_transform_wrench(nb::handle T_, nb::handle wrench_, nb::handle out_) {
  Elements T(T_, "T_a_b", {4, 4}), wrench(wrench_, "wrench_b", {6});
  Elements::broadcast({&T, &wrench});
  const Output out(out_, "out", {6}, {&T, &wrench});
  const bool right =
      looks_right<2>(T, {T.samples(), wrench.samples()}, out, [](const auto &in, auto *wrench_a) {
        const auto pose = pose_at(in[0]);
        const auto f = pose.turn(vector_at(in[1]));
        write(f, wrench_a);
        write(pose.turn(vector_at(in[1] + 3)) + cross(pose.p, f), wrench_a + 3);
        return looks_rigid(in[0]);
      });
  if (!right) refuse_no_pose(T, "T_a_b");
  return out.array();
}

nb::object se3_interpolate(
    nb::handle T_a_, nb::handle T_b_, nb::handle s_, bool screw, nb::handle out_) {
  Elements T_a(T_a_, "T_a", {4, 4}), T_b(T_b_, "T_b", {4, 4}), s(s_, "s", {});
  Elements::broadcast({&T_a, &T_b, &s});
  const Output out(out_, "out", {4, 4}, {&T_a, &T_b, &s});
  const auto ins = std::array{T_a.samples(), T_b.samples(), s.samples()};
  const bool right = looks_right<3>(T_a, ins, out, [screw](const auto &in, auto *T) {
    armlab::se3_interpolate(pose_at(in[0]), pose_at(in[1]), *in[2], screw).write(T);
    return looks_rigid(in[0]) & looks_rigid(in[1]);
  });
  if (!right) {
    refuse_no_pose(T_a, "T_a");
    refuse_no_pose(T_b, "T_b");
  }
  return out.array();
}

nb::object se3_left_jacobian(nb::handle xi_, nb::handle out) {
  return of_vectors(xi_, "xi", 6, out, {6, 6}, [](auto *xi, auto *J) {
    const auto v = vector_at(xi), w = vector_at(xi + 3);
    const auto f = left_jacobian_polynomial(Angle(w));
    write_blocks(polynomial(w, f.a, f.b), derivative(w, v, f), J);
  });
}

nb::object se3_left_jacobian_inv(nb::handle xi_, nb::handle out) {
  return of_vectors(xi_, "xi", 6, out, {6, 6}, [](auto *xi, auto *J) {
    const auto v = vector_at(xi), w = vector_at(xi + 3);
    const auto f = left_jacobian_inv_polynomial(Angle(w));
    write_blocks(polynomial(w, f.a, f.b), derivative(w, v, f), J);
  });
}

nb::object quaternion_from_matrix(nb::handle R_, nb::handle out) {
  return of_rotations(
      R_, "R", out, {4}, [](const auto &R, auto *q) { write(quaternion_from(R), q); });
}

nb::object quaternion_to_matrix(nb::handle quaternion, nb::handle out_) {
  const Elements q(quaternion, "quaternion", {4});
  const Output out(out_, "out", {3, 3}, {&q});
  const bool right = looks_right<1>(q, {q.samples()}, out, [](const auto &in, auto *R) {
    const auto wxyz = quaternion_at(in[0]);
    rotation_from(wxyz).write(R, 3);
    return looks_unit(norm(wxyz));
  });
  if (!right) refuse_not_unit(q);
  return out.array();
}

nb::object quaternion_multiply(nb::handle p_, nb::handle q_, nb::handle out_) {
  Elements p(p_, "p", {4}), q(q_, "q", {4});
  Elements::broadcast({&p, &q});
  const Output out(out_, "out", {4}, {&p, &q});
  compute<2, 1>(p, {p.samples(), q.samples()}, {out.samples()}, [](const auto &in, const auto &to) {
    write(quaternion_at(in[0]) * quaternion_at(in[1]), to[0]);
  });
  return out.array();
}

nb::object quaternion_slerp(nb::handle a_, nb::handle b_, nb::handle s_, nb::handle out_) {
  Elements a(a_, "a", {4}), b(b_, "b", {4}), s(s_, "s", {});
  Elements::broadcast({&a, &b, &s});
  const Output out(out_, "out", {4}, {&a, &b, &s});
  const bool right =
      looks_right<3>(a, {a.samples(), b.samples(), s.samples()}, out, [](const auto &in, auto *q) {
        const auto begin = quaternion_at(in[0]), end = quaternion_at(in[1]);
        write(slerp(unit(begin), unit(end), *in[2]), q);
        return looks_unit(norm(begin)) & looks_unit(norm(end));
      });
  if (!right) {
    refuse_not_unit(a);
    refuse_not_unit(b);
  }
  return out.array();
}

nb::object euler_from_rpy(nb::handle rpy_, int first, int middle, int last, nb::handle out) {
  const Axes axes{first, middle, last};
  return of_vectors(rpy_, "rpy", 3, out, {3, 3},
      [axes](auto *rpy, auto *R) { matrix_from_angles(rpy, axes, R); });
}

nb::object euler_to_rpy(nb::handle R_, int first, int middle, int last, nb::handle out_) {
  const Axes axes{first, middle, last};
  const Elements R(R_, "R", {3, 3});
  const Output out(out_, "out", {3}, {&R});
  const bool right = looks_right<1>(R, {R.samples()}, out, [axes](const auto &in, auto *rpy) {
    angles_from_matrix(in[0], axes, rpy);
    return looks_orthonormal(rotation_at(in[0], 3));
  });
  if (!right) refuse_no_rotation(R, "R");
  return out.array();
}

}  // namespace

void bind_lie_functions(nb::module_ &m) {
  const auto def = [&m](const char *name, auto function, const char *argument) {
    m.def(name, function, array(argument), nb::arg("out") = nb::none());
  };
  def("so3_exp", &so3_exp, "w");
  def("so3_log", &so3_log, "R");
  def("so3_left_jacobian", &so3_left_jacobian, "w");
  def("so3_left_jacobian_inv", &so3_left_jacobian_inv, "w");
  def("se3_exp", &se3_exp, "xi");
  def("se3_log", &se3_log, "T");
  def("se3_inv", &se3_inv, "T");
  def("se3_adjoint", &se3_adjoint, "T_a_b");
  def("se3_left_jacobian", &se3_left_jacobian, "xi");
  def("se3_left_jacobian_inv", &se3_left_jacobian_inv, "xi");
  def("quaternion_from_matrix", &quaternion_from_matrix, "R");
  def("quaternion_to_matrix", &quaternion_to_matrix, "quaternion");

  using nb::arg;
  m.def("rotations", &rotations, array("R"), arg("name"));
  m.def("poses", &poses, array("T"), arg("name"));
  m.def("so3_angle", &so3_angle, array("R_a"), array("R_b"), arg("out") = nb::none());
  m.def("so3_interpolate", &so3_interpolate, array("R_a"), array("R_b"), array("s"),
      arg("out") = nb::none());
  m.def("se3_transform_wrench", &se3_transform_wrench, array("T_a_b"), array("wrench_b"),
      arg("out") = nb::none());
  m.def("se3_interpolate", &se3_interpolate, array("T_a"), array("T_b"), array("s"),
      arg("screw") = false, arg("out") = nb::none());
  m.def("euler_from_rpy", &euler_from_rpy, array("rpy"), arg("first"), arg("middle"), arg("last"),
      arg("out") = nb::none());
  m.def("euler_to_rpy", &euler_to_rpy, array("R"), arg("first"), arg("middle"), arg("last"),
      arg("out") = nb::none());
  m.def(
      "quaternion_multiply", &quaternion_multiply, array("p"), array("q"), arg("out") = nb::none());
  m.def("quaternion_slerp", &quaternion_slerp, array("a"), array("b"), array("s"),
      arg("out") = nb::none());
}

}  // namespace armlab::python

void bind_lie(nb::module_ &m) { armlab::python::bind_lie_functions(m); }
