// Contact wrench from joint motion and torque. Specification: tests/oracles/estimator.py.
#pragma once

#include "math/arm/rigid_body.h"
#include "math/contact/doubt.h"
#include "math/contact/wrench.h"

namespace armlab {

// Unknowns of a contact: the wrench F, or a force f at a known point with F = S f, S = [1; hat(r)].
struct Unknowns {
  int k = 6;
  double S[18];  // (6, 3), for a known point

  // `point` (3) in tool axes, or null. J (6, n) becomes A = S^T J in its first k rows.
  Unknowns(const double *point, const Pose<double> &T_base_tool, int n, double *J) {
    if (!point) return;
    k = 3;
    const Vec3<double> r =
        point[0] * T_base_tool.x + point[1] * T_base_tool.y + point[2] * T_base_tool.z;
    const double map[18] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, -r.z, r.y, r.z, 0, -r.x, -r.y, r.x, 0};
    std::copy_n(map, 18, S);
    for (int i = 0; i < n; ++i)
      for (int a = 0; a < 3; ++a)
        for (int m = 3; m < 6; ++m) J[n * a + i] += S[3 * m + a] * J[n * m + i];
  }

  // F (6) and its covariance (6, 6) from x (k) and P (k, k).
  void wrench(const double *x, const double *P, double *F, double *cov) const {
    if (k == 6) {
      std::copy_n(x, 6, F);
      std::copy_n(P, 36, cov);
      return;
    }
    for (int m = 0; m < 6; ++m) {
      F[m] = 0.0;
      for (int a = 0; a < 3; ++a) F[m] += S[3 * m + a] * x[a];
      for (int l = 0; l < 6; ++l) {
        double sum = 0.0;
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b) sum += S[3 * m + a] * P[3 * a + b] * S[3 * l + b];
        cov[6 * m + l] = sum;
      }
    }
  }

  // Prior variance of axis m of the wrench.
  double variance(const double *prior, int m) const {
    if (k == 6 || m < 3) return prior[m];
    double sum = 0.0;
    for (int a = 0; a < 3; ++a) sum += S[3 * m + a] * S[3 * m + a] * prior[a];
    return sum;
  }
};

constexpr double rest_time = 0.5;  // s, time constant with which friction at rest becomes unknown
constexpr double gap_steps = 5.0;  // in units of the first step; a longer step is a gap
constexpr double largest_torque = 1e100;  // N m; a larger error would never decay in a filter

struct JointCovariance {
  double at_rest, at_speed, shape, kind;  // kind: 0 exponential, 1 step, 2 constant
  double doubt;                           // relative standard deviation of a contact torque

  double of_contact(double torque) const { return doubt * torque * (doubt * torque); }

  double at(double qd) const {
    const double speed = std::fabs(qd);
    const double weight =
        kind == 0.0 ? std::exp(-shape * speed) : (kind == 1.0 && speed < shape ? 1.0 : 0.0);
    return (at_rest - at_speed) * weight + at_speed;
  }
};
// At low speed, friction is only bounded: +-(torque exp(-(qd/speed)^2) + floor).
struct JointBound {
  double torque, speed, floor;
};

// Arm model shared by all estimators.
struct ArmModel : RigidBody {
  explicit ArmModel(const Chain &arm) : RigidBody{arm, {}, {}, {}} {}
  std::array<double, max_joints> rotor;
  Drive drive;
  std::array<double, max_joints> gains;  // measured over true torque
  double gain_variance;                  // variance of their common factor
  std::array<JointCovariance, max_joints> covariance;
  ParameterDoubt doubt;
  std::array<double, 6> prior;
  bool at_point;                // known contact point: three unknown force components
  std::array<double, 3> point;  // contact point in tool axes
};

// Drive of one joint, and the variance of its presliding state in [-1, 1] relative to the largest
// possible variance. Rest increases the variance, displacement reduces it.
struct JointDrive {
  DriveState state;
  double unsure = 1.0;
  double acceleration = 0.0;  // low-passed

  // Moves to position q; returns the displacement in presliding distances.
  double move(const Drive &drive, int i, double q, double relax) {
    const double moved = std::fabs(drive.move(i, q, state)) / drive.friction[i].delta;
    unsure += (1.0 - unsure) * relax;
    unsure *= std::exp(-2.0 * moved);
    return moved;
  }
};

// One estimate. Flag bits: 1 invalid, 2 weak, 4 stuck, 8 infeasible, 16 singular, 32 tared.
struct WrenchEstimate {
  double F[6], P[36], observability[6], interval[12];
  double error[max_joints], variance[max_joints], bound[max_joints];
  bool active[max_joints];
  int flags;

  // Converts the unknowns x (k) with covariance P (k, k) to the wrench and its observability.
  void tell(
      const Unknowns &unknowns, const ArmModel &arm, const double *x, const double *covariance);
  void make_invalid(int n);
};

class WrenchEstimator {
 public:
  struct Parameters : ArmModel {
    using ArmModel::ArmModel;
    std::array<JointBound, max_joints> bound;
    double cutoff;
    WrenchMethod method;
  };

  explicit WrenchEstimator(const Parameters &parameters);

  int n() const { return p_.chain.n; }
  bool has_band() const {
    return p_.method == WrenchMethod::bounded || p_.method == WrenchMethod::clip ||
           p_.method == WrenchMethod::interval;
  }
  bool has_interval() const { return p_.method == WrenchMethod::interval; }
  void reset();

  // Processes one sample. A non-finite sample gives NaN and flag 1, and changes no state.
  void step(
      const double *q, const double *qd, const double *tau, double dt, WrenchEstimate &estimate);

 private:
  struct Joint {
    JointDrive drive;
    double qd, low[2][2];  // low-pass states: torque error; uncertainty or bound
  };

  // Advances backlash, presliding state and velocity by one sample and returns the torque error and
  // the load. Returns false without any change if the sample or its torque error is not finite.
  // After a gap (`apart`), only the thermal state is kept.
  bool advance(const double *q, const double *qd, const double *tau, double dt, bool apart,
      double *raw, double *load);
  double slowness(int i, double qd) const;
  void solve(const double *q, WrenchEstimate &estimate) const;
  void intervals(const double *A, const Unknowns &unknowns, WrenchEstimate &estimate) const;

  Parameters p_;
  std::array<Joint, max_joints> joints_;
  double nominal_;      // step of the first sample
  bool first_, fresh_;  // fresh: no acceleration yet after a gap
};

}  // namespace armlab
