// Rigid-body dynamics of a chain, for Real = double (one sample) or Lanes (several).
//
// Parameters per link, in the link frame, about its origin: m, m cx, m cy, m cz, Ixx, Ixy, Iyy,
// Ixz, Iyz, Izz. All quantities are in link frames. w and wd are the angular velocity and
// acceleration of a link, and a is the acceleration of its origin; the base accelerates by -gravity
// (recursive Newton-Euler: Siciliano et al., Robotics, 2009, 7.5).
#pragma once

#include <vector>

#include "math/arm/ldl.h"
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

// The motion of link i from that of link i - 1; T is the pose of link i in link i - 1.
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

// A chain with masses: gravity (3) in base axes, link parameters (n, 10), and the motor inertia
// (n, n) reflected to the joints, or null.
struct Bodies {
  const Chain &chain;
  const double *gravity, *links, *motors = nullptr;
};

// The same data, owning its memory.
struct RigidBody {
  Chain chain;
  std::array<double, 3> gravity;
  std::array<double, 10 * max_joints> links;
  std::vector<double> motors;

  Bodies bodies() const {
    return {chain, gravity.data(), links.data(), motors.empty() ? nullptr : motors.data()};
  }
};

// I u with I = Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
template <class Number, class Real>
inline Vec3<Real> inertia_times(const Number *I, const Vec3<Real> &u) {
  return {Real(I[0]) * u.x + Real(I[1]) * u.y + Real(I[3]) * u.z,
      Real(I[1]) * u.x + Real(I[2]) * u.y + Real(I[4]) * u.z,
      Real(I[3]) * u.x + Real(I[4]) * u.y + Real(I[5]) * u.z};
}

// tau (n) for the motion q, qd, qdd by recursive Newton-Euler. wrench (6): exerted by the
// environment on the tool, at the tool point in base axes, or null.
template <class Real>
inline void rnea(const Bodies &arm, const Real *q, const Real *qd, const Real *qdd, Real *tau,
    const Real *wrench = nullptr) {
  const Chain &chain = arm.chain;
  const int n = chain.n;
  Pose<Real> T[max_joints];
  Twist<Real> F[max_joints], tip;
  if (wrench) tip = Twist<Real>::read(wrench);
  LinkMotion<Real> link = base_motion<Real>(arm.gravity);
  for (int i = 0; i < n; ++i) {
    T[i] = link_pose(chain, i, q[i]);
    link = next_motion(link, T[i], chain.steps[i].slides, qd[i], qdd[i]);
    const double *pi = arm.links + 10 * i;
    const Vec3<Real> h = to_vec3<Real>(pi + 1);  // m c
    F[i].v = Real(pi[0]) * link.a + cross(link.wd, h) + cross(link.w, cross(link.w, h));
    F[i].w = inertia_times(pi + 4, link.wd) + cross(link.w, inertia_times(pi + 4, link.w)) +
             cross(h, link.a);
    if (wrench) tip = {T[i].turn_back(tip.v), T[i].turn_back(tip.w)};
  }
  if (wrench) {
    F[n - 1].v = F[n - 1].v - tip.v;
    F[n - 1].w = F[n - 1].w - (tip.w + cross(Pose<Real>(chain.frame(n)).p, tip.v));
  }
  for (int i = n - 1; i >= 0; --i) {
    tau[i] = along_axis(F[i], chain.steps[i].slides);
    for (int j = 0; arm.motors && j < n; ++j)
      tau[i] = tau[i] + Real(arm.motors[n * i + j]) * qdd[j];
    if (i > 0) F[i - 1] = F[i - 1] + wrench_from(T[i], F[i]);
  }
}

// One row block of the rigid-body regressor: (v, w) . (wrench of each unit parameter).
template <class Real>
inline void wrench_row(const LinkMotion<Real> &link, const Twist<Real> &S, Real *row) {
  const Vec3<Real> &v = S.v, &w = S.w;
  // Power of force and moment, linear in h = m c: v . (wd x h + w0 x (w0 x h)) + w . (h x a).
  const Vec3<Real> h = cross(v, link.wd) + cross(cross(v, link.w), link.w) + cross(link.a, w);
  // Part linear in I: w . (I wd) + (w x w0) . (I w0).
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
  Twist<Real> axes[max_joints];  // unit twists of the joints up to link k, in frame k
  LinkMotion<Real> link = base_motion<Real>(gravity);
  for (int k = 0; k < n; ++k) {
    const Pose<Real> T = link_pose(chain, k, q[k]);
    link = next_motion(link, T, chain.steps[k].slides, qd[k], qdd[k]);
    for (int i = 0; i < k; ++i) axes[i] = twist_in(T, axes[i]);
    axes[k] = unit_twist<Real>(chain.steps[k].slides);
    for (int i = 0; i < n; ++i) {
      Real *row = Y + 10 * (n * i + k);
      if (i <= k) wrench_row(link, axes[i], row);
      else
        for (int j = 0; j < 10; ++j) row[j] = Real(0.0);
    }
  }
}

