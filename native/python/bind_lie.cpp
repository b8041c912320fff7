// Python functions for Lie groups; mathematics in lie.h, se3.h and euler.h.
#include "array/lie_arguments.h"
#include "math/lie/euler.h"
#include "math/lie/se3.h"

namespace armlab::python {
namespace {

template <npy_intp...>
struct Shape {};

// Rejects the first sample that is not a rotation (3, 3), pose (4, 4) or unit quaternion (4,).
void refuse_wrong(const Samples &given) {
  const int width = given.samples().width;
  if (width == 9) refuse_no_rotation(given, given.name());
  if (width == 16) refuse_no_pose(given, given.name());
  if (width == 4) refuse_not_unit(given);
}

// Rejects invalid samples one by one, and replaces rounded rotations with exact ones.
void correct(Samples &given) {
  refuse_wrong(given);
  if (given.samples().width >= 9) restore_digits(given);
}

// Runs kernel(in, out) over broadcast leading axes; it returns whether the arguments look valid.
template <class Kernel, class... Given>
nb::object over(
    nb::handle out, std::initializer_list<npy_intp> tail, Kernel kernel, Given &...given) {
  bool right = true;
  const auto checking = [&](const auto &in, const auto &to) { right &= kernel(in, to[0]); };
  const nb::object found = armlab::over(out, std::array{Tail(tail)}, {}, 1, checking, given...);
  if (right) return found;
  (correct(given), ...);
  return armlab::over(found, std::array{Tail(tail)}, {}, 1, checking, given...);
}

// Binds a function of one argument: kernel(in, out) for one sample.
template <npy_intp... in, npy_intp... out, class Kernel>
void def(nb::module_ &m, const char *name, const char *argument, Shape<in...>, Shape<out...>,
    Kernel kernel) {
  const auto function = [argument, kernel](nb::handle value, nb::handle to) {
    Samples given(value, argument, {in...});
    return over(to, {out...}, [kernel](const auto &x, auto *y) { return kernel(x[0], y); }, given);
  };
  m.def(name, function, array(argument), arg("out") = nb::none());
}

// Validates all samples and returns the argument, copied if rotations were rounded.
template <class Looks>
nb::object checked(nb::handle value, const char *name, npy_intp n, Looks looks) {
  Samples given(value, name, {n, n});
  bool right = true;
  compute<1, 0>(given, {given.samples()}, {},
      [&right, looks](const auto &in, const auto &) { right &= looks(in[0]); });
  if (!right) correct(given);
  return given.object();
}

void def_groups(nb::module_ &m) {
  const auto of_vectors = [&m](auto name, auto argument, auto in, auto out, auto kernel) {
    def(m, name, argument, in, out, [kernel](auto *x, auto *y) {
      kernel(x, y);
      return true;
    });
  };
  const auto of_rotations = [&m](auto name, auto argument, auto out, auto kernel) {
    def(m, name, argument, Shape<3, 3>(), out, [kernel](auto *x, auto *y) {
      const auto R = rotation_at(x, 3);
      kernel(R, y);
      return looks_orthonormal(R);
    });
  };
  const auto of_poses = [&m](auto name, auto argument, auto out, auto kernel) {
    def(m, name, argument, Shape<4, 4>(), out, [kernel](auto *x, auto *y) {
      kernel(pose_at(x), y);
      return looks_rigid(x);
    });
  };
  const Shape<3> vector;
  const Shape<4> quaternion;
  const Shape<6> twist;
  const Shape<3, 3> square;
  const Shape<4, 4> pose;
  const Shape<6, 6> blocks;

  of_vectors(
      "so3_exp", "w", vector, square, [](auto *w, auto *R) { so3_exp(vector_at(w)).write(R, 3); });
  of_rotations("so3_log", "R", vector, [](const auto &R, auto *w) { so3_log(R).write(w); });
  of_vectors("so3_left_jacobian", "w", vector, square, [](auto *numbers, auto *J) {
    const auto w = vector_at(numbers);
    const Angle t(w);
    polynomial(w, t.versine(), cubic(t)).write(J, 3);
  });
  of_vectors("so3_left_jacobian_inv", "w", vector, square, [](auto *numbers, auto *J) {
    const auto w = vector_at(numbers);
    const auto f = left_jacobian_inv_polynomial(Angle(w));
    polynomial(w, f.a, f.b).write(J, 3);
  });
  of_vectors("se3_exp", "xi", twist, pose,
      [](auto *xi, auto *T) { se3_exp(vector_at(xi), vector_at(xi + 3)).write(T); });
  of_poses("se3_log", "T", twist, [](const auto &T, auto *xi) {
    auto v = T.p, w = T.p;
    se3_log(T, v, w);
    v.write(xi);
    w.write(xi + 3);
  });
  of_poses("se3_inv", "T", pose, [](const auto &T, auto *to) { pose_inverse(T).write(to); });
  of_poses("se3_adjoint", "T_a_b", blocks, [](const auto &T, auto *Ad) {
    const auto p = T.p;
    write_blocks({T.x, T.y, T.z}, {cross(p, T.x), cross(p, T.y), cross(p, T.z)}, Ad);
  });
  of_vectors("se3_left_jacobian", "xi", twist, blocks, [](auto *xi, auto *J) {
    const auto v = vector_at(xi), w = vector_at(xi + 3);
    const auto f = left_jacobian_polynomial(Angle(w));
    write_blocks(polynomial(w, f.a, f.b), derivative(w, v, f), J);
  });
  of_vectors("se3_left_jacobian_inv", "xi", twist, blocks, [](auto *xi, auto *J) {
    const auto v = vector_at(xi), w = vector_at(xi + 3);
    const auto f = left_jacobian_inv_polynomial(Angle(w));
    write_blocks(polynomial(w, f.a, f.b), derivative(w, v, f), J);
  });
  of_rotations("quaternion_from_matrix", "R", quaternion,
      [](const auto &R, auto *q) { write(quaternion_from(R), q); });
  def(m, "quaternion_to_matrix", "quaternion", quaternion, square, [](auto *q, auto *R) {
    const auto wxyz = quaternion_at(q);
    rotation_from(wxyz).write(R, 3);
    return looks_unit(norm(wxyz));
  });
}

nb::object angle(nb::handle R_a, nb::handle R_b, nb::handle out) {
  Samples a(R_a, "R_a", {3, 3}), b(R_b, "R_b", {3, 3});
  const auto kernel = [](const auto &in, auto *angle) {
    const auto A = rotation_at(in[0], 3), B = rotation_at(in[1], 3);
    *angle = so3_angle(A.inverse() * B);
    return looks_orthonormal(A) & looks_orthonormal(B);
  };
  return over(out, {}, kernel, a, b);
}

nb::object between_rotations(nb::handle R_a, nb::handle R_b, nb::handle s_, nb::handle out) {
  Samples a(R_a, "R_a", {3, 3}), b(R_b, "R_b", {3, 3}), s(s_, "s", {});
  const auto kernel = [](const auto &in, auto *R) {
    const auto A = rotation_at(in[0], 3), B = rotation_at(in[1], 3);
    so3_interpolate(A, B, *in[2]).write(R, 3);
    return looks_orthonormal(A) & looks_orthonormal(B);
  };
  return over(out, {3, 3}, kernel, a, b, s);
}

nb::object transform_wrench(nb::handle T_a_b, nb::handle wrench_b, nb::handle out) {
  Samples T(T_a_b, "T_a_b", {4, 4}), wrench(wrench_b, "wrench_b", {6});
  const auto kernel = [](const auto &in, auto *wrench_a) {
    const auto pose = pose_at(in[0]);
    const auto f = pose.turn(vector_at(in[1]));
    f.write(wrench_a);
    (pose.turn(vector_at(in[1] + 3)) + cross(pose.p, f)).write(wrench_a + 3);
    return looks_rigid(in[0]);
  };
  return over(out, {6}, kernel, T, wrench);
}

nb::object between_poses(
    nb::handle T_a, nb::handle T_b, nb::handle s_, bool screw, nb::handle out) {
  Samples a(T_a, "T_a", {4, 4}), b(T_b, "T_b", {4, 4}), s(s_, "s", {});
  const auto kernel = [screw](const auto &in, auto *T) {
    se3_interpolate(pose_at(in[0]), pose_at(in[1]), *in[2], screw).write(T);
    return looks_rigid(in[0]) & looks_rigid(in[1]);
  };
  return over(out, {4, 4}, kernel, a, b, s);
}

nb::object multiply(nb::handle p_, nb::handle q_, nb::handle out) {
  Samples p(p_, "p", {4}), q(q_, "q", {4});
  const auto kernel = [](const auto &in, auto *to) {
    write(quaternion_at(in[0]) * quaternion_at(in[1]), to);
    return true;
  };
  return over(out, {4}, kernel, p, q);
}

nb::object between_quaternions(nb::handle a_, nb::handle b_, nb::handle s_, nb::handle out) {
  Samples a(a_, "a", {4}), b(b_, "b", {4}), s(s_, "s", {});
  const auto kernel = [](const auto &in, auto *q) {
    const auto begin = quaternion_at(in[0]), end = quaternion_at(in[1]);
    write(slerp(unit(begin), unit(end), *in[2]), q);
    return looks_unit(norm(begin)) & looks_unit(norm(end));
  };
  return over(out, {4}, kernel, a, b, s);
}

nb::object from_rpy(nb::handle rpy_, int first, int middle, int last, nb::handle out) {
  Samples rpy(rpy_, "rpy", {3});
  const auto kernel = [axes = Axes{first, middle, last}](const auto &in, auto *R) {
    matrix_from_angles(in[0], axes, R);
    return true;
  };
  return over(out, {3, 3}, kernel, rpy);
}

nb::object to_rpy(nb::handle R_, int first, int middle, int last, nb::handle out) {
  Samples R(R_, "R", {3, 3});
  const auto kernel = [axes = Axes{first, middle, last}](const auto &in, auto *rpy) {
    angles_from_matrix(in[0], axes, rpy);
    return looks_orthonormal(rotation_at(in[0], 3));
  };
  return over(out, {3}, kernel, R);
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_lie(nb::module_ &m) {
  def_groups(m);
  const auto out = [] { return arg("out") = nb::none(); };
  m.def(
      "rotations",
      [](nb::handle R, const char *name) {
        return checked(R, name, 3, [](auto *x) { return looks_orthonormal(rotation_at(x, 3)); });
      },
      array("R"), arg("name"));
  m.def(
      "poses",
      [](nb::handle T, const char *name) {
        return checked(T, name, 4, [](auto *x) { return looks_rigid(x); });
      },
      array("T"), arg("name"));
  m.def("so3_angle", &angle, array("R_a"), array("R_b"), out());
  m.def("so3_interpolate", &between_rotations, array("R_a"), array("R_b"), array("s"), out());
  m.def("se3_transform_wrench", &transform_wrench, array("T_a_b"), array("wrench_b"), out());
  m.def("se3_interpolate", &between_poses, array("T_a"), array("T_b"), array("s"),
      arg("screw") = false, out());
  m.def("euler_from_rpy", &from_rpy, array("rpy"), arg("first"), arg("middle"), arg("last"), out());
  m.def("euler_to_rpy", &to_rpy, array("R"), arg("first"), arg("middle"), arg("last"), out());
  m.def("quaternion_multiply", &multiply, array("p"), array("q"), out());
  m.def("quaternion_slerp", &between_quaternions, array("a"), array("b"), array("s"), out());
}
