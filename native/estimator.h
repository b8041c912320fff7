// Contact wrench from joint motion and torque; armlab/kernels/_reference/estimator.py states the mathematics.
#pragma once

#include <array>

#include "chain.h"
#include "drive.h"
#include "wrench.h"

namespace armlab {

struct JointCovariance {
  double at_rest, at_speed, shape, kind;  // kind: 0 exponential, 1 step, 2 constant
};
// Low-speed friction is anything within +-(torque exp(-(qd/speed)^2) + floor).
struct JointBound {
  double torque, speed, floor;
};

// One estimate. Bits of flags: 1 invalid, 2 weak, 4 stuck, 8 infeasible, 16 singular.
struct WrenchEstimate {
  double F[6], P[36], observability[6], error[max_joints], variance[max_joints], bound[max_joints], interval[12];
  bool active[max_joints];
  int flags;
};

class WrenchEstimator {
 public:
  struct Parameters {
    explicit Parameters(const Chain &chain) : chain(chain) {}
    Chain chain;
    std::array<double, 3> gravity;
    std::array<double, 10 * max_joints> links;
    std::array<double, max_joints> rotor;
    Drive drive;
    std::array<JointCovariance, max_joints> covariance;
    std::array<JointBound, max_joints> bound;
    std::array<double, 6> prior;
    double cutoff;
    WrenchMethod method;
    bool at_point;                // the contact is at a known point: a force of three unknowns
    std::array<double, 3> point;  // it, in tool axes
  };

  explicit WrenchEstimator(const Parameters &parameters);

  int n() const { return p_.chain.n; }
  bool has_band() const {
    return p_.method == WrenchMethod::bounded || p_.method == WrenchMethod::clip || p_.method == WrenchMethod::interval;
  }
  bool has_interval() const { return p_.method == WrenchMethod::interval; }
  void reset();

  // One sample. All NaN and flag 1 for a sample that is not finite; then nothing has moved.
  void step(const double *q, const double *qd, const double *tau, double dt, WrenchEstimate &estimate);

 private:
  struct Joint {
    DriveState drive;
    double qd, uncertainty, low[2][2];  // low-pass states of torque error and of uncertainty (or of the bound)
  };

  // Moves play, presliding state and velocity by one sample and gives the torque error; false, and nothing moved, when
  // the sample or its torque error is not finite.
  bool advance(const double *q, const double *qd, const double *tau, double dt, double *raw);
  double slowness(int i, double qd) const;
  void solve(const double *q, WrenchEstimate &estimate) const;
  void intervals(const double *A, const double *S, int k, WrenchEstimate &estimate) const;

  Parameters p_;
  std::array<double, max_joints> static_;
  std::array<Joint, max_joints> joints_;
  bool first_;
};

}  // namespace armlab
