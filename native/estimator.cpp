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
constexpr double weak_below = 0.5;
constexpr double spread_sigmas = 3.0, box_sigmas = 10.0;  // of the interval
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

}  // namespace

WrenchEstimator::WrenchEstimator(const Parameters &parameters) : p_(parameters) {
  for (int i = 0; i < n(); ++i) static_[i] = p_.drive.at_rest(i);
  reset();
}

void WrenchEstimator::reset() {
  joints_.fill(Joint{DriveState(), 0.0, unknown, {{0.0, 0.0}, {0.0, 0.0}}});
  first_ = true;
}

double WrenchEstimator::slowness(int i, double qd) const {
  const double ratio = qd / p_.bound[i].speed;
  return std::exp(-(ratio * ratio));
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
      joint.drive = p_.drive.start(i, q[i]);
      joint.qd = qd[i];
    }
    const double dy = p_.drive.move(i, q[i], joint.drive);
    joint.uncertainty += (unknown - joint.uncertainty) * relax;
    joint.uncertainty *= std::exp(-2.0 * std::fabs(dy) / p_.drive.friction[i].delta);
    qdd[i] = (qd[i] - joint.qd) / dt;
    joint.qd = qd[i];
  }
  rnea(p_.chain, q, qd, qdd, p_.gravity.data(), p_.links.data(), rigid);
  for (int i = 0; i < n; ++i) {
    const double dry_share = has_band() ? 1.0 - slowness(i, qd[i]) : 1.0;  // near rest it is anything within the bound
    raw[i] = rigid[i] + p_.rotor[i] * qdd[i] + p_.drive.torque(i, q[i], qd[i], next[i].drive, dry_share) - tau[i];
    if (!(std::fabs(raw[i]) < largest)) return false;
    p_.drive.heat(i, qd[i], dt, next[i].drive);
  }
  std::copy_n(next.begin(), n, joints_.begin());
  return true;
}

void WrenchEstimator::step(const double *q, const double *qd, const double *tau, double dt, WrenchEstimate &e) {
  const int n = this->n();
  double raw[max_joints];
  if (!advance(q, qd, tau, dt, raw)) {
    const double nan = std::numeric_limits<double>::quiet_NaN();
    for (double *values : {e.F, e.observability}) std::fill(values, values + 6, nan);
    for (double *values : {e.error, e.variance, e.bound}) std::fill(values, values + n, nan);
    std::fill(e.P, e.P + 36, nan);
    std::fill(e.interval, e.interval + 12, nan);
    std::fill(e.active, e.active + n, false);
    e.flags = 1;
    return;
  }
  const bool first = first_, band = has_band();
  first_ = false;
  const double g = std::tan(pi * std::min(p_.cutoff * dt, 0.45));
  const double a = 1.0 / (1.0 + g * (g + std::sqrt(2.0)));
  for (int i = 0; i < n; ++i) {
    Joint &joint = joints_[i];
    const JointCovariance &c = p_.covariance[i];
    const double unsure = band ? slowness(i, qd[i]) : joint.uncertainty;
    if (first) {  // start in steady state, without a transient from zero
      joint.low[0][1] = raw[i];
      joint.low[1][1] = unsure;
    }
    e.error[i] = first ? raw[i] : lowpass(joint.low[0], raw[i], g, a);
    const double filtered = std::min(std::max(first ? unsure : lowpass(joint.low[1], unsure, g, a), 0.0), unknown);
    if (band) {  // the bound holds what velocity does to the error near rest
      e.variance[i] = c.at_speed;
      e.bound[i] = p_.bound[i].torque * filtered + p_.bound[i].floor;
      continue;
    }
    const double speed = std::fabs(qd[i]);
    const double weight = c.kind == 0.0 ? std::exp(-c.shape * speed) : (c.kind == 1.0 && speed < c.shape ? 1.0 : 0.0);
    e.variance[i] = (c.at_rest - c.at_speed) * weight + c.at_speed + static_[i] * static_[i] * filtered;
    e.bound[i] = 0.0;
  }
  solve(q, e);
}

