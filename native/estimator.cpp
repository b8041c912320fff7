#include "estimator.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "kinematics.h"
#include "rigid_body.h"

namespace armlab {
namespace {

constexpr double rest_time = 0.5;  // s
constexpr double largest = 1e100;  // N m; a torque error beyond it would overflow in the filter and never leave it
constexpr double unknown = 1.0;    // largest variance of a variable in [-1, 1]
constexpr double pi = 3.14159265358979323846;

bool finite(const double *values, int n) {
  return std::all_of(values, values + n, [](double x) { return std::isfinite(x); });
}

// Second-order Butterworth low-pass in state-variable form; a and g follow from the corner frequency and dt.
double lowpass(double *state, double x, double g, double a) {
  const double v1 = a * (state[0] + g * (x - state[1]));
  const double v2 = state[1] + g * v1;
  state[0] = 2.0 * v1 - state[0];
  state[1] = 2.0 * v2 - state[1];
  return v2;
}

// Lower Cholesky factor of S (n, n) in place. S is positive definite: C_tau has a positive diagonal.
void cholesky(double *S, int n) {
  for (int j = 0; j < n; ++j) {
    for (int k = 0; k < j; ++k)
      for (int i = j; i < n; ++i) S[n * i + j] -= S[n * i + k] * S[n * j + k];
    const double root = std::sqrt(S[n * j + j]);
    for (int i = j; i < n; ++i) S[n * i + j] /= root;
  }
}

// x <- S^-1 x for the factor L of S.
void cholesky_solve(const double *L, int n, double *x) {
  for (int i = 0; i < n; ++i) {
    for (int k = 0; k < i; ++k) x[i] -= L[n * i + k] * x[k];
    x[i] /= L[n * i + i];
  }
  for (int i = n - 1; i >= 0; --i) {
    for (int k = i + 1; k < n; ++k) x[i] -= L[n * k + i] * x[k];
    x[i] /= L[n * i + i];
  }
}

}  // namespace

double slide(double z, double dy, double delta) {
  if (dy == 0.0) return z;
  const double sign = dy > 0.0 ? 1.0 : -1.0;
  return sign + (z - sign) * std::exp(-std::fabs(dy) / delta);
}

double follow(double &y, double q, double resolution) {
  const double moved = std::min(std::max(y, q - resolution), q + resolution);
  const double dy = moved - y;
  y = moved;
  return dy;
}

WrenchEstimator::WrenchEstimator(const Parameters &parameters) : p_(parameters) {
  for (int i = 0; i < n(); ++i) {
    const JointFriction &f = p_.friction[i];
    static_[i] = 0.5 * (f.coulomb_pos + f.coulomb_neg) + std::max(f.stribeck, 0.0);
  }
  reset();
}

void WrenchEstimator::reset() {
  joints_.fill(Joint{0.0, 0.0, 0.0, unknown, {{0.0, 0.0}, {0.0, 0.0}}});
  first_ = true;
}

double WrenchEstimator::drive_torque(int i, double q, double qd, double z) const {
  const JointFriction &f = p_.friction[i];
  const JointRipple &r = p_.ripple[i];
  const double slow = qd / f.stribeck_speed;
  const double coulomb = f.coulomb_pos * std::max(z, 0.0) + f.coulomb_neg * std::min(z, 0.0);
  const double friction = f.viscous * qd + coulomb + f.offset + f.stribeck * z * std::exp(-(slow * slow));
  return friction + r.cosine * std::cos(r.cycles * q) + r.sine * std::sin(r.cycles * q);
}

bool WrenchEstimator::advance(const double *q, const double *qd, const double *tau, double dt, double *raw) {
  const int n = this->n();
  if (!finite(q, n) || !finite(qd, n) || !finite(tau, n) || !(dt > 0.0) || !std::isfinite(dt)) return false;
  const double relax = 1.0 - std::exp(-dt / rest_time);
  std::array<Joint, max_joints> next;
  double qdd[max_joints], rigid[max_joints];
  for (int i = 0; i < n; ++i) {
    Joint &joint = next[i] = joints_[i];
    if (first_) {
      joint.play = q[i];
      joint.qd = qd[i];
    }
    const JointFriction &f = p_.friction[i];
    const double dy = follow(joint.play, q[i], f.resolution);
    joint.z = slide(joint.z, dy, f.delta);
    joint.uncertainty += (unknown - joint.uncertainty) * relax;
    joint.uncertainty *= std::exp(-2.0 * std::fabs(dy) / f.delta);
    qdd[i] = (qd[i] - joint.qd) / dt;
    joint.qd = qd[i];
  }
  rnea(p_.chain, q, qd, qdd, p_.gravity.data(), p_.links.data(), rigid);
  for (int i = 0; i < n; ++i) {
    raw[i] = rigid[i] + p_.rotor[i] * qdd[i] + drive_torque(i, q[i], qd[i], next[i].z) - tau[i];
    if (!(std::fabs(raw[i]) < largest)) return false;
  }
  std::copy_n(next.begin(), n, joints_.begin());
  return true;
}

void WrenchEstimator::step(const double *q, const double *qd, const double *tau, double dt, double *F, double *P,
                           double *observability, double *error, double *variance) {
  const int n = this->n();
  double raw[max_joints], J[6 * max_joints];
  if (!advance(q, qd, tau, dt, raw)) {
    const double nan = std::numeric_limits<double>::quiet_NaN();
    std::fill(F, F + 6, nan);
    std::fill(P, P + 36, nan);
    std::fill(observability, observability + 6, nan);
    std::fill(error, error + n, nan);
    std::fill(variance, variance + n, nan);
    return;
  }
  const bool first = first_;
  first_ = false;
  const double g = std::tan(pi * std::min(p_.cutoff * dt, 0.45));
  const double a = 1.0 / (1.0 + g * (g + std::sqrt(2.0)));
  for (int i = 0; i < n; ++i) {
    Joint &joint = joints_[i];
    if (first) {  // start in steady state, without a transient from zero
      joint.low[0][1] = raw[i];
      joint.low[1][1] = joint.uncertainty;
    }
    error[i] = first ? raw[i] : lowpass(joint.low[0], raw[i], g, a);
    const double filtered = first ? joint.uncertainty : lowpass(joint.low[1], joint.uncertainty, g, a);
    const JointCovariance &c = p_.covariance[i];
    const double speed = std::fabs(qd[i]);
    const double weight = c.kind == 0.0 ? std::exp(-c.shape * speed) : (c.kind == 1.0 && speed < c.shape ? 1.0 : 0.0);
    const double stuck = std::min(std::max(filtered, 0.0), unknown);
    variance[i] = (c.at_rest - c.at_speed) * weight + c.at_speed + static_[i] * static_[i] * stuck;
  }
  jacobian(p_.chain, q, false, J);
  posterior(J, error, variance, F, P, observability);
}

void WrenchEstimator::posterior(const double *J, const double *error, const double *variance, double *F, double *P,
                                double *observability) const {
  const int n = this->n();
  double L[max_joints * max_joints], K[6 * max_joints], A[36];
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = i == j ? variance[i] : 0.0;
      for (int k = 0; k < 6; ++k) sum += J[n * k + i] * p_.prior[k] * J[n * k + j];
      L[n * i + j] = sum;
    }
  cholesky(L, n);
  for (int k = 0; k < 6; ++k) {  // rows of K = C_F J S^-1
    double *row = K + n * k;
    for (int i = 0; i < n; ++i) row[i] = p_.prior[k] * J[n * k + i];
    cholesky_solve(L, n, row);
    F[k] = 0.0;
    for (int i = 0; i < n; ++i) F[k] += row[i] * error[i];
  }
  for (int k = 0; k < 6; ++k)  // A = I - K J^T
    for (int l = 0; l < 6; ++l) {
      double sum = k == l ? 1.0 : 0.0;
      for (int i = 0; i < n; ++i) sum -= K[n * k + i] * J[n * l + i];
      A[6 * k + l] = sum;
    }
  for (int k = 0; k < 6; ++k)
    for (int l = 0; l <= k; ++l) {
      double sum = 0.0;
      for (int m = 0; m < 6; ++m) sum += A[6 * k + m] * p_.prior[m] * A[6 * l + m];
      for (int i = 0; i < n; ++i) sum += K[n * k + i] * variance[i] * K[n * l + i];
      P[6 * k + l] = P[6 * l + k] = sum;
    }
  for (int k = 0; k < 6; ++k) observability[k] = 1.0 - P[7 * k] / p_.prior[k];
}

}  // namespace armlab
