// Forward kinematics and Jacobians of a chain, for Real = double or Lanes (several samples).
#pragma once

#include "math/arm/chain.h"

namespace armlab {

// Sine and cosine of `count` angles, angle(i).
template <class Real, class Angle>
inline void sincos_of(int count, Angle angle, Real *sine, Real *cosine) {
  Real quadrant[max_joints], farthest(0.0);
  for (int i = 0; i < count; ++i) {
    const Real x = angle(i);
    reduce_angle(x, quadrant[i], sine[i]);
    note_distance(x, farthest);
  }
  for (int i = 0; i < count; ++i) sincos_of_remainder(Real(sine[i]), sine[i], cosine[i]);
  for (int i = 0; i < count; ++i) turn_to_quadrant(quadrant[i], sine[i], cosine[i]);
  if (all(farthest <= Real(far_angle))) return;
  for (int i = 0; i < count; ++i) replace_far(angle(i), sine[i], cosine[i]);
}

// Sine and cosine of the angle of every joint.
template <class Real>
inline Real joint_angle(const Chain::Step &step, const Real &q) {
  return step.slides ? Real(step.offset) : q + Real(step.offset);
}
template <class Real>
inline void joint_sincos(const Chain &chain, const Real *q, Real *sine, Real *cosine) {
  sincos_of(chain.n, [&](int i) { return joint_angle(chain.steps[i], q[i]); }, sine, cosine);
}
#ifdef ARMLAB_LANES
inline void joint_sincos(const Chain &chain, const double *q, double *sine, double *cosine) {
  constexpr int most = max_joints / Lanes::width;
  Lanes angles[most], sines[most], cosines[most];  // joints side by side: the same numbers, sooner
  const int groups = (chain.n + Lanes::width - 1) / Lanes::width;
  double *angle = reinterpret_cast<double *>(angles);
  for (int i = 0; i < chain.n; ++i) angle[i] = joint_angle(chain.steps[i], q[i]);
  for (int i = chain.n; i < groups * Lanes::width; ++i) angle[i] = 0.0;
  sincos_of(groups, [&](int i) { return angles[i]; }, sines, cosines);
  std::memcpy(sine, sines, chain.n * sizeof(double));
  std::memcpy(cosine, cosines, chain.n * sizeof(double));
}
#endif

// Walks from base to tool; visit(i, z, p) sees the axis and a point of joint i + 1 in base axes.
// Returns T_base_tool. (A pose would be kept in memory: variables.)
template <class Real, class Visit>
inline Pose<Real> walk(const Chain &chain, const Real *q, Visit visit) {
  Real sine[max_joints], cosine[max_joints];
  joint_sincos(chain, q, sine, cosine);
  const Pose<Real> base(chain.frame(0));
  Vec3<Real> x = base.x, y = base.y, z = base.z, p = base.p;
  for (int i = 0; i < chain.n; ++i) {
    const Chain::Step &step = chain.steps[i];
    visit(i, z, p);
    const Vec3<Real> turned = cosine[i] * y - sine[i] * x;
    x = cosine[i] * x + sine[i] * y;
    if (step.slides) p = p + q[i] * z;
    if (step.has_x) p = p + Real(step.px) * x;
    if (step.has_y) p = p + Real(step.py) * turned;
    if (step.has_z) p = p + Real(step.pz) * z;
    if (step.twist == Chain::Twist::none) {
      y = turned;
    } else if (step.twist == Chain::Twist::quarter) {
      y = z;
      z = -turned;
    } else if (step.twist == Chain::Twist::minus_quarter) {
      y = -z;
      z = turned;
    } else {
      y = Real(step.cos_alpha) * turned + Real(step.sin_alpha) * z;
      z = Real(step.cos_alpha) * z - Real(step.sin_alpha) * turned;
    }
  }
  if (chain.sin_last == 0.0 && chain.cos_last == 1.0) return {x, y, z, p};
  const Real c(chain.cos_last), s(chain.sin_last);
  return {c * x + s * y, c * y - s * x, z, p};
}

// T_out (16): T_base_tool, row by row.
template <class Real>
inline void forward(const Chain &chain, const Real *q, Real *T_out) {
  walk(chain, q, [](int, const Vec3<Real> &, const Vec3<Real> &) {}).write(T_out);
}

// Zero, or NaN where a joint is NaN: for what does not depend on it, but must show it missing.
template <class Real>
inline Vec3<Real> missing_in(const Pose<Real> &T) {
  return Real(0.0) * (T.x + T.p);
}

// J (6, n): rows [v; w], at the tool point, in base axes or in tool axes. Returns T_base_tool.
template <class Real>
inline Pose<Real> jacobian(const Chain &chain, const Real *q, bool tool, Real *J) {
  const int n = chain.n;
  const Pose<Real> T = walk(chain, q, [&](int i, const Vec3<Real> &z, const Vec3<Real> &p) {
    p.write(J + i, n);  // until the tool point is known
    z.write(J + 3 * n + i, n);
  });
  const Vec3<Real> missing = missing_in(T), tip = T.p + missing;
  for (int i = 0; i < n; ++i) {
    Real *linear = J + i, *angular = J + 3 * n + i;
    Vec3<Real> w = Vec3<Real>::read(angular, n), v = cross(w, tip - Vec3<Real>::read(linear, n));
    if (chain.steps[i].slides) {
      v = w + missing;
      w = {Real(0.0), Real(0.0), Real(0.0)};
      w.write(angular, n);
    }
    if (tool) {
      v = T.turn_back(v);
      T.turn_back(w).write(angular, n);
    }
    v.write(linear, n);
  }
  return T;
}

// T_{i-1,i} = E_{i-1} Z_i(q_i), joints from 1: link frame i in link frame i - 1 (0: base).
template <class Real>
inline Pose<Real> link_pose(const Chain &chain, int i, const Real &q) {
  Pose<Real> T(chain.frame(i));
  if (chain.steps[i].slides) {
    T.p = T.p + q * T.z;
    return T;
  }
  Real sine, cosine;
  sincos(q, sine, cosine);
  const Vec3<Real> x = cosine * T.x + sine * T.y;
  T.y = cosine * T.y - sine * T.x;
  T.x = x;
  return T;
}

// T_out (n, 16): T_base_i of link frames 1 ... n.
template <class Real>
inline void link_transforms(const Chain &chain, const Real *q, Real *T_out) {
  Pose<Real> T;
  for (int i = 0; i < chain.n; ++i) {
    const Pose<Real> step = link_pose(chain, i, q[i]);
    T = i == 0 ? step : T * step;
    T.write(T_out + 16 * i);
  }
}

// Jd (6, n): the derivative of J (6, n) along the motion q, qd, in base axes or in tool axes.
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
  // The motion of link i and of the point that ends it, from joint i - 1.
  const auto advance = [&](int i) {
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
    vd.write(Jd + i, n);
    wd.write(Jd + 3 * n + i, n);
  }
}

}  // namespace armlab
