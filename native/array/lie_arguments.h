// Argument checks for rotations, poses and unit quaternions.
//
// A rotation is accepted within `rotation_tolerance`, which admits six decimals or single
// precision. If its error exceeds `negligible`, it is replaced by the nearest rotation before use.
//
// The pass over a batch includes a fast test that may raise a false alarm (for NaN, for example).
// After an alarm, each sample is checked alone, and the error names the first invalid one. NaN is
// accepted: missing values stay missing.
#pragma once

#include "array/arrays.h"
#include "math/lie/lie.h"

namespace armlab {

constexpr double rotation_tolerance = 1e-5;  // largest entry of |R^T R - I|
constexpr double negligible = 1e-9;          // same measure: below it, a rotation is unchanged
constexpr double unit_tolerance = 1e-3;      // error of a quaternion's length

// The largest entry of |R^T R - I| of a finite R.
double departure(const Rotation<double> &R);

void refuse_no_rotation(const Samples &R, const std::string &name, int stride = 3);
void refuse_no_pose(const Samples &T, const std::string &name);
void refuse_not_unit(const Samples &q);

// Replaces rounded rotations with the nearest rotations, in a copy if there are any. The matrices
// are rotations (3, 3) or poses (4, 4).
void restore_digits(Input &matrices);

template <class Real>
inline Rotation<Real> rotation_at(const Real *m, int stride) {
  return Rotation<Real>::read(m, stride);
}

template <class Real>
inline Pose<Real> pose_at(const Real *m) {
  const Rotation<Real> R = rotation_at(m, 4);
  return {R.x, R.y, R.z, {m[3], m[7], m[11]}};
}

template <class Real>
inline Vec3<Real> vector_at(const Real *m) {
  return Vec3<Real>::read(m);
}

template <class Real>
inline Quaternion<Real> quaternion_at(const Real *m) {
  return {m[0], {m[1], m[2], m[3]}};
}

template <class Real>
inline void write(const Quaternion<Real> &q, Real *m) {
  m[0] = q.w;
  q.v.write(m + 1);
}

template <class Real>
inline bool looks_orthonormal(const Rotation<Real> &R) {
  const Real one(1.0), xy = dot(R.x, R.y), xz = dot(R.x, R.z), yz = dot(R.y, R.z);
  const Real xx = dot(R.x, R.x) - one, yy = dot(R.y, R.y) - one, zz = dot(R.z, R.z) - one;
  const Real off = xx * xx + yy * yy + zz * zz + xy * xy + xz * xz + yz * yz;
  const Real limit(0.99 * negligible * negligible);
  return all((off <= limit) & (Real(0.0) < dot(cross(R.x, R.y), R.z)));
}

template <class Real>
inline bool looks_rigid(const Real *m) {
  const Real zero(0.0);
  const bool last_row =
      all((m[12] == zero) & (m[13] == zero) & (m[14] == zero) & (m[15] == Real(1.0)));
  return last_row & looks_orthonormal(rotation_at(m, 4));
}

template <class Real>
inline bool looks_unit(const Real &length) {
  return all((Real(1.0 - 0.99 * unit_tolerance) <= length) &
             (length <= Real(1.0 + 0.99 * unit_tolerance)));
}

}  // namespace armlab
