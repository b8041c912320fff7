#include "math/contact/momentum_estimator.h"
#include "math/arm/rigid_body.h"

namespace armlab {
namespace {

constexpr double creep = 1e-3;    // 1/s, of its variance, by which it wanders at rest
constexpr double longest = 20.0;  // s, memory of friction at rest for a joint that no contact turns
constexpr double at_rest = 0.5;   // variance of the presliding state above which a joint rests
constexpr double still = 1.0;  // presliding distances that a joint may move before a tare is void

}  // namespace

MomentumEstimator::MomentumEstimator(const Parameters &parameters) : p_(parameters) {
  const int n = this->n(), m = inputs(), N = n + m;
  x_.resize(N);
  P_.resize(N * N);
  work_.resize(4 * N * N);
  M_.resize(n * n);
  R_.resize(n * n);
  G_.resize(n * m);
  Qp_.resize(n);
  q_.resize(m);
  a_.resize(m);
  reset();
}

void MomentumEstimator::reset() {
  joints_.fill(Joint{JointDrive(), 0.0, 0.0, 0.0, 0.0, 1.0, 0.0});
  seen_ = nominal_ = 0.0;
  first_ = true;
  fresh_ = tared_ = false;
}

bool MomentumEstimator::prepare(
    const double *q, const double *qd, const double *tau, double dt, Sample &s) const {
  const int n = this->n();
  if (!finite(q, n) || !finite(qd, n) || !finite(tau, n) || !(dt > 0.0) || !std::isfinite(dt))
    return false;
  s.apart = first_ || dt > gap_steps * nominal_;
  const double relax = 1.0 - std::exp(-dt / rest_time);
  double p[max_joints], beta[max_joints], gravity[max_joints], zero[max_joints] = {};
  momentum(p_.chain, q, qd, p_.links.data(), p, beta);
  rnea(p_.chain, q, zero, zero, p_.gravity.data(), p_.links.data(), gravity);
  for (int i = 0; i < n; ++i) {
    Joint &joint = s.joints[i] = joints_[i];
    if (s.apart)
      joint.drive.state =
          first_ ? p_.drive.start(i, q[i]) : Drive::restart(q[i], joint.drive.state);
    s.rise[i] = (1.0 - joint.drive.unsure) * relax;
    s.moved[i] = joint.drive.move(p_.drive, i, q[i], relax);
    if (s.apart) {
      joint.drive.unsure = 1.0;
      joint.since_tare = still + 1.0;
    }
    p[i] += p_.rotor[i] * qd[i];
    double u = tau[i] / p_.gains[i] + beta[i] - gravity[i] -
               p_.drive.torque(i, q[i], qd[i], joint.drive.state, 1.0);
    s.load[i] = u - beta[i] + gravity[i];  // with what the rotor takes: its acceleration is unknown
    const double rubs = p_.drive.of_passing(i, s.load[i], qd[i], joint.drive.state, 1.0);
    u -= rubs;
    s.load[i] -= rubs;
    if (!(std::fabs(u) < largest_torque) || !(std::fabs(p[i]) < largest_torque)) return false;
    s.known[i] = s.apart || fresh_ ? u : 0.5 * (u + joint.known);
    s.middle[i] = s.apart ? q[i] : 0.5 * (q[i] + joint.q);
    s.change[i] = p[i] - joint.momentum;
    p_.drive.heat(i, qd[i], dt, joint.drive.state);
    joint.q = q[i];
    joint.known = u;
    joint.momentum = p[i];
    joint.since_tare += s.moved[i];
  }
  return true;
}

void MomentumEstimator::step(
    const double *q, const double *qd, const double *tau, double dt, WrenchEstimate &e) {
  const int n = this->n();
  Sample s;
  e.flags = 0;
  bool valid = prepare(q, qd, tau, dt, s);
  if (valid && p_.filters) valid = filter(q, qd, dt, s, e);
  if (!valid) return e.make_invalid(n);
  if (!p_.filters) observe(q, qd, dt, s, e);
  std::copy_n(s.joints.begin(), n, joints_.begin());
  if (first_) nominal_ = dt;
  first_ = false;
  fresh_ = s.apart;
  std::fill_n(e.active, n, true);
  tared_ = tared_ && std::all_of(joints_.begin(), joints_.begin() + n,
                         [](const Joint &j) { return j.since_tare <= still; });
  if (tared_) e.flags |= 32;
}

// r <- r + (1 - e^(-K h)) ((p - p_before) / h - u - r): J^T F through a low-pass, stable for any
// step. It has seen only a share of the wrench when it starts.
void MomentumEstimator::observe(
    const double *q, const double *qd, double dt, Sample &s, WrenchEstimate &e) {
  const int n = this->n();
  const double share = -std::expm1(-p_.gain * dt);
  seen_ = s.apart ? 0.0 : seen_ + share * (1.0 - seen_);
  double A[6 * max_joints];
  const Unknowns unknowns(point(), jacobian(p_.chain, q, false, A), n, A);
  for (int i = 0; i < n; ++i) {
    Joint &joint = s.joints[i];
    if (s.apart) {
      joint.residual = 0.0;
      joint.unsure = joint.drive.unsure;
    } else {
      joint.residual += share * (s.change[i] / dt - s.known[i] - joint.residual);
      joint.unsure += share * (joint.drive.unsure - joint.unsure);
    }
    e.error[i] = joint.residual;
    const double rest = p_.drive.at_rest(i, s.load[i]);
    e.variance[i] = p_.covariance[i].at(qd[i]) + p_.covariance[i].of_contact(joint.residual) +
                    rest * rest * joint.unsure;
    e.bound[i] = 0.0;
    for (int k = 0; k < unknowns.k; ++k) A[n * k + i] *= seen_;
  }
  WrenchSolution x;
  solve_wrench(
      {n, unknowns.k, A, e.error, e.variance, e.bound, p_.prior.data()}, WrenchMethod::map, x);
  e.tell(unknowns, p_, x.x, x.P);
}

// Inputs of the momentum and their noise: the wrench in units of its prior, friction errors.
void MomentumEstimator::hidden(const Sample &s, const double *A, double dt, WrenchEstimate &e) {
  const int n = this->n(), k = unknowns(), m = inputs();
  std::fill(G_.begin(), G_.end(), 0.0);
  for (int j = 0; j < k; ++j) {
    const double scale = std::sqrt(p_.prior[j]);
    for (int i = 0; i < n; ++i) G_[m * i + j] = A[n * j + i] * scale;
    q_[j] = p_.rate[j] / p_.prior[j];
    a_[j] = p_.leak[j];
  }
  for (int i = 0; i < n; ++i) {
    const double rest = p_.drive.at_rest(i, s.load[i]), friction = rest * rest;
    double speed = 0.0, torque = 0.0;  // of the torque that the wrench's walk makes; of the wrench
    for (int j = 0; j < k; ++j) {
      speed += G_[m * i + j] * G_[m * i + j] * q_[j];
      if (!first_) torque += G_[m * i + j] * x_[n + j];
    }
    double lasting = p_.covariance[i].of_contact(torque);
    if (p_.biased) {  // forgotten with displacement, as the presliding state is
      G_[m * i + k + i] = -1.0;
      a_[k + i] = s.moved[i] / dt;
      q_[k + i] = friction * (s.rise[i] / dt + creep);
    } else {
      lasting += friction * s.joints[i].drive.unsure;
    }
    // An error that stays must not be averaged away: as noise it is so strong that the wrench keeps
    // its doubt, and no stronger.
    const double strength = 2.0 * e.variance[i] * p_.memory[i] + lasting * longest;
    e.variance[i] += lasting;
    Qp_[i] = std::min(strength * speed, e.variance[i] * e.variance[i]) / speed;
    if (!(speed > 0.0)) Qp_[i] = strength;
  }
}

// The momentum is known as well as it is measured, friction as its prior says. The wrench is as
// before the gap and has wandered since, or as its prior says.
void MomentumEstimator::restart(const Sample &s, double dt) {
  const int n = this->n(), k = unknowns(), m = inputs(), N = n + m;
  for (int j = 0; j < m; ++j) {
    const int row = n + j;
    if (first_ || j >= k) {
      for (int l = 0; l < N; ++l) P_[N * row + l] = P_[N * l + row] = 0.0;
      x_[row] = 0.0;
      const double rest = j < k ? 1.0 : p_.drive.at_rest(j - k, s.load[j - k]);
      P_[(N + 1) * row] = rest * rest;
      continue;
    }
    const Leak leak = leak_integrals(a_[j], dt);
    x_[row] *= leak.decay;
    for (int l = 0; l < N; ++l) {
      P_[N * row + l] *= leak.decay;
      P_[N * l + row] *= leak.decay;
    }
    P_[(N + 1) * row] += q_[j] * leak.zz;
  }
  for (int i = 0; i < n; ++i) {
    x_[i] = s.joints[i].momentum;
    for (int l = 0; l < N; ++l) P_[N * i + l] = P_[N * l + i] = l < n ? R_[n * i + l] : 0.0;
  }
}

bool MomentumEstimator::filter(
    const double *q, const double *qd, double dt, const Sample &s, WrenchEstimate &e) {
  const int n = this->n(), m = inputs();
  double A[6 * max_joints], p[max_joints];
  const Unknowns middle(point(), jacobian(p_.chain, s.middle, false, A), n, A);
  mass_matrix(p_.chain, q, p_.links.data(), M_.data());
  for (int i = 0; i < n; ++i) {
    M_[(n + 1) * i] += p_.rotor[i];
    e.variance[i] = p_.covariance[i].at(qd[i]);
    e.bound[i] = 0.0;
    p[i] = s.joints[i].momentum;
  }
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = 0.0;
      for (int l = 0; l < n; ++l)
        sum += M_[n * i + l] * p_.qd_noise[l] * p_.qd_noise[l] * M_[n * j + l];
      R_[n * i + j] = R_[n * j + i] = sum;
    }
  hidden(s, A, dt, e);
  if (s.apart) restart(s, dt);
  else if (!momentum_step({n, m, G_.data(), Qp_.data(), q_.data(), a_.data()}, s.known, p,
               R_.data(), dt, x_.data(), P_.data(), work_.data()))
    return false;
  report(q, middle, e);
  return true;
}

