#include "math/contact/momentum_estimator.h"
#include "math/arm/rigid_body.h"

namespace armlab {
namespace {

constexpr double creep = 1e-3;    // 1/s, relative random-walk rate of the friction variance at rest
constexpr double longest = 20.0;  // s, memory of friction at rest in a joint not moved by contact
constexpr double at_rest = 0.5;   // variance of the presliding state above which a joint rests
constexpr double still = 1.0;     // presliding distances of motion after which a tare is void

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
  joints_.fill(Joint{JointDrive(), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0});
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
  const double relax = 1.0 - std::exp(-dt / rest_time), share = -std::expm1(-settling * dt);
  double p[max_joints], beta[max_joints], gravity[max_joints];
  momentum(p_.bodies(), q, qd, p, beta);
  gravity_torque(p_.bodies(), q, gravity);
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
    s.load[i] = u - beta[i] + gravity[i];  // includes the rotor, whose acceleration is unknown
    const double rubs = p_.drive.of_passing(i, s.load[i], qd[i], joint.drive.state, 1.0);
    u -= rubs;
    s.load[i] -= rubs;
    if (!(std::fabs(u) < largest_torque) || !(std::fabs(p[i]) < largest_torque)) return false;
    s.known[i] = s.apart || fresh_ ? u : 0.5 * (u + joint.known);
    s.middle[i] = s.apart ? q[i] : 0.5 * (q[i] + joint.q);
    s.change[i] = p[i] - joint.momentum;
    p_.drive.heat(i, qd[i], dt, joint.drive.state);
    double &acceleration = joint.drive.acceleration;
    acceleration = s.apart ? 0.0 : acceleration + share * ((qd[i] - joint.qd) / dt - acceleration);
    joint.q = q[i];
    joint.qd = qd[i];
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

// r <- r + (1 - e^(-K h)) ((p - p_before) / h - u - r): low-pass filtered J^T F, stable for any
// step. At first, it contains only part of the wrench.
void MomentumEstimator::observe(
    const double *q, const double *qd, double dt, Sample &s, WrenchEstimate &e) {
  const int n = this->n();
  const double share = -std::expm1(-p_.gain * dt);
  seen_ = s.apart ? 0.0 : seen_ + share * (1.0 - seen_);
  double A[6 * max_joints], doubt[max_joints];
  const Unknowns unknowns(point(), jacobian(p_.chain, q, false, A), n, A);
  p_.doubt.variance(p_, p_.drive, q, qd, s.joints, s.load, doubt);
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
                    doubt[i] + rest * rest * joint.unsure;
    e.bound[i] = 0.0;
    for (int k = 0; k < unknowns.k; ++k) A[n * k + i] *= seen_;
  }
  WrenchSolution x;
  solve_wrench(
      {n, unknowns.k, A, e.error, e.variance, e.bound, p_.prior.data()}, WrenchMethod::map, x);
  e.tell(unknowns, p_, x.x, x.P);
}

// Inputs to the momentum and their noise: wrench in units of its prior, and friction errors.
void MomentumEstimator::hidden(const double *q, const double *qd, const Sample &s, const double *A,
    double dt, WrenchEstimate &e) {
  const int n = this->n(), k = unknowns(), m = inputs();
  std::fill(G_.begin(), G_.end(), 0.0);
  for (int j = 0; j < k; ++j) {
    const double scale = std::sqrt(p_.prior[j]);
    for (int i = 0; i < n; ++i) G_[m * i + j] = A[n * j + i] * scale;
    q_[j] = p_.rate[j] / p_.prior[j];
    a_[j] = p_.leak[j];
  }
  double doubt[max_joints];
  p_.doubt.variance(p_, p_.drive, q, qd, s.joints, s.load, doubt);
  for (int i = 0; i < n; ++i) {
    const double rest = p_.drive.at_rest(i, s.load[i]), friction = rest * rest;
    double speed = 0.0, torque = 0.0;  // torque variance rate of the walk; contact torque
    for (int j = 0; j < k; ++j) {
      speed += G_[m * i + j] * G_[m * i + j] * q_[j];
      if (!first_) torque += G_[m * i + j] * x_[n + j];
    }
    double lasting = p_.covariance[i].of_contact(torque) + doubt[i];
    if (p_.biased) {  // displacement erases it, as it erases the presliding state
      G_[m * i + k + i] = -1.0;
      a_[k + i] = s.moved[i] / dt;
      q_[k + i] = friction * (s.rise[i] / dt + creep);
    } else {
      lasting += friction * s.joints[i].drive.unsure;
    }
    // A constant error must not be averaged away. The noise intensity that represents it is scaled
    // only enough to preserve the uncertainty of the wrench.
    const double strength = 2.0 * e.variance[i] * p_.memory[i] + lasting * longest;
    e.variance[i] += lasting;
    Qp_[i] = std::min(strength * speed, e.variance[i] * e.variance[i]) / speed;
    if (!(speed > 0.0)) Qp_[i] = strength;
  }
}

// Momentum starts with its measurement covariance, and friction with its prior. The wrench is the
// one before the gap plus its random walk since then, or else its prior.
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
  mass_matrix(p_.bodies(), q, M_.data());
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
  hidden(q, qd, s, A, dt, e);
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

// Conditions all other states on a zero wrench.
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
  if (!factor(L, k)) return false;
  std::vector<double> gain(N * k);
  for (int r = 0; r < N; ++r) {
    double *row = gain.data() + k * r;
    std::copy_n(P_.begin() + N * r + n, k, row);
    substitute(L, k, row);
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

namespace {

// (1 - 2 phi / h + zz / h) / x^2 for x <= 1, where this form loses digits: the sum of
// (2^(k+2) - 2) (-x)^k / (k+3)!.
double series(double x) {
  double sum = 0.0, term = 1.0 / 6.0, power = 4.0;
  for (int k = 0; k < 20 && std::fabs(term) > 1e-24; ++k, power *= 2.0) {
    sum += term * (power - 2.0);
    term *= -x / (k + 4);
  }
  return sum;
}

}  // namespace

Leak leak_integrals(double a, double h) {
  const double x = a * h;
  if (!(x > 0.0)) return {1.0, h, h, 0.5 * h * h, h * h * h / 3.0};
  const double phi = -std::expm1(-x) / a, zz = -std::expm1(-2.0 * x) / (2.0 * a);
  const double pp = x > 1.0 ? (h - 2.0 * phi + zz) / (a * a) : h * h * h * series(x);
  return {std::exp(-x), phi, zz, 0.5 * phi * phi, pp};
}

namespace {

// C (rows, columns) = A (rows, inner) B (inner, columns); sa, sb, ... are row strides.
void multiply(int rows, int inner, int columns, const double *A, int sa, const double *B, int sb,
    double *C, int sc) {
  for (int i = 0; i < rows; ++i) {
    double *c = C + sc * i;
    std::fill_n(c, columns, 0.0);
    for (int k = 0; k < inner; ++k) {
      const double f = A[sa * i + k];
      const double *b = B + sb * k;
      for (int j = 0; j < columns; ++j) c[j] += f * b[j];
    }
  }
}

// P <- Phi P Phi^T + Q. Only the first n rows of Phi have off-diagonal entries, W = G diag(phi).
void predict(const MomentumInputs &in, double h, double *x, double *P, double *W, double *T) {
  const int n = in.n, m = in.m, N = n + m;
  Leak leak[max_inputs];
  for (int j = 0; j < m; ++j) leak[j] = leak_integrals(in.a[j], h);
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < m; ++j) W[m * i + j] = in.G[m * i + j] * leak[j].phi;
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < m; ++j) x[i] += W[m * i + j] * x[n + j];
  for (int j = 0; j < m; ++j) x[n + j] *= leak[j].decay;
  // Momentum rows of Phi P: those of P plus W times the input rows.
  multiply(n, m, N, W, m, P + N * n, N, T, N);
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < N; ++j) P[N * i + j] += T[N * i + j];
  // Momentum columns of (Phi P) Phi^T, momentum rows only; symmetry gives the rest.
  for (int i = 0; i < n; ++i)
    for (int k = 0; k <= i; ++k) {
      double sum = P[N * i + k] + (i == k ? in.Qp[i] * h : 0.0);
      for (int j = 0; j < m; ++j)
        sum += P[N * i + n + j] * W[m * k + j] +
               in.G[m * i + j] * in.q[j] * leak[j].pp * in.G[m * k + j];
      T[N * i + k] = T[N * k + i] = sum;
    }
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < m; ++j)
      P[N * (n + j) + i] = P[N * i + n + j] =
          P[N * i + n + j] * leak[j].decay + in.G[m * i + j] * in.q[j] * leak[j].pz;
    std::copy_n(T + N * i, n, P + N * i);
  }
  for (int i = 0; i < m; ++i)
    for (int j = 0; j < m; ++j)
      P[N * (n + i) + n + j] = leak[i].decay * P[N * (n + i) + n + j] * leak[j].decay +
                               (i == j ? in.q[i] * leak[i].zz : 0.0);
}

}  // namespace

