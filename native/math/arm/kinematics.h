// Forward kinematics and Jacobians of a chain, for Real = double or Lanes (several samples).
#pragma once

#include "math/arm/chain.h"

namespace armlab {

// Sine and cosine of the `count` angles angle(i).
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

// Sine and cosine of the rotation of every joint.
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
  Lanes angles[most], sines[most], cosines[most];  // vectorised over joints: same numbers, faster
  const int groups = (chain.n + Lanes::width - 1) / Lanes::width;
  double *angle = reinterpret_cast<double *>(angles);
  for (int i = 0; i < chain.n; ++i) angle[i] = joint_angle(chain.steps[i], q[i]);
  for (int i = chain.n; i < groups * Lanes::width; ++i) angle[i] = 0.0;
  sincos_of(groups, [&](int i) { return angles[i]; }, sines, cosines);
  std::memcpy(sine, sines, chain.n * sizeof(double));
  std::memcpy(cosine, cosines, chain.n * sizeof(double));
}
#endif

// Iterates from base to tool; visit(i, z, p) receives the axis and a point of joint i + 1 in base
// axes. Returns T_base_tool. (Separate variables stay in registers; a pose would be in memory.)
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

// Zero, or NaN if a joint is NaN: marks results as missing even if they do not depend on that
// joint.
template <class Real>
inline Vec3<Real> missing_in(const Pose<Real> &T) {
  return Real(0.0) * (T.x + T.p);
}

// J (6, n): rows [v; w] at the tool point, in base axes or tool axes. Returns T_base_tool.
template <class Real>
inline Pose<Real> jacobian(const Chain &chain, const Real *q, bool tool, Real *J) {
  const int n = chain.n;
  const Pose<Real> T = walk(chain, q, [&](int i, const Vec3<Real> &z, const Vec3<Real> &p) {
    p.write(J + i, n);  // replaced once the tool point is known
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

// T_{i-1,i} = E_{i-1} Z_i(q_i), i >= 1: link frame i in link frame i - 1 (0: base).
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

// A twist [v; w] of the point at the origin, or a wrench [f; m] about it.
template <class Real>
struct Twist {
  Vec3<Real> v, w;

  static Twist read(const Real *m) { return {Vec3<Real>::read(m), Vec3<Real>::read(m + 3)}; }
};

template <class Real>
inline Twist<Real> operator+(const Twist<Real> &a, const Twist<Real> &b) {
  return {a.v + b.v, a.w + b.w};
}
template <class Real>
inline Twist<Real> operator*(const Real &s, const Twist<Real> &a) {
  return {s * a.v, s * a.w};
}
template <class Real>
inline Real dot(const Twist<Real> &a, const Twist<Real> &b) {
  return dot(a.v, b.v) + dot(a.w, b.w);
}
// V x S: rate of change of a twist S fixed in a body with twist V. V x* F: the same for a wrench.
template <class Real>
inline Twist<Real> cross(const Twist<Real> &V, const Twist<Real> &S) {
  return {cross(V.w, S.v) + cross(V.v, S.w), cross(V.w, S.w)};
}
template <class Real>
inline Twist<Real> wrench_cross(const Twist<Real> &V, const Twist<Real> &F) {
  return {cross(V.w, F.v), cross(V.w, F.w) + cross(V.v, F.v)};
}

// For T = T_a_b: transforms a twist from frame a to b, and a wrench from frame b to a.
template <class Real>
inline Twist<Real> twist_in(const Pose<Real> &T, const Twist<Real> &V) {
  return {T.turn_back(V.v + cross(V.w, T.p)), T.turn_back(V.w)};
}
template <class Real>
inline Twist<Real> wrench_from(const Pose<Real> &T, const Twist<Real> &F) {
  const Vec3<Real> f = T.turn(F.v);
  return {f, T.turn(F.w) + cross(T.p, f)};
}

// Unit twist of a joint with axis z through p.
template <class Real>
inline Twist<Real> joint_twist(bool slides, const Vec3<Real> &z, const Vec3<Real> &p) {
  if (slides) return {z, {Real(0.0), Real(0.0), Real(0.0)}};
  return {cross(p, z), z};
}
template <class Real>
inline Twist<Real> unit_twist(bool slides) {  // in the frame of its link
  const Vec3<Real> zero{Real(0.0), Real(0.0), Real(0.0)}, z{Real(0.0), Real(0.0), Real(1.0)};
  return slides ? Twist<Real>{z, zero} : Twist<Real>{zero, z};
}
template <class Real>
inline const Real &along_axis(const Twist<Real> &V, bool slides) {
  return slides ? V.v.z : V.w.z;
}

// Jd (6, n): time derivative of J (6, n) for the motion q, qd, in base axes or tool axes.
//
// Let S_i be the twist of joint i and V_i the twist of the link before it, both about the base
// origin; then dS_i/dt = V_i x S_i. At the tool point p, the column is [S.v + S.w x p; S.w]. In
// tool axes, d/dt (R^T u) = R^T (ud - w x u) for both halves u of a column, with w the angular
// velocity of the tool.
template <class Real>
inline void jacobian_derivative(
    const Chain &chain, const Real *q, const Real *qd, bool tool, Real *Jd) {
  const int n = chain.n;
  Twist<Real> S[max_joints], s[max_joints], V{};
  const Pose<Real> T = walk(chain, q, [&](int i, const Vec3<Real> &z, const Vec3<Real> &p) {
    S[i] = joint_twist(chain.steps[i].slides, z, p);
    s[i] = cross(V, S[i]);
    V = V + qd[i] * S[i];
  });
  const Vec3<Real> missing = missing_in(T), tip = T.p + missing, velocity = V.v + cross(V.w, tip);
  for (int i = 0; i < n; ++i) {
    Vec3<Real> vd = s[i].v + cross(s[i].w, tip) + cross(S[i].w, velocity) + missing, wd = s[i].w;
    if (tool) {
      vd = T.turn_back(vd - cross(V.w, S[i].v + cross(S[i].w, tip)));
      wd = T.turn_back(wd - cross(V.w, S[i].w));
    }
    vd.write(Jd + i, n);
    wd.write(Jd + 3 * n + i, n);
  }
}

}  // namespace armlab