void MomentumEstimator::report(const double *q, const Unknowns &middle, WrenchEstimate &e) const {
  const int n = this->n(), k = unknowns(), m = inputs(), N = n + m;
  double x[6], P[36];
  for (int j = 0; j < k; ++j) {
    const double scale = std::sqrt(p_.prior[j]);
    x[j] = scale * x_[n + j];
    for (int l = 0; l < k; ++l)
      P[k * j + l] = scale * std::sqrt(p_.prior[l]) * P_[N * (n + j) + n + l];
  }
  for (int i = 0; i < n; ++i) {
    e.error[i] = 0.0;
    for (int j = 0; j < m; ++j) e.error[i] += G_[m * i + j] * x_[n + j];
  }
  if (!p_.at_point) return e.tell(middle, p_, x, P);
  double J[6 * max_joints];
  e.tell(Unknowns(point(), jacobian(p_.chain, q, false, J), n, J), p_, x, P);
}

// The posterior of all else given that the wrench is zero.
bool MomentumEstimator::tare() {
  const int n = this->n(), k = unknowns(), N = n + inputs();
  const bool rests = std::all_of(joints_.begin(), joints_.begin() + n,
      [](const Joint &joint) { return joint.drive.unsure > at_rest; });
  if (first_ || !p_.biased || !p_.filters || !rests) return false;
  double L[36], z[6];
  for (int j = 0; j < k; ++j) {
    z[j] = x_[n + j];
    for (int l = 0; l < k; ++l) L[k * j + l] = P_[N * (n + j) + n + l];
  }
  if (!cholesky(L, k)) return false;
  std::vector<double> gain(N * k);
  for (int r = 0; r < N; ++r) {
    double *row = gain.data() + k * r;
    std::copy_n(P_.begin() + N * r + n, k, row);
    cholesky_solve(L, k, row);
  }
  const std::vector<double> before(P_);
  for (int r = 0; r < N; ++r)
    for (int j = 0; j < k; ++j) {
      x_[r] -= gain[k * r + j] * z[j];
      for (int c = 0; c < N; ++c) P_[N * r + c] -= gain[k * r + j] * before[N * (n + j) + c];
    }
  for (int j = n; j < n + k; ++j) {
    x_[j] = 0.0;
    for (int c = 0; c < N; ++c) P_[N * j + c] = P_[N * c + j] = 0.0;
  }
  for (int r = 0; r < N; ++r)
    for (int c = 0; c < r; ++c)
      P_[N * r + c] = P_[N * c + r] = 0.5 * (P_[N * r + c] + P_[N * c + r]);
  for (Joint &joint : joints_) joint.since_tare = 0.0;
  return tared_ = true;
}

}  // namespace armlab
