// Forward kinematics and Jacobians of a chain, for Real = double (one configuration) or Lanes (several).
#pragma once

#include "chain.h"

namespace armlab {

// Sine and cosine of every joint's angle.
inline void joint_sincos(const Chain &chain, const Lanes *q, Lanes *sine, Lanes *cosine) {
  for (int i = 0; i < chain.n; ++i)
    sincos(Lanes(chain.steps[i].turns) * q[i] + Lanes(chain.steps[i].offset), sine[i], cosine[i]);
}
inline void joint_sincos(const Chain &chain, const double *q, double *sine, double *cosine) {
  for (int i = 0; i < chain.n; i += Lanes::width) {  // joints side by side: the same numbers, sooner
    Lanes angle(0.0), s, c;
    const int last = i + Lanes::width < chain.n ? i + Lanes::width : chain.n;
    for (int k = i; k < last; ++k) angle.v[k - i] = chain.steps[k].turns * q[k] + chain.steps[k].offset;
    sincos(angle, s, c);
    for (int k = i; k < last; ++k) {
      sine[k] = s.v[k - i];
      cosine[k] = c.v[k - i];
    }
  }
}

// Walks from base to tool; visit(i, z, p) sees the axis and a point of joint i + 1 in base axes. Returns T_base_tool.
template <class Real, class Visit>
inline Pose<Real> walk(const Chain &chain, const Real *q, Visit visit) {
  Real sine[max_joints], cosine[max_joints];
  joint_sincos(chain, q, sine, cosine);
  Pose<Real> T(chain.frame(0));
  for (int i = 0; i < chain.n; ++i) {
    const Chain::Step &step = chain.steps[i];
    visit(i, T.z, T.p);
    const Vec3<Real> x = cosine[i] * T.x + sine[i] * T.y, y = cosine[i] * T.y - sine[i] * T.x;
    const Real dz = step.slides ? q[i] + Real(step.pz) : Real(step.pz);
    T.p = T.p + Real(step.px) * x + Real(step.py) * y + dz * T.z;
    T.x = x;
    T.y = Real(step.cos_alpha) * y + Real(step.sin_alpha) * T.z;
    T.z = Real(step.cos_alpha) * T.z - Real(step.sin_alpha) * y;
  }
  const Vec3<Real> x = Real(chain.cos_last) * T.x + Real(chain.sin_last) * T.y;
  T.y = Real(chain.cos_last) * T.y - Real(chain.sin_last) * T.x;
  T.x = x;
  return T;
}

// T_out (16): T_base_tool, row by row.
template <class Real>
inline void forward(const Chain &chain, const Real *q, Real *T_out) {
  walk(chain, q, [](int, const Vec3<Real> &, const Vec3<Real> &) {}).write(T_out);
}

// J (6, n): rows [v; w], at the tool point, in base axes or in tool axes. Returns T_base_tool.
template <class Real>
inline Pose<Real> jacobian(const Chain &chain, const Real *q, bool tool, Real *J) {
  Vec3<Real> axis[max_joints], point[max_joints];
  const Pose<Real> T = walk(chain, q, [&](int i, const Vec3<Real> &z, const Vec3<Real> &p) {
    axis[i] = z;
    point[i] = p;
  });
  const int n = chain.n;
  for (int i = 0; i < n; ++i) {
    Vec3<Real> v = axis[i], w{Real(0.0), Real(0.0), Real(0.0)};
    if (!chain.steps[i].slides) {
      w = v;
      v = cross(w, T.p - point[i]);
    }
    if (tool) {
      v = T.turn_back(v);
      w = T.turn_back(w);
    }
    J[i] = v.x;
    J[n + i] = v.y;
    J[2 * n + i] = v.z;
    J[3 * n + i] = w.x;
    J[4 * n + i] = w.y;
    J[5 * n + i] = w.z;
  }
  return T;
}

// T_{i-1,i} = E_{i-1} Z_i(q_i) (counting joints from 1): link frame i in link frame i - 1, the base for i = 1.
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

}  // namespace armlab
