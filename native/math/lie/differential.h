// The time derivative of a chain's Jacobian, for Real = double (one sample) or Lanes (several).
#pragma once

#include "math/arm/kinematics.h"

namespace armlab {

// Jd (6, n): the derivative of J (6, n) along the motion q, qd; both are told in base axes or in
// tool axes.
//
// With w_i the angular velocity of the link before joint i and pd_i the velocity of the joint's
// point, in base axes:
//   revolute   d/dt [z x (p - p_i); z] = [(w_i x z) x (p - p_i) + z x (pd - pd_i); w_i x z]
//   prismatic  d/dt [z; 0] = [w_i x z; 0]
// In tool axes, d/dt (R^T u) = R^T (ud - w x u) for both halves u of a column, w the angular
// velocity of the tool.
template <class Real>
inline void jacobian_derivative(
    const Chain &chain, const Real *q, const Real *qd, bool tool, Real *Jd) {
  const int n = chain.n;
  const Vec3<Real> zero{Real(0.0), Real(0.0), Real(0.0)};
  Vec3<Real> axis[max_joints + 1], point[max_joints + 1], w[max_joints + 1], pd[max_joints + 1];
  w[0] = pd[0] = zero;
  const auto advance =
      [&](int i) {  // the motion of link i and of the point that ends it, from joint i - 1
        const bool slides = chain.steps[i - 1].slides;
        const Vec3<Real> own = qd[i - 1] * axis[i - 1];
        w[i] = slides ? w[i - 1] : w[i - 1] + own;
        pd[i] = pd[i - 1] + cross(w[i], point[i] - point[i - 1]);
        if (slides) pd[i] = pd[i] + own;
      };
  const Pose<Real> T = walk(chain, q, [&](int i, const Vec3<Real> &z, const Vec3<Real> &p) {
    axis[i] = z;
    point[i] = p;
    if (i > 0) advance(i);
  });
  const Vec3<Real> missing = missing_in(T);
  point[n] = T.p + missing;
  advance(n);
  for (int i = 0; i < n; ++i) {
    const Vec3<Real> turning = cross(w[i], axis[i]), lever = point[n] - point[i];
    const bool slides = chain.steps[i].slides;
    Vec3<Real> vd = turning + missing, wd = zero;
    if (!slides) {
      vd = cross(turning, lever) + cross(axis[i], pd[n] - pd[i]);
      wd = turning;
    }
    if (tool) {
      vd = T.turn_back(vd - cross(w[n], slides ? axis[i] : cross(axis[i], lever)));
      wd = T.turn_back(slides ? wd : wd - cross(w[n], axis[i]));
    }
    Jd[i] = vd.x;
    Jd[n + i] = vd.y;
    Jd[2 * n + i] = vd.z;
    Jd[3 * n + i] = wd.x;
    Jd[4 * n + i] = wd.y;
    Jd[5 * n + i] = wd.z;
  }
}

}  // namespace armlab
