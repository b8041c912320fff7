#include "math/contact/estimator.h"

#include <limits>

#include "math/arm/rigid_body.h"

namespace armlab {
namespace {

constexpr double weak_below = 0.5;
constexpr double spread_sigmas = 3.0, box_sigmas = 10.0;  // for intervals
constexpr double pi = 3.14159265358979323846;

// Second-order Butterworth low-pass in state-variable form; a and g follow from cut-off and dt.
double lowpass(double *state, double x, double g, double a) {
  const double v1 = a * (state[0] + g * (x - state[1]));
  const double v2 = state[1] + g * v1;
  state[0] = 2.0 * v1 - state[0];
  state[1] = 2.0 * v2 - state[1];
  return v2;
}

}  // namespace

void WrenchEstimate::tell(
    const Unknowns &unknowns, const ArmModel &arm, const double *x, const double *covariance) {
  unknowns.wrench(x, covariance, F, P);
  for (int m = 0; m < 6; ++m) {
    // A component excluded by the point has observability 1; without a prior (ls) it may fall to 0.
    const double C = unknowns.variance(arm.prior.data(), m);
    observability[m] = C > 0.0 ? std::max(1.0 - P[7 * m] / C, 0.0) : 1.0;
    if (observability[m] < weak_below) flags |= 2;
  }
  for (int m = 0; m < 6; ++m)
    for (int l = 0; l < 6; ++l) P[6 * m + l] += arm.gain_variance * (F[m] * F[l]);
}

void WrenchEstimate::make_invalid(int n) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (double *values : {F, observability}) std::fill(values, values + 6, nan);
  for (double *values : {error, variance, bound}) std::fill(values, values + n, nan);
  std::fill(P, P + 36, nan);
  std::fill(interval, interval + 12, nan);
  std::fill(active, active + n, false);
  flags = 1;
}

WrenchEstimator::WrenchEstimator(const Parameters &parameters) : p_(parameters) { reset(); }

void WrenchEstimator::reset() {
  joints_.fill(Joint{JointDrive(), 0.0, {{0.0, 0.0}, {0.0, 0.0}}});
  nominal_ = 0.0;
  first_ = true;
  fresh_ = false;
}

double WrenchEstimator::slowness(int i, double qd) const {
  const double ratio = qd / p_.bound[i].speed;
  return std::exp(-(ratio * ratio));
}

bool WrenchEstimator::advance(const double *q, const double *qd, const double *tau, double dt,
    bool apart, double *raw, double *load) {
  const int n = this->n();
  if (!finite(q, n) || !finite(qd, n) || !finite(tau, n) || !(dt > 0.0) || !std::isfinite(dt))
    return false;
  const double relax = 1.0 - std::exp(-dt / rest_time), share = -std::expm1(-settling * dt);
  std::array<Joint, max_joints> next;
  double qdd[max_joints] = {}, rigid[max_joints];
  for (int i = 0; i < n; ++i) {
    Joint &joint = next[i] = joints_[i];
    if (apart) {
      const DriveState state =
          first_ ? p_.drive.start(i, q[i]) : Drive::restart(q[i], joint.drive.state);
      joint = Joint{JointDrive{state}, qd[i], {{0.0, 0.0}, {0.0, 0.0}}};
    }
    joint.drive.move(p_.drive, i, q[i], relax);
    qdd[i] = (qd[i] - joint.qd) / dt;
    joint.drive.acceleration += share * (qdd[i] - joint.drive.acceleration);
    joint.qd = qd[i];
  }
  rnea(p_.bodies(), q, qd, qdd, rigid);
  for (int i = 0; i < n; ++i) {
    // near rest, dry friction can take any value within the bound
    const double dry_share = has_band() ? 1.0 - slowness(i, qd[i]) : 1.0;
    const DriveState &state = next[i].drive.state;
    raw[i] = rigid[i] + p_.rotor[i] * qdd[i] + p_.drive.torque(i, q[i], qd[i], state, dry_share) -
             tau[i] / p_.gains[i];
    raw[i] += p_.drive.of_passing(i, rigid[i] - raw[i], qd[i], state, dry_share);
    load[i] = rigid[i] - raw[i];
    if (!(std::fabs(raw[i]) < largest_torque)) return false;
    p_.drive.heat(i, qd[i], dt, next[i].drive.state);
  }
  std::copy_n(next.begin(), n, joints_.begin());
  return true;
}