bool momentum_step(const MomentumInputs &in, const double *u, const double *y, const double *R,
    double h, double *x_, double *P_, double *work) {
  const int n = in.n, N = in.n + in.m;
  double *P = work, *K = work + N * N, *T = work + 2 * N * N, *W = work + 3 * N * N;
  double x[max_states], S[max_joints * max_joints], innovation[max_joints];
  std::copy_n(x_, N, x);
  std::copy_n(P_, N * N, P);
  predict(in, h, x, P, W, T);
  for (int i = 0; i < n; ++i) {
    x[i] += h * u[i];
    innovation[i] = y[i] - x[i];
    for (int j = 0; j < n; ++j) S[n * i + j] = P[N * i + j] + R[n * i + j];
  }
  if (!factor(S, n)) return false;
  for (int i = 0; i < N; ++i) {  // rows of K = P[:, :n] S^-1
    std::copy_n(P + N * i, n, K + n * i);
    substitute(S, n, K + n * i);
    for (int k = 0; k < n; ++k) x[i] += K[n * i + k] * innovation[k];
  }
  // Joseph form A P A^T + K R K^T with A = I - K [I 0]: first T = A P, then P = T A^T.
  multiply(N, n, N, K, n, P, N, T, N);
  for (int i = 0; i < N * N; ++i) T[i] = P[i] - T[i];
  double *KR = W;
  multiply(N, n, n, K, n, R, n, KR, n);
  for (int i = 0; i < N; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = T[N * i + j], other = T[N * j + i];
      for (int k = 0; k < n; ++k) {
        sum += KR[n * i + k] * K[n * j + k] - T[N * i + k] * K[n * j + k];
        other += KR[n * j + k] * K[n * i + k] - T[N * j + k] * K[n * i + k];
      }
      P_[N * i + j] = P_[N * j + i] = 0.5 * (sum + other);
    }
  std::copy_n(x, N, x_);
  return true;
}

}  // namespace armlab
