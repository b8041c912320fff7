// Residuals of A X = Y B and their derivatives. Specification: tests/oracles/calibration.py.
#pragma once

#include "array/lie_arguments.h"
#include "math/lie/se3.h"

namespace armlab {

template <class Real>
inline Vec3<Real> spread(const double *m) {
  return {Real(m[0]), Real(m[1]), Real(m[2])};
}

template <class Real>
inline Rotation<Real> spread_rotation(const double *m) {
  return {{Real(m[0]), Real(m[3]), Real(m[6])}, {Real(m[1]), Real(m[4]), Real(m[7])}, {Real(m[2]), Real(m[5]), Real(m[8])}};
}

// in: R_A, t_A, R_B, t_B of a sample; X, Y: R_X, t_X, R_Y, t_Y; r (6,), J (6, 12) row by row.
template <class Real>
inline void hand_eye_rows(const Real *R_A, const Real *t_A, const Real *R_B, const Real *t_B, const double *R_X,
                          const double *t_X, const double *R_Y, const double *t_Y, Real *r, Real *J) {
  const Rotation<Real> Y_back = spread_rotation<Real>(R_Y).inverse();
  const Rotation<Real> C = Y_back * rotation_at(R_A, 3), expected = C * spread_rotation<Real>(R_X);
  const Vec3<Real> t = C.turn(spread<Real>(t_X)) + Y_back.turn(vector_at(t_A) - spread<Real>(t_Y));
  const Rotation<Real> back = expected.inverse();
  const Vec3<Real> w = so3_log(back * rotation_at(R_B, 3));
  write(vector_at(t_B) - t, r);
  write(w, r + 3);
  const Real zero(0.0);
  for (int i = 0; i < 72; ++i) J[i] = zero;
  Rotation<Real>{-C.x, -C.y, -C.z}.write(J, 12);
  Y_back.write(J + 6, 12);
  Rotation<Real>{{zero, -t.z, t.y}, {t.z, zero, -t.x}, {-t.y, t.x, zero}}.write(J + 9, 12);
  const auto f = left_jacobian_inv_polynomial(Angle(w));
  const Rotation<Real> bent = polynomial(w, f.a, f.b);
  Rotation<Real>{-bent.x, -bent.y, -bent.z}.write(J + 39, 12);
  (bent * back).write(J + 45, 12);
}

}  // namespace armlab
