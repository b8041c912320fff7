// Contact wrench from the generalised momentum. Theory: docs/theory/contact_force.md.
#pragma once

#include "math/contact/estimator.h"

namespace armlab {

constexpr int max_inputs = max_joints + 6;
constexpr int max_states = max_joints + max_inputs;

// Integrals of a leak a over a step h, with phi(s) = (1 - e^(-a s)) / a: e^(-a h), phi(h), and the
// integrals over the step of e^(-2 a s), phi e^(-a s) and phi^2.
struct Leak {
  double decay, phi, zz, pz, pp;
};
Leak leak_integrals(double a, double h);

struct MomentumInputs {
  int n, m;
  const double *G;           // (n, m)
  const double *Qp, *q, *a;  // (n), (m), (m)
};

// Updates x (n + m) and P (n + m, n + m), row by row, in place; u, y (n), R (n, n). `work`: 4 (n +
// m)^2 numbers. Returns false without any change if the covariance is not positive definite.
bool momentum_step(const MomentumInputs &inputs, const double *u, const double *y, const double *R,
    double h, double *x, double *P, double *work);

class MomentumEstimator {
 public:
  struct Parameters : ArmModel {
    using ArmModel::ArmModel;
    std::array<double, max_joints> memory;    // correlation time of the torque error [s]
    std::array<double, max_joints> qd_noise;  // standard deviation of the measured velocity
    std::array<double, 6> rate, leak;         // random walk of the wrench [N^2/s, (N m)^2/s]; [1/s]
    double gain;                              // observer gain [1/s]
    bool filters;                             // true: Kalman filter; false: observer
    bool biased;                              // estimate a friction error per joint
  };

  explicit MomentumEstimator(const Parameters &parameters);

  int n() const { return p_.chain.n; }
  bool has_interval() const { return false; }
  void reset();
  // Processes one sample. A non-finite sample gives NaN and flag 1, and changes no state.
  void step(
      const double *q, const double *qd, const double *tau, double dt, WrenchEstimate &estimate);
  // Attributes the current torques to friction. False unless all joints rest and the filter
  // estimates friction errors.
  bool tare();

 private:
  struct Joint {
    JointDrive drive;
    double q, qd, known, momentum;  // values of the last sample
    double residual, unsure;        // observer states, low-passed
    double since_tare;              // displacement in presliding distances
  };
  // A prepared sample; the state of the estimator is still unchanged.
  struct Sample {
    std::array<Joint, max_joints> joints;
    double known[max_joints], middle[max_joints];  // torque and position at mid-step
    double change[max_joints], load[max_joints];   // momentum change; torque of the links
    double moved[max_joints], rise[max_joints];    // displacement; rise of var(z) at rest
    bool apart;                                    // after a gap with unknown motion
  };

  int unknowns() const { return p_.at_point ? 3 : 6; }
  int inputs() const { return unknowns() + (p_.biased ? n() : 0); }
  const double *point() const { return p_.at_point ? p_.point.data() : nullptr; }
  bool prepare(const double *q, const double *qd, const double *tau, double dt, Sample &s) const;
  void observe(const double *q, const double *qd, double dt, Sample &s, WrenchEstimate &e);
  bool filter(const double *q, const double *qd, double dt, const Sample &s, WrenchEstimate &e);
  void hidden(const double *q, const double *qd, const Sample &s, const double *A, double dt,
      WrenchEstimate &e);
  void restart(const Sample &s, double dt);
  void report(const double *q, const Unknowns &middle, WrenchEstimate &e) const;

  Parameters p_;
  std::array<Joint, max_joints> joints_;
  std::vector<double> x_, P_, work_;            // filter state [p; z; friction error]
  std::vector<double> M_, R_, G_, Qp_, q_, a_;  // workspace of a step
  double seen_, nominal_;                       // share of the wrench in the observer; first step
  bool first_, fresh_, tared_;                  // fresh: friction was unknown at the last sample
};

}  // namespace armlab
