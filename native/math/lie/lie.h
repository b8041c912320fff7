// Rotations and rigid motions: exponential, logarithm and quaternions over Real (double or Lanes).
//
// Exact values: tests/numerics/tables/groups.json. Both branches of every `select` are computed,
// and the unselected one may be NaN. Batches and single calls are therefore bit-identical. There is
// no arc cosine.
#pragma once

#include "math/lie/vec3.h"

namespace armlab {

// R_a_b by columns: the axes of b in a. For a pose: Rotation<Real>{T.x, T.y, T.z}.
template <class Real>
struct Rotation {
  Vec3<Real> x, y, z;

  // Reads the matrix row by row, with `stride` numbers between the starts of rows.
  static Rotation read(const Real *m, int stride) {
    return {Vec3<Real>::read(m, stride), Vec3<Real>::read(m + 1, stride),
        Vec3<Real>::read(m + 2, stride)};
  }
  void write(Real *m, int stride) const {
    x.write(m, stride);
    y.write(m + 1, stride);
    z.write(m + 2, stride);
  }
  Vec3<Real> turn(const Vec3<Real> &b) const { return b.x * x + b.y * y + b.z * z; }  // R b
  // R^T a
  Vec3<Real> turn_back(const Vec3<Real> &a) const { return {dot(x, a), dot(y, a), dot(z, a)}; }
  Rotation inverse() const { return {{x.x, y.x, z.x}, {x.y, y.y, z.y}, {x.z, y.z, z.z}}; }
};

template <class Real>
inline Rotation<Real> operator*(const Rotation<Real> &a, const Rotation<Real> &b) {
  return {a.turn(b.x), a.turn(b.y), a.turn(b.z)};
}

template <class Real>
struct Quaternion {
  Real w;
  Vec3<Real> v;
};

// Length from the C library, used if a square overflows or underflows.
inline double exact_norm(const Vec3<double> &a, double) { return std::hypot(a.x, a.y, a.z); }
#ifdef ARMLAB_LANES
inline Lanes exact_norm(const Vec3<Lanes> &a, Lanes length) {
  for (int i = 0; i < Lanes::width; ++i)
    if (!(1e-140 <= length.v[i] && length.v[i] <= 1e140))
      length.v[i] = std::hypot(a.x.v[i], a.y.v[i], a.z.v[i]);
  return length;
}
#endif
template <class Real>
inline Real norm(const Vec3<Real> &a) {
  const Real length = square_root(dot(a, a));
  if (all((Real(1e-140) <= length) & (length <= Real(1e140)))) return length;
  return exact_norm(a, length);
}

template <class Real>
inline Real norm(const Quaternion<Real> &q) {
  return square_root(q.w * q.w + dot(q.v, q.v));
}

template <class Real>
inline Quaternion<Real> unit(const Quaternion<Real> &q) {
  const Real length = norm(q);
  return {q.w / length, {q.v.x / length, q.v.y / length, q.v.z / length}};
}

// y / x, or `at_zero` for x = 0.
template <class Real>
inline Real ratio(const Real &y, const Real &x, double at_zero) {
  const auto zero = x == Real(0.0);
  return select(zero, Real(at_zero), y / select(zero, Real(1.0), x));
}

// atan2(y, x) of two non-negative numbers, not both zero, with a relative error below 4e-16. The
// argument smaller / larger is at most 1; beyond tan(pi/8), pi/4 is split off. The polynomial
// for the remainder (Chebyshev points) has an error below 8e-18.
template <class Real>
inline Real quadrant_angle(const Real &y, const Real &x) {
  constexpr Real tan_pi_8(0x1.a827999fcef32p-2);
  constexpr Real pi_4(0x1.921fb54442d18p-1), pi_4_low(0x1.1a62633145c07p-55);
  constexpr Real c0(-0x1.5555555555555p-2), c1(0x1.999999999934ap-3), c2(-0x1.24924924360cbp-3);
  constexpr Real c3(0x1.c71c7185314cbp-4), c4(-0x1.745d0b26b83e7p-4), c5(0x1.3b1262d95579ep-4);
  constexpr Real c6(-0x1.10fa75382537fp-4), c7(0x1.dfe61e80903d2p-5), c8(-0x1.a098bb6ba4941p-5);
  constexpr Real c9(0x1.41603647c7a7cp-5), c10(-0x1.3a2b7a07caea9p-6);

  const auto steep = x < y;
  const Real low = select(steep, x, y), high = select(steep, y, x);
  const auto wide = high * tan_pi_8 < low;
  const Real u = select(wide, low - high, low) / select(wide, low + high, high);
  const Real z = u * u, z2 = z * z, z4 = z2 * z2;
  const Real tail = ((c4 + c5 * z) + (c6 + c7 * z) * z2) + z4 * ((c8 + c9 * z) + c10 * z2);
  const Real p = ((c0 + c1 * z) + (c2 + c3 * z) * z2) + z4 * tail;
  const Real turn = u + u * z * p;
  const Real flat = select(wide, pi_4 + (turn + pi_4_low), turn);
  return select(steep, Real(2.0) * pi_4 + (Real(2.0) * pi_4_low - flat), flat);
}

// The unit quaternion of a rotation with w >= 0; if w = 0, the first nonzero component is positive.
// 4 q q^T is linear in R. Its row with the largest diagonal entry, normalised, is q, which avoids
// division by small numbers (Shepperd 1978).
template <class Real>
inline Quaternion<Real> quaternion_from(const Rotation<Real> &R) {
  const Real one(1.0), zero(0.0);
  const Real xx = R.x.x, yy = R.y.y, zz = R.z.z;
  const Real wx = R.y.z - R.z.y, wy = R.z.x - R.x.z, wz = R.x.y - R.y.x;
  const Real xy = R.x.y + R.y.x, xz = R.x.z + R.z.x, yz = R.y.z + R.z.y;

  Quaternion<Real> q{one + xx + yy + zz, {wx, wy, wz}};
  Real largest = q.w;
  const auto prefer = [&](const Real &diagonal, const Real &w, const Real &x, const Real &y,
                          const Real &z) {
    const auto larger = largest < diagonal;
    largest = select(larger, diagonal, largest);
    q = {select(larger, w, q.w),
        {select(larger, x, q.v.x), select(larger, y, q.v.y), select(larger, z, q.v.z)}};
  };
  const Real x2 = one + xx - yy - zz, y2 = one - xx + yy - zz, z2 = one - xx - yy + zz;
  prefer(x2, wx, x2, xy, xz);
  prefer(y2, wy, xy, y2, yz);
  prefer(z2, wz, xz, yz, z2);

  const Real first =
      select(q.w == zero, select(q.v.x == zero, select(q.v.y == zero, q.v.z, q.v.y), q.v.x), q.w);
  const Real scale = select(first < zero, -one, one) / norm(q);
  return {q.w * scale, scale * q.v};
}

// The rotation of a quaternion q; the second argument is 2 / q.q.
template <class Real>
inline Rotation<Real> rotation_from(const Quaternion<Real> &q, const Real &twice_inverse) {
  const Real one(1.0);
  const Vec3<Real> v = twice_inverse * q.v;
  const Real wx = q.w * v.x, wy = q.w * v.y, wz = q.w * v.z;
  const Real xx = q.v.x * v.x, xy = q.v.x * v.y, xz = q.v.x * v.z;
  const Real yy = q.v.y * v.y, yz = q.v.y * v.z, zz = q.v.z * v.z;
  return {{one - (yy + zz), xy + wz, xz - wy}, {xy - wz, one - (xx + zz), yz + wx},
      {xz + wy, yz - wx, one - (xx + yy)}};
}

// The rotation of a nonzero quaternion of any length.
template <class Real>
inline Rotation<Real> rotation_from(const Quaternion<Real> &q) {
  return rotation_from(q, Real(2.0) / (q.w * q.w + dot(q.v, q.v)));
}

template <class Real>
inline Quaternion<Real> operator*(const Quaternion<Real> &p, const Quaternion<Real> &q) {
  return {p.w * q.w - dot(p.v, q.v), p.w * q.v + q.w * p.v + cross(p.v, q.v)};
}

// The rotation vector of a unit quaternion with w >= 0: 2 atan2(|v|, w) v / |v|.
template <class Real>
inline Vec3<Real> rotation_vector(const Quaternion<Real> &q) {
  const Real length = norm(q.v);
  return ratio(Real(2.0) * quadrant_angle(length, q.w), length, 2.0) * q.v;
}

// The shortest rotation vector, |w| <= pi.
template <class Real>
inline Vec3<Real> so3_log(const Rotation<Real> &R) {
  return rotation_vector(quaternion_from(R));
}

// The angle of a rotation, in [0, pi].
template <class Real>
inline Real so3_angle(const Rotation<Real> &R) {
  const Quaternion<Real> q = quaternion_from(R);
  return Real(2.0) * quadrant_angle(norm(q.v), q.w);
}

// Interpolates unit quaternions from a to b along the shorter arc at constant speed.
template <class Real>
inline Quaternion<Real> slerp(const Quaternion<Real> &a, const Quaternion<Real> &b, const Real &s) {
  const Real one(1.0), zero(0.0);
  const Real side = select(a.w * b.w + dot(a.v, b.v) < zero, -one, one);
  const Quaternion<Real> c{side * b.w, side * b.v}, chord{c.w - a.w, c.v - a.v},
      sum{c.w + a.w, c.v + a.v};
  const Real arc = Real(2.0) * quadrant_angle(norm(chord), norm(sum));
  Real sine, from, to, unused;
  sincos(arc, sine, unused);
  sincos((one - s) * arc, from, unused);
  sincos(s * arc, to, unused);
  const auto still = arc == zero;
  const Real from_a = select(still, one - s, from / sine), from_b = select(still, s, to / sine);
  return unit(Quaternion<Real>{from_a * a.w + from_b * c.w, from_a * a.v + from_b * c.v});
}

// I + a hat(w) + b hat(w)^2.
template <class Real>
inline Rotation<Real> polynomial(const Vec3<Real> &w, const Real &a, const Real &b) {
  const Real one(1.0);
  const Vec3<Real> aw = a * w, bw = b * w;
  const Real xx = w.x * bw.x, yy = w.y * bw.y, zz = w.z * bw.z;
  const Real xy = w.x * bw.y, xz = w.x * bw.z, yz = w.y * bw.z;
  return {{one - (yy + zz), xy + aw.z, xz - aw.y}, {xy - aw.z, one - (xx + zz), yz + aw.x},
      {xz + aw.y, yz - aw.x, one - (xx + yy)}};
}

// Common terms of exponential and Jacobians for the angle theta = |w|.
template <class Real>
struct Angle {
  Real theta, sine, cosine, k;  // sine and cosine of theta / 2; k = sine / theta

  explicit Angle(const Vec3<Real> &w) : theta(norm(w)) {
    const Real half = Real(0.5) * theta;  // may underflow to 0
    sincos(half, sine, cosine);
    k = Real(0.5) * ratio(sine, half, 1.0);
  }
  Real versine() const { return Real(2.0) * k * k; }  // (1 - cos(theta)) / theta^2
};

// The rotation about w by |w|: I + sin(t)/t hat(w) + (1 - cos(t))/t^2 hat(w)^2.
// It is computed from the quaternion, whose length is 1 except for rounding. A first-order
// correction (2 / n = 4 - 2 n near n = 1) makes the result orthonormal to machine precision.
template <class Real>
inline Rotation<Real> rotation_about(const Vec3<Real> &w, const Angle<Real> &t) {
  const Quaternion<Real> q{t.cosine, t.k * w};
  return rotation_from(q, Real(4.0) - Real(2.0) * (q.w * q.w + dot(q.v, q.v)));
}

template <class Real>
inline Rotation<Real> so3_exp(const Vec3<Real> &w) {
  return rotation_about(w, Angle<Real>(w));
}

}  // namespace armlab
