// Mass matrix and momentum of a chain, for Real = double (one sample) or Lanes (several).
#pragma once

#include "math/arm/rigid_body.h"

namespace armlab {

// Mass m, first moment h = m c and inertia I about the frame's origin of a body, in that frame.
template <class Real>
struct Body {
  Real m;
  Vec3<Real> h;
  Real I[6];  // Ixx, Ixy, Iyy, Ixz, Iyz, Izz

  Body() = default;
  explicit Body(const double *pi) : m(pi[0]), h(to_vec3<Real>(pi + 1)) {
    for (int k = 0; k < 6; ++k) I[k] = Real(pi[4 + k]);
  }

  Vec3<Real> inertia(const Vec3<Real> &u) const {
    return {I[0] * u.x + I[1] * u.y + I[3] * u.z, I[1] * u.x + I[2] * u.y + I[4] * u.z,
        I[3] * u.x + I[4] * u.y + I[5] * u.z};
  }

  // Adds a body told in frame b; T is T_a_b. Points x become R x + p, so I becomes R I R^T plus
  // (2 p . R h + m p . p) 1 - R h p^T - p (R h)^T - m p p^T.
  void add(const Pose<Real> &T, const Body &b) {
    const Vec3<Real> Rh = T.turn(b.h), &p = T.p;
    const Vec3<Real> rows[3] = {
        {T.x.x, T.y.x, T.z.x}, {T.x.y, T.y.y, T.z.y}, {T.x.z, T.y.z, T.z.z}};  // of R
    const Vec3<Real> turned[3] = {b.inertia(rows[0]), b.inertia(rows[1]), b.inertia(rows[2])};
    const Real trace = Real(2.0) * dot(p, Rh) + b.m * dot(p, p);
    const Vec3<Real> q = Rh + b.m * p;
    I[0] = I[0] + dot(rows[0], turned[0]) + trace - (Rh.x * p.x + p.x * q.x);
    I[1] = I[1] + dot(rows[0], turned[1]) - (Rh.x * p.y + p.x * q.y);
    I[2] = I[2] + dot(rows[1], turned[1]) + trace - (Rh.y * p.y + p.y * q.y);
    I[3] = I[3] + dot(rows[0], turned[2]) - (Rh.x * p.z + p.x * q.z);
    I[4] = I[4] + dot(rows[1], turned[2]) - (Rh.y * p.z + p.y * q.z);
    I[5] = I[5] + dot(rows[2], turned[2]) + trace - (Rh.z * p.z + p.z * q.z);
    h = h + q;
    m = m + b.m;
  }
};

// M (n, n) by composite bodies (Featherstone, Rigid Body Dynamics Algorithms, 2008, 6.2).
// parameters (n, 10).
template <class Real>
inline void mass_matrix(const Chain &chain, const Real *q, const double *parameters, Real *M) {
  const int n = chain.n;
  const Real zero(0.0);
  Pose<Real> T[max_joints];
  Body<Real> rest{};  // links k ... n, in frame k
  for (int k = 0; k < n; ++k) T[k] = link_pose(chain, k, q[k]);
  for (int k = n - 1; k >= 0; --k) {
    Body<Real> body(parameters + 10 * k);
    if (k + 1 < n) body.add(T[k + 1], rest);
    rest = body;
    // The wrench that gives joint k a unit acceleration, carried down to every joint before it.
    const bool slides = chain.steps[k].slides;
    Vec3<Real> f = slides ? Vec3<Real>{zero, zero, rest.m} : Vec3<Real>{-rest.h.y, rest.h.x, zero};
    Vec3<Real> moment = slides ? Vec3<Real>{rest.h.y, -rest.h.x, zero}
                               : Vec3<Real>{rest.I[3], rest.I[4], rest.I[5]};
    for (int i = k; i >= 0; --i) {
      M[n * i + k] = M[n * k + i] = chain.steps[i].slides ? f.z : moment.z;
      if (i == 0) break;
      f = T[i].turn(f);
      moment = T[i].turn(moment) + cross(T[i].p, f);
    }
  }
  M[0] = M[0] + (q[0] - q[0]);  // nothing depends on the first joint, but a NaN there must show
}

// Momentum p = M qd (n) and beta = C^T qd = d(kinetic energy)/dq (n), so that rnea without gravity
// is dp/dt - beta. With l_i the momentum of links i ... n and V_i the twist of link i, in frame i:
//   p_i = S_i . l_i,   beta_i = l_i . (V_i x S_i)
template <class Real>
inline void momentum(const Chain &chain, const Real *q, const Real *qd, const double *parameters,
    Real *p, Real *beta) {
  const int n = chain.n;
  const Real zero(0.0);
  Pose<Real> T[max_joints];
  Vec3<Real> v[max_joints], w[max_joints], linear[max_joints], angular[max_joints];
  Vec3<Real> v0{zero, zero, zero}, w0 = v0;
  for (int i = 0; i < n; ++i) {
    T[i] = link_pose(chain, i, q[i]);
    v[i] = T[i].turn_back(v0 + cross(w0, T[i].p));
    w[i] = T[i].turn_back(w0);
    Real &own = chain.steps[i].slides ? v[i].z : w[i].z;
    own = own + qd[i];
    v0 = v[i];
    w0 = w[i];
    const Body<Real> body(parameters + 10 * i);
    linear[i] = body.m * v[i] + cross(w[i], body.h);
    angular[i] = body.inertia(w[i]) + cross(body.h, v[i]);
  }
  for (int i = n - 1; i >= 0; --i) {
    const Vec3<Real> &f = linear[i], &m = angular[i];
    if (chain.steps[i].slides) {  // S = [z; 0], V x S = [w x z; 0]
      p[i] = f.z;
      beta[i] = f.x * w[i].y - f.y * w[i].x;
    } else {  // S = [0; z], V x S = [v x z; w x z]
      p[i] = m.z;
      beta[i] = (f.x * v[i].y - f.y * v[i].x) + (m.x * w[i].y - m.y * w[i].x);
    }
    if (i == 0) break;
    const Vec3<Real> before = T[i].turn(f);
    linear[i - 1] = linear[i - 1] + before;
    angular[i - 1] = angular[i - 1] + T[i].turn(m) + cross(T[i].p, before);
  }
}

}  // namespace armlab
