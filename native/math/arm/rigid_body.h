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

template <class Real>
inline Vec3<Real> inertia_times(
    const double *I, const Vec3<Real> &u) {  // I = Ixx, Ixy, Iyy, Ixz, Iyz, Izz
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

// Axes of the joints up to a link as twists [v; w] in its frame: tau_i = v . force + w . moment of
// a wrench on it.
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

}  // namespace armlab
