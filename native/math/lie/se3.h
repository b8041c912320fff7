// Exponential and logarithm of twists [v; w], and the left Jacobians of SO(3) and SE(3).
//
// Exact values: tests/numerics/tables/groups.json.
#pragma once

#include <cstddef>

#include "math/lie/lie.h"

namespace armlab {

// rad: closed forms above it lose no digits; eight terms below it reach 1e-18
constexpr double series_below = 0.5;

struct Coefficients {
  double c[8];
};

constexpr double factorial(int n) { return n < 2 ? 1.0 : n * factorial(n - 1); }

// Coefficient of t^2k: of (t - sin t)/t^3 for m = 3, of (1 - cos t)/t^2 for m = 2.
constexpr double alternating(int k, int m) { return (k % 2 ? -1.0 : 1.0) / factorial(2 * k + m); }

constexpr double cotangent(int k) {  // (1 - t/2 cot(t/2)) / t^2: |B_2k+2| / (2k + 2)!
  constexpr double bernoulli[9] = {1.0 / 6, 1.0 / 30, 1.0 / 42, 1.0 / 30, 5.0 / 66, 691.0 / 2730,
      7.0 / 6, 3617.0 / 510, 43867.0 / 798};
  return bernoulli[k] / factorial(2 * k + 2);
}

// The series, or its derivative with respect to t.
constexpr Coefficients series(int kind, bool derivative) {
  Coefficients s{};
  for (int k = 0; k < 8; ++k) {
    const int term = derivative ? k + 1 : k;
    s.c[k] = (derivative ? 2.0 * term : 1.0) * (kind ? alternating(term, kind) : cotangent(term));
  }
  return s;
}

template <class Real>
inline Real evaluate(const Coefficients &s, const Real &x) {
  Real total(s.c[7]);
  for (int k = 6; k >= 0; --k) total = total * x + Real(s.c[k]);
  return total;
}

// a, b and their derivatives divided by theta, for a matrix I + a hat(w) + b hat(w)^2.
template <class Real>
struct Polynomial {
  Real a, b, a1, b1;
};

// (t - sin t) / t^3.
template <class Real>
inline Real cubic(const Angle<Real> &t) {
  constexpr Coefficients near_zero = series(3, false);
  const Real x = t.theta * t.theta;
  return select(t.theta < Real(series_below), evaluate(near_zero, x),
      (t.theta - Real(2.0) * t.sine * t.cosine) / (x * t.theta));
}

// (1 - h cot h) / t^2 with h = t/2, from h cot h.
template <class Real>
inline Real square(const Real &theta, const Real &h_cot_h) {
  constexpr Coefficients near_zero = series(0, false);
  const Real x = theta * theta;
  return select(theta < Real(series_below), evaluate(near_zero, x), (Real(1.0) - h_cot_h) / x);
}

template <class Real>
inline Real h_cot_h(const Angle<Real> &t) {
  return Real(0.5) * t.theta * t.cosine / t.sine;
}

template <class Real>
inline Polynomial<Real> left_jacobian_polynomial(const Angle<Real> &t) {
  constexpr Coefficients near_a = series(2, true), near_b = series(3, true);
  const Real two(2.0), x = t.theta * t.theta;
  const Real sine = two * t.sine * t.cosine, versine = two * t.sine * t.sine;
  const auto small = t.theta < Real(series_below);
  const Real a1 = (t.theta * sine - two * versine) / (x * x);
  const Real b1 = (Real(3.0) * (sine - t.theta) + t.theta * versine) / (x * x * t.theta);
  return {t.versine(), cubic(t), select(small, evaluate(near_a, x), a1),
      select(small, evaluate(near_b, x), b1)};
}

template <class Real>
inline Polynomial<Real> left_jacobian_inv_polynomial(const Angle<Real> &t) {
  constexpr Coefficients near_zero = series(0, true);
  const Real x = t.theta * t.theta, g = h_cot_h(t), r = Real(0.5) * t.theta / t.sine;
  const Real b1 = (r * r + g - Real(2.0)) / (x * x);
  return {Real(-0.5), square(t.theta, g), Real(0.0),
      select(t.theta < Real(series_below), evaluate(near_zero, x), b1)};
}

// The derivative of I + a hat(w) + b hat(w)^2 in the direction v:
// a hat(v) + b (hat(w) hat(v) + hat(v) hat(w)) + (w.v)/t (a' hat(w) + b' hat(w)^2), a1 = a'/t, b1 =
// b'/t. It is the upper right block of the same function of [[hat(w), hat(v)], [0, hat(w)]].
template <class Real>
inline Rotation<Real> derivative(
    const Vec3<Real> &w, const Vec3<Real> &v, const Polynomial<Real> &f) {
  const Real along = dot(w, v), two(2.0);
  const Vec3<Real> s = f.a * v + (along * f.a1) * w;               // skew-symmetric part
  const Vec3<Real> u = f.b * v + (Real(0.5) * along * f.b1) * w;   // symmetric part w u^T + u w^T
  const Real less = two * along * f.b + along * f.b1 * dot(w, w);  // minus this times I
  const Real xy = w.x * u.y + u.x * w.y, xz = w.x * u.z + u.x * w.z, yz = w.y * u.z + u.y * w.z;
  return {{two * w.x * u.x - less, xy + s.z, xz - s.y},
      {xy - s.z, two * w.y * u.y - less, yz + s.x}, {xz + s.y, yz - s.x, two * w.z * u.z - less}};
}

// [[A, B], [0, A]] row by row.
template <class Real>
inline void write_blocks(const Rotation<Real> &A, const Rotation<Real> &B, Real *m) {
  A.write(m, 6);
  B.write(m + 3, 6);
  for (int i = 3; i < 6; ++i)
    for (int j = 0; j < 3; ++j) m[6 * i + j] = Real(0.0);
  A.write(m + 21, 6);
}

// exp([v; w]): R = exp(w), p = (I + (1 - cos t)/t^2 hat(w) + (t - sin t)/t^3 hat(w)^2) v.
template <class Real>
inline Pose<Real> se3_exp(const Vec3<Real> &v, const Vec3<Real> &w) {
  const Angle<Real> t(w);
  const Rotation<Real> R = rotation_about(w, t);
  const Vec3<Real> wv = cross(w, v);
  return {R.x, R.y, R.z, v + (t.versine() * wv + cubic(t) * cross(w, wv))};
}

// The twist with the smallest rotation: w = log(R), v = (I - hat(w)/2 + (1 - h cot h)/t^2 hat(w)^2)
// p.
template <class Real>
inline void se3_log(const Pose<Real> &T, Vec3<Real> &v, Vec3<Real> &w) {
  const Quaternion<Real> q = quaternion_from(Rotation<Real>{T.x, T.y, T.z});
  const Real length = norm(q.v), theta = Real(2.0) * quadrant_angle(length, q.w);
  w = ratio(theta, length, 2.0) * q.v;
  const Vec3<Real> wp = cross(w, T.p);
  v = T.p + (Real(-0.5) * wp + square(theta, Real(0.5) * theta * q.w / length) * cross(w, wp));
}

template <class Real>
inline Pose<Real> pose_inverse(const Pose<Real> &T) {
  const Rotation<Real> R = Rotation<Real>{T.x, T.y, T.z}.inverse();
  return {R.x, R.y, R.z, Real(-1.0) * T.turn_back(T.p)};
}

// Elementwise selection by a condition.
template <class Condition, class Real>
inline Vec3<Real> select(const Condition &condition, const Vec3<Real> &yes, const Vec3<Real> &no) {
  return {select(condition, yes.x, no.x), select(condition, yes.y, no.y),
      select(condition, yes.z, no.z)};
}

// R_a exp(s log(R_a^T R_b)), evaluated from the nearer end, which is then exact.
template <class Real>
inline Rotation<Real> so3_interpolate(
    const Rotation<Real> &a, const Rotation<Real> &b, const Real &s) {
  const Vec3<Real> w = so3_log(a.inverse() * b);
  const auto late = Real(0.5) < s;
  const Rotation<Real> nearer{
      select(late, b.x, a.x), select(late, b.y, a.y), select(late, b.z, a.z)};
  return nearer * so3_exp(select(late, s - Real(1.0), s) * w);
}

// Interpolates poses along a screw, or else the position along a line and the rotation as above.
template <class Real>
inline Pose<Real> se3_interpolate(
    const Pose<Real> &a, const Pose<Real> &b, const Real &s, bool screw) {
  const auto late = Real(0.5) < s;
  const Real rest = select(late, s - Real(1.0), s);
  if (screw) {
    const Pose<Real> nearer{select(late, b.x, a.x), select(late, b.y, a.y), select(late, b.z, a.z),
        select(late, b.p, a.p)};
    Vec3<Real> v, w;
    se3_log(pose_inverse(a) * b, v, w);
    return nearer * se3_exp(rest * v, rest * w);
  }
  const Rotation<Real> R =
      so3_interpolate(Rotation<Real>{a.x, a.y, a.z}, Rotation<Real>{b.x, b.y, b.z}, s);
  return {R.x, R.y, R.z, select(late, b.p, a.p) + rest * (b.p - a.p)};
}

}  // namespace armlab