void WrenchEstimator::step(
    const double *q, const double *qd, const double *tau, double dt, WrenchEstimate &e) {
  const int n = this->n();
  double raw[max_joints], load[max_joints];
  const bool apart = first_ || dt > gap_steps * nominal_, band = has_band();
  if (!advance(q, qd, tau, dt, apart, raw, load)) return e.make_invalid(n);
  const bool begins = apart || fresh_;  // start in steady state, without a transient
  if (first_) nominal_ = dt;
  fresh_ = apart && !first_;
  first_ = false;
  const double g = std::tan(pi * std::min(p_.cutoff * dt, 0.45));
  const double a = 1.0 / (1.0 + g * (g + std::sqrt(2.0)));
  double doubt[max_joints];
  p_.doubt.variance(p_, p_.drive, q, qd, joints_, load, doubt);
  for (int i = 0; i < n; ++i) {
    Joint &joint = joints_[i];
    const JointCovariance &c = p_.covariance[i];
    const double unsure =
        band ? std::max(slowness(i, qd[i]), joint.drive.unsure) : joint.drive.unsure;
    if (begins) {
      joint.low[0][0] = 0.0;
      joint.low[0][1] = raw[i];
    }
    if (apart) {  // the uncertainty decays like the noise of one sample in the filter
      joint.low[1][0] = 0.0;
      joint.low[1][1] = unsure;
    }
    e.error[i] = begins ? raw[i] : lowpass(joint.low[0], raw[i], g, a);
    const double filtered =
        std::min(std::max(apart ? unsure : lowpass(joint.low[1], unsure, g, a), 0.0), 1.0);
    if (band) {  // the bound includes the velocity-dependent error near rest; without an
                 // acceleration, the error is unbounded
      const double rest = p_.bound[i].torque + p_.drive.friction[i].load * std::fabs(load[i]);
      e.variance[i] = c.at_speed + c.of_contact(e.error[i]) + doubt[i];
      e.bound[i] = apart ? largest_torque : rest * filtered + p_.bound[i].floor;
      continue;
    }
    const double rest = p_.drive.at_rest(i, load[i]);
    e.variance[i] = c.at(qd[i]) + c.of_contact(e.error[i]) + doubt[i] + rest * rest * filtered;
    e.bound[i] = 0.0;
  }
  solve(q, e);
}

void WrenchEstimator::solve(const double *q, WrenchEstimate &e) const {
  const int n = this->n();
  double A[6 * max_joints];
  const Unknowns unknowns(
      p_.at_point ? p_.point.data() : nullptr, jacobian(p_.chain, q, false, A), n, A);
  WrenchSolution x;
  solve_wrench({n, unknowns.k, A, e.error, e.variance, e.bound, p_.prior.data()}, p_.method, x);
  std::copy_n(x.active, n, e.active);
  e.flags = x.singular ? 16 : 0;
  if (has_band() && std::none_of(x.active, x.active + n, [](bool active) { return active; }))
    e.flags |= 4;
  e.tell(unknowns, p_, x.x, x.P);
  if (has_interval()) intervals(A, unknowns, e);
}

void WrenchEstimator::intervals(
    const double *A, const Unknowns &unknowns, WrenchEstimate &e) const {
  const int n = this->n(), k = unknowns.k;
  double spread[max_joints], box[6] = {}, ends[12] = {};
  bool violated[max_joints];
  for (int i = 0; i < n; ++i) spread[i] = e.bound[i] + spread_sigmas * std::sqrt(e.variance[i]);
  for (int a = 0; a < k; ++a) box[a] = box_sigmas * std::sqrt(p_.prior[a]);
  if (!wrench_interval(n, k, A, e.error, spread, box, ends, violated)) {
    e.flags |= 8;
    std::fill(e.interval, e.interval + 12, std::numeric_limits<double>::quiet_NaN());
    std::copy_n(violated, n, e.active);
    return;
  }
  const double widened = spread_sigmas * std::sqrt(p_.gain_variance);
  for (int a = 0; a < k; ++a) {
    ends[2 * a] = std::max(ends[2 * a] - widened * std::fabs(ends[2 * a]), -box[a]);
    ends[2 * a + 1] = std::min(ends[2 * a + 1] + widened * std::fabs(ends[2 * a + 1]), box[a]);
  }
  if (k == 6) {
    std::copy_n(ends, 12, e.interval);
    return;
  }
  for (int m = 0; m < 6; ++m)
    for (int end = 0; end < 2; ++end) {  // moments over the box that contains the force
      double sum = 0.0;
      for (int a = 0; a < 3; ++a) {
        const double share = unknowns.S[3 * m + a];
        sum += share * ends[2 * a + ((share > 0.0) == (end == 1))];
      }
      e.interval[2 * m + end] = sum;
    }
}

}  // namespace armlab
