// Static MAP contact wrench with presliding friction; armlab/kernels/_reference/estimator.py states the mathematics.
#pragma once

#include <array>

#include "chain.h"

namespace armlab {

// z <- s + (z - s) exp(-|dy| / delta), s = sign(dy).
double slide(double z, double dy, double delta);

// y follows q with a play of +-resolution; returns dy and moves y.
double follow(double &y, double q, double resolution);

struct JointFriction {
  double viscous, coulomb_pos, coulomb_neg, offset, stribeck, stribeck_speed, delta, resolution;
};
struct JointRipple {
  double cycles, cosine, sine;
};
struct JointCovariance {
  double at_rest, at_speed, shape, kind;  // kind: 0 exponential, 1 step, 2 constant
};

class WrenchEstimator {
 public:
  struct Parameters {
    explicit Parameters(const Chain &chain) : chain(chain) {}
    Chain chain;
    std::array<double, 3> gravity;
    std::array<double, 10 * max_joints> links;
    std::array<double, max_joints> rotor;
    std::array<JointFriction, max_joints> friction;
    std::array<JointRipple, max_joints> ripple;
    std::array<JointCovariance, max_joints> covariance;
    std::array<double, 6> prior;
    double cutoff;
  };

  explicit WrenchEstimator(const Parameters &parameters);

  int n() const { return p_.chain.n; }
  void reset();

  // One sample; F (6), P (36), observability (6), torque error (n), its variance (n). NaN for a sample that is not finite.
  void step(const double *q, const double *qd, const double *tau, double dt, double *F, double *P, double *observability,
            double *error, double *variance);

 private:
  struct Joint {
    double play, qd, z, uncertainty, low[2][2];  // low-pass states of torque error and of uncertainty
  };

  // Moves play, presliding state and velocity by one sample and gives the torque error; false, and nothing moved, when
  // the sample or its torque error is not finite.
  bool advance(const double *q, const double *qd, const double *tau, double dt, double *raw);
  double drive_torque(int i, double q, double qd, double z) const;
  void posterior(const double *J, const double *error, const double *variance, double *F, double *P,
                 double *observability) const;

  Parameters p_;
  std::array<double, max_joints> static_;
  std::array<Joint, max_joints> joints_;
  bool first_;
};

}  // namespace armlab
