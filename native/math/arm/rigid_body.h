// Rigid-body dynamics of a chain, for Real = double (one sample) or Lanes (several).
//
// Parameters per link, in the link frame, about its origin: m, m cx, m cy, m cz, Ixx, Ixy, Iyy,
// Ixz, Iyz, Izz. Everything is told in link frames; w, wd are the angular velocity and acceleration
// of a link, a the acceleration of its origin, where the base accelerates by -gravity (recursive
// Newton-Euler: Siciliano et al., Robotics, 2009, 7.5).
#pragma once

#include "math/arm/kinematics.h"

namespace armlab {

template <class Real>
struct LinkMotion {
  Vec3<Real> w, wd, a;
};

template <class Real>
inline Vec3<Real> to_vec3(const double *v) {
  return {Real(v[0]), Real(v[1]), Real(v[2])};
}

// The motion of link i from that of link i - 1; T is the link's pose in the one before.
template <class Real>
inline LinkMotion<Real> next_motion(const LinkMotion<Real> &before, const Pose<Real> &T,
    bool slides, const Real &qd, const Real &qdd) {
  const Vec3<Real> &w0 = before.w;
  LinkMotion<Real> link;
  link.w = T.turn_back(w0);
  link.wd = T.turn_back(before.wd);
  link.a = T.turn_back(before.a + cross(before.wd, T.p) + cross(w0, cross(w0, T.p)));
  if (slides) {  // acceleration along the axis and Coriolis, 2 w x (z qd)
    link.a = link.a + Vec3<Real>{(qd + qd) * link.w.y, -(qd + qd) * link.w.x, qdd};
  } else {  // w x (z qd) and z qdd
    link.wd = link.wd + Vec3<Real>{qd * link.w.y, -qd * link.w.x, qdd};
    link.w.z = link.w.z + qd;
  }
  return link;
}

template <class Real>
inline LinkMotion<Real> base_motion(const double *gravity) {
  const Vec3<Real> zero{Real(0.0), Real(0.0), Real(0.0)};
  return {zero, zero, zero - to_vec3<Real>(gravity)};
}

// I u with I = Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
template <class Number, class Real>
inline Vec3<Real> inertia_times(const Number *I, const Vec3<Real> &u) {
  return {Real(I[0]) * u.x + Real(I[1]) * u.y + Real(I[3]) * u.z,
      Real(I[1]) * u.x + Real(I[2]) * u.y + Real(I[4]) * u.z,
      Real(I[3]) * u.x + Real(I[4]) * u.y + Real(I[5]) * u.z};
}

// tau (n) of the motion q, qd, qdd: recursive Newton-Euler. parameters (n, 10).
template <class Real>
inline void rnea(const Chain &chain, const Real *q, const Real *qd, const Real *qdd,
    const double *gravity, const double *parameters, Real *tau) {
  Pose<Real> T[max_joints];
  Vec3<Real> force[max_joints], moment[max_joints];
  LinkMotion<Real> link = base_motion<Real>(gravity);
  for (int i = 0; i < chain.n; ++i) {
    T[i] = link_pose(chain, i, q[i]);
    link = next_motion(link, T[i], chain.steps[i].slides, qd[i], qdd[i]);
    const double *pi = parameters + 10 * i;
    const Vec3<Real> h = to_vec3<Real>(pi + 1);  // m c
    force[i] = Real(pi[0]) * link.a + cross(link.wd, h) + cross(link.w, cross(link.w, h));
    moment[i] = inertia_times(pi + 4, link.wd) + cross(link.w, inertia_times(pi + 4, link.w)) +
                cross(h, link.a);
  }
  for (int i = chain.n - 1; i >= 0; --i) {
    tau[i] = chain.steps[i].slides ? force[i].z : moment[i].z;
    if (i == 0) break;
    const Vec3<Real> f = T[i].turn(force[i]);
    force[i - 1] = force[i - 1] + f;
    moment[i - 1] = moment[i - 1] + T[i].turn(moment[i]) + cross(T[i].p, f);
  }
}

// Axes of the joints up to a link as twists [v; w] in its frame: tau_i = v . force + w . moment.
template <class Real>
struct JointAxes {
  Vec3<Real> v[max_joints], w[max_joints];

  // From link k - 1 to link k, whose own axis joins.
  void advance(int k, const Pose<Real> &T, bool slides) {
    const Vec3<Real> zero{Real(0.0), Real(0.0), Real(0.0)}, z{Real(0.0), Real(0.0), Real(1.0)};
    for (int i = 0; i < k; ++i) {
      v[i] = T.turn_back(v[i] + cross(w[i], T.p));
      w[i] = T.turn_back(w[i]);
    }
    v[k] = slides ? z : zero;
    w[k] = slides ? zero : z;
  }
};

// One row block of the rigid regressor: (v, w) . (wrench of each unit parameter).
template <class Real>
inline void wrench_row(
    const LinkMotion<Real> &link, const Vec3<Real> &v, const Vec3<Real> &w, Real *row) {
  // Powers of force and moment as forms in h = m c: v . (wd x h + w0 x (w0 x h)) + w . (h x a).
  const Vec3<Real> h = cross(v, link.wd) + cross(cross(v, link.w), link.w) + cross(link.a, w);
  // And in I: w . (I wd) + (w x w0) . (I w0).
  const Vec3<Real> u = cross(w, link.w);
  const Vec3<Real> &b = link.wd, &c = link.w;
  row[0] = dot(v, link.a);
  row[1] = h.x;
  row[2] = h.y;
  row[3] = h.z;
  row[4] = w.x * b.x + u.x * c.x;
  row[5] = (w.x * b.y + w.y * b.x) + (u.x * c.y + u.y * c.x);
  row[6] = w.y * b.y + u.y * c.y;
  row[7] = (w.x * b.z + w.z * b.x) + (u.x * c.z + u.z * c.x);
  row[8] = (w.y * b.z + w.z * b.y) + (u.y * c.z + u.z * c.y);
  row[9] = w.z * b.z + u.z * c.z;
}

// Y (n, 10 n): tau = Y parameters.
template <class Real>
inline void rigid_regressor(const Chain &chain, const Real *q, const Real *qd, const Real *qdd,
    const double *gravity, Real *Y) {
  const int n = chain.n;
  JointAxes<Real> axes;
  LinkMotion<Real> link = base_motion<Real>(gravity);
  for (int k = 0; k < n; ++k) {
    const Pose<Real> T = link_pose(chain, k, q[k]);
    link = next_motion(link, T, chain.steps[k].slides, qd[k], qdd[k]);
    axes.advance(k, T, chain.steps[k].slides);
    for (int i = 0; i < n; ++i) {
      Real *row = Y + 10 * (n * i + k);
      if (i <= k) wrench_row(link, axes.v[i], axes.w[i], row);
      else
        for (int j = 0; j < 10; ++j) row[j] = Real(0.0);
    }
  }
}

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

  Vec3<Real> inertia(const Vec3<Real> &u) const { return inertia_times(I, u); }

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