// Mass m, first moment h = m c and inertia I of a body, in a frame and about its origin.
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
  Twist<Real> momentum(const Twist<Real> &V) const {
    return {m * V.v + cross(V.w, h), inertia(V.w) + cross(h, V.v)};
  }

  void add(const Body &b) {  // b is in the same frame
    m = m + b.m;
    h = h + b.h;
    for (int k = 0; k < 6; ++k) I[k] = I[k] + b.I[k];
  }

  // Adds a body given in frame b; T is T_a_b. Points x become R x + p, so I becomes R I R^T plus
  // (2 p . R h + m p . p) 1 - R h p^T - p (R h)^T - m p p^T.
  void add(const Pose<Real> &T, const Body &b) {
    const Vec3<Real> Rh = T.turn(b.h), &p = T.p;
    const Vec3<Real> rows[3] = {
        {T.x.x, T.y.x, T.z.x}, {T.x.y, T.y.y, T.z.y}, {T.x.z, T.y.z, T.z.z}};  // rows of R
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

// M (n, n) by the composite-rigid-body algorithm (Featherstone, Rigid Body Dynamics Algorithms,
// 2008, 6.2).
template <class Real>
inline void mass_matrix(const Bodies &arm, const Real *q, Real *M) {
  const Chain &chain = arm.chain;
  const int n = chain.n;
  const Real zero(0.0);
  Pose<Real> T[max_joints];
  Body<Real> rest{};  // links k ... n, in frame k
  for (int k = 0; k < n; ++k) T[k] = link_pose(chain, k, q[k]);
  for (int k = n - 1; k >= 0; --k) {
    Body<Real> body(arm.links + 10 * k);
    if (k + 1 < n) body.add(T[k + 1], rest);
    rest = body;
    // The wrench for a unit acceleration of joint k, transformed to every joint before it.
    const Vec3<Real> &h = rest.h;
    Twist<Real> F{{-h.y, h.x, zero}, {rest.I[3], rest.I[4], rest.I[5]}};
    if (chain.steps[k].slides) F = {{zero, zero, rest.m}, {h.y, -h.x, zero}};
    for (int i = k; i >= 0; --i) {
      M[n * i + k] = M[n * k + i] = along_axis(F, chain.steps[i].slides);
      if (i > 0) F = wrench_from(T[i], F);
    }
  }
  M[0] = M[0] + (q[0] - q[0]);  // independent of the first joint, but a NaN there must show
  for (int k = 0; arm.motors && k < n * n; ++k) M[k] = M[k] + Real(arm.motors[k]);
}

// Momentum p = M qd (n) of the links, and beta = C^T qd = d(kinetic energy)/dq (n). Without
// gravity, rnea is dp/dt - beta. With l_i the momentum of links i ... n and V_i the twist of link
// i, in frame i:
//   p_i = S_i . l_i,   beta_i = l_i . (V_i x S_i)
template <class Real>
inline void momentum(const Bodies &arm, const Real *q, const Real *qd, Real *p, Real *beta) {
  const Chain &chain = arm.chain;
  const int n = chain.n;
  Pose<Real> T[max_joints];
  Twist<Real> V[max_joints], l[max_joints];
  for (int i = 0; i < n; ++i) {
    const bool slides = chain.steps[i].slides;
    T[i] = link_pose(chain, i, q[i]);
    V[i] = qd[i] * unit_twist<Real>(slides);
    if (i > 0) V[i] = twist_in(T[i], V[i - 1]) + V[i];
    l[i] = Body<Real>(arm.links + 10 * i).momentum(V[i]);
  }
  for (int i = n - 1; i >= 0; --i) {
    const bool slides = chain.steps[i].slides;
    p[i] = along_axis(l[i], slides);
    beta[i] = dot(l[i], cross(V[i], unit_twist<Real>(slides)));
    if (i > 0) l[i - 1] = l[i - 1] + wrench_from(T[i], l[i]);
  }
}

// Kinetic and potential energy; the potential energy is zero for masses at the base origin.
template <class Real>
inline void energy(
    const Bodies &arm, const Real *q, const Real *qd, Real *kinetic, Real *potential) {
  const int n = arm.chain.n;
  *kinetic = *potential = q[0] - q[0];
  Twist<Real> V{};
  Pose<Real> T;
  for (int i = 0; i < n; ++i) {
    const Pose<Real> step = link_pose(arm.chain, i, q[i]);
    T = i == 0 ? step : T * step;
    V = twist_in(step, V) + qd[i] * unit_twist<Real>(arm.chain.steps[i].slides);
    const Body<Real> body(arm.links + 10 * i);
    *kinetic = *kinetic + Real(0.5) * dot(V, body.momentum(V));
    for (int j = 0; arm.motors && j < n; ++j)
      *kinetic = *kinetic + Real(0.5 * arm.motors[n * i + j]) * qd[i] * qd[j];
    *potential = *potential - dot(to_vec3<Real>(arm.gravity), T.turn(body.h) + body.m * T.p);
  }
}

// tau (n) at rest: moment of the links after a joint about its axis, or their weight along it.
template <class Real>
inline void gravity_torque(const Bodies &arm, const Real *q, Real *tau) {
  const Vec3<Real> g = to_vec3<Real>(arm.gravity);
  Pose<Real> T[max_joints];
  Real m(0.0);
  Vec3<Real> h{m, m, m};  // mass and first moments, in base axes
  for (int i = 0; i < arm.chain.n; ++i)
    T[i] = i == 0 ? link_pose(arm.chain, i, q[i]) : T[i - 1] * link_pose(arm.chain, i, q[i]);
  for (int i = arm.chain.n - 1; i >= 0; --i) {
    const Body<Real> body(arm.links + 10 * i);
    m = m + body.m;
    h = h + T[i].turn(body.h) + body.m * T[i].p;
    tau[i] =
        arm.chain.steps[i].slides ? -m * dot(g, T[i].z) : dot(T[i].z, cross(g, h - m * T[i].p));
  }
  tau[0] = tau[0] + (q[0] - q[0]);
}

// Derivatives (n, n) of rnea: by_q, which may be null, and by_qd = 2 C, with C from Christoffel
// symbols.
//
// All quantities are in base axes about the first joint's origin (Singh, Russell and Wensing,
// Efficient analytical derivatives of rigid-body dynamics using spatial vector algebra, 2022).
// V_j, A_j: motion of the link before joint j; s_j = V_j x S_j, a_j = A_j x S_j + V_j x s_j.
// I_i, F_i: inertia and wrench of the links i ... n; 2 B_i = V x* I - I V x + (x -> x x* I V):
//   j <= i:  dtau_i/dq_j = S_i . (2 B_i s_j + I_i a_j),  dtau_i/dqd_j = 2 S_i . (B_i S_j + I_i s_j)
//   j < i:   dtau_j/dq_i = S_j . (2 B_i s_i + I_i a_i + S_i x* F_i)
// For mass elements at x with velocity xd, B [v; w] = [w x sum xd; (tr K - K) w], K = sum xd x^T.
// The wrench f, m at the tool, with J_i = [v; w] of joint i, adds -w_j . (v_i x f + w_i x m) to the
// first derivative and -w_j . (v_i x f) to the last.
template <class Real>
inline void rnea_derivatives(const Bodies &arm, const Real *q, const Real *qd, const Real *qdd,
    const Real *wrench, Real *by_q, Real *by_qd) {
  const int n = arm.chain.n;
  const Real two(2.0);
  Twist<Real> S[max_joints], s[max_joints], a[max_joints], F[max_joints], V{}, A{}, pushed{};
  Body<Real> body[max_joints];
  Pose<Real> flow[max_joints], T;  // columns of K, sum of xd
  if (wrench) pushed = Twist<Real>::read(wrench);
  A.v = -to_vec3<Real>(arm.gravity);
  for (int i = 0; i < n; ++i) {
    T = i == 0 ? link_pose(arm.chain, i, q[i]) : T * link_pose(arm.chain, i, q[i]);
    if (i == 0) T.p = T.p - Pose<Real>(arm.chain.frame(0)).p;
    S[i] = joint_twist(arm.chain.steps[i].slides, T.z, T.p);
    s[i] = cross(V, S[i]);
    a[i] = cross(A, S[i]) + cross(V, s[i]);
    V = V + qd[i] * S[i];
    A = A + qdd[i] * S[i] + qd[i] * s[i];
    body[i] = Body<Real>{};
    body[i].add(T, Body<Real>(arm.links + 10 * i));
    body[i].m = body[i].m + (q[i] - q[i]);  // propagate a NaN
    const Twist<Real> l = body[i].momentum(V);
    F[i] = body[i].momentum(A) + wrench_cross(V, l);
    const Real *I = body[i].I, half = Real(0.5) * (I[0] + I[2] + I[5]);  // sum x x^T = half - I
    flow[i] = {body[i].h.x * V.v + cross(V.w, Vec3<Real>{half - I[0], -I[1], -I[3]}),
        body[i].h.y * V.v + cross(V.w, Vec3<Real>{-I[1], half - I[2], -I[4]}),
        body[i].h.z * V.v + cross(V.w, Vec3<Real>{-I[3], -I[4], half - I[5]}), l.v};
  }
  const Vec3<Real> tip = T.p + T.turn(Pose<Real>(arm.chain.frame(n)).p);
  for (int i = n - 1; i >= 0; --i) {
    const Pose<Real> &K = flow[i];
    const Real trace = K.x.x + K.y.y + K.z.z;
    const auto twice_B = [&](const Twist<Real> &x) {
      return two * Twist<Real>{cross(x.w, K.p), trace * x.w - K.turn(x.w)};
    };
    const Twist<Real> t = body[i].momentum(S[i]);
    const Vec3<Real> r = two * (cross(K.p, S[i].v) + trace * S[i].w - K.turn_back(S[i].w));
    const Twist<Real> of_qd = twice_B(S[i]) + two * body[i].momentum(s[i]);
    Twist<Real> of_q = twice_B(s[i]) + body[i].momentum(a[i]) + wrench_cross(S[i], F[i]);
    const Vec3<Real> lever = cross(S[i].v + cross(S[i].w, tip), pushed.v);
    const Vec3<Real> held = lever + cross(S[i].w, pushed.w);
    of_q.w = of_q.w - lever;
    for (int j = 0; j <= i; ++j) {
      by_qd[n * j + i] = dot(S[j], of_qd);
      by_qd[n * i + j] = dot(r, S[j].w) + two * dot(t, s[j]);
      if (!by_q) continue;
      by_q[n * j + i] = dot(S[j], of_q);
      by_q[n * i + j] = dot(r, s[j].w) + dot(t, a[j]) - dot(held, S[j].w);
    }
    if (i == 0) break;
    body[i - 1].add(body[i]);
    F[i - 1] = F[i - 1] + F[i];
    Pose<Real> &sum = flow[i - 1];
    sum = {sum.x + K.x, sum.y + K.y, sum.z + K.z, sum.p + K.p};
  }
}

// qdd (n) for torques tau and, if by_q is not null, its derivatives (n, n): -M^-1 drnea/dq,
// -M^-1 drnea/dqd, M^-1. False if M is not positive definite.
template <class Real>
inline bool forward_dynamics(const Bodies &arm, const Real *q, const Real *qd, const Real *tau,
    const Real *wrench, Real *qdd, Real *by_q = nullptr, Real *by_qd = nullptr,
    Real *by_tau = nullptr) {
  const int n = arm.chain.n;
  const Real still[max_joints]{};
  Real L[max_joints * max_joints], least(0.0);
  rnea(arm, q, qd, still, qdd, wrench);
  for (int i = 0; i < n; ++i) qdd[i] = tau[i] - qdd[i];
  mass_matrix(arm, q, L);
  for (int i = 0; i < n; ++i) least = least + Real(1e-15) * L[n * i + i];
  const bool definite = factor(L, n, least);
  substitute(L, n, qdd);
  if (!by_q) return definite;
  rnea_derivatives(arm, q, qd, qdd, wrench, by_q, by_qd);
  for (int k = 0; k < n * n; ++k) {
    by_q[k] = -by_q[k];
    by_qd[k] = -by_qd[k];
    by_tau[k] = Real(k % (n + 1) == 0 ? 1.0 : 0.0);
  }
  for (Real *columns : {by_q, by_qd, by_tau}) substitute(L, n, columns, n);
  return definite;
}

}  // namespace armlab