void WrenchEstimator::solve(const double *q, WrenchEstimate &e) const {
  const int n = this->n(), k = p_.at_point ? 3 : 6;
  double J[6 * max_joints], S[18], C[6];
  const Pose<double> T = jacobian(p_.chain, q, false, J);
  std::copy_n(p_.prior.begin(), 6, C);
  if (p_.at_point) {  // F = S f with S = [1; hat(r)], r from the tool point to the contact: A = S^T J
    const Vec3<double> r = p_.point[0] * T.x + p_.point[1] * T.y + p_.point[2] * T.z;
    const double hat[18] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, -r.z, r.y, r.z, 0, -r.x, -r.y, r.x, 0};
    std::copy_n(hat, 18, S);
    for (int i = 0; i < n; ++i)
      for (int a = 0; a < 3; ++a)
        for (int m = 3; m < 6; ++m) J[n * a + i] += S[3 * m + a] * J[n * m + i];
    for (int m = 3; m < 6; ++m) {
      C[m] = 0.0;
      for (int a = 0; a < 3; ++a) C[m] += S[3 * m + a] * S[3 * m + a] * p_.prior[a];
    }
  }
  WrenchSolution x;
  solve_wrench({n, k, J, e.error, e.variance, e.bound, p_.prior.data()}, p_.method, x);
  std::copy_n(x.active, n, e.active);
  e.flags = x.singular ? 16 : 0;
  if (has_band() && std::none_of(x.active, x.active + n, [](bool active) { return active; })) e.flags |= 4;
  if (p_.at_point) {
    for (int m = 0; m < 6; ++m) {
      e.F[m] = 0.0;
      for (int a = 0; a < 3; ++a) e.F[m] += S[3 * m + a] * x.x[a];
      for (int l = 0; l < 6; ++l) {
        double sum = 0.0;
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b) sum += S[3 * m + a] * x.P[3 * a + b] * S[3 * l + b];
        e.P[6 * m + l] = sum;
      }
    }
  } else {
    std::copy_n(x.x, 6, e.F);
    std::copy_n(x.P, 36, e.P);
  }
  for (int m = 0; m < 6; ++m) {
    // A moment that cannot be has nothing to hide; without a prior (ls) an axis may be worse known than it would leave it.
    e.observability[m] = C[m] > 0.0 ? std::max(1.0 - e.P[7 * m] / C[m], 0.0) : 1.0;
    if (e.observability[m] < weak_below) e.flags |= 2;
  }
  if (has_interval()) intervals(J, p_.at_point ? S : nullptr, k, e);
}

void WrenchEstimator::intervals(const double *A, const double *S, int k, WrenchEstimate &e) const {
  const int n = this->n();
  double spread[max_joints], box[6], ends[12];
  bool violated[max_joints];
  for (int i = 0; i < n; ++i) spread[i] = e.bound[i] + spread_sigmas * std::sqrt(e.variance[i]);
  for (int a = 0; a < k; ++a) box[a] = box_sigmas * std::sqrt(p_.prior[a]);
  if (!wrench_interval(n, k, A, e.error, spread, box, ends, violated)) {
    e.flags |= 8;
    std::fill(e.interval, e.interval + 12, std::numeric_limits<double>::quiet_NaN());
    std::copy_n(violated, n, e.active);
    return;
  }
  for (int m = 0; m < 6; ++m)
    for (int end = 0; end < 2; ++end) {
      if (!S) {
        e.interval[2 * m + end] = ends[2 * m + end];
        continue;
      }
      double sum = 0.0;  // the moments of the box that holds the force
      for (int a = 0; a < 3; ++a) sum += S[3 * m + a] * ends[2 * a + ((S[3 * m + a] > 0.0) == (end == 1))];
      e.interval[2 * m + end] = sum;
    }
}

}  // namespace armlab
