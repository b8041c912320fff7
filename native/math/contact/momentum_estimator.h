// Contact wrench by the generalised momentum; mathematics: docs/theory/contact_force.md.
#pragma once

#include "math/contact/estimator.h"

namespace armlab {

constexpr int max_inputs = max_joints + 6;
constexpr int max_states = max_joints + max_inputs;

// Of a leak a over a step h, phi(s) = (1 - e^(-a s)) / a: e^(-a h), phi(h), and the integrals over
// the step of e^(-2 a s), phi e^(-a s), phi^2.
struct Leak {
  double decay, phi, zz, pz, pp;
};
Leak leak_integrals(double a, double h);

struct MomentumInputs {
  int n, m;
  const double *G;           // (n, m)
  const double *Qp, *q, *a;  // (n), (m), (m)
};

// x (n + m) and P (n + m, n + m), row by row, in place; u, y (n), R (n, n). `work` holds 4 (n +
// m)^2 numbers. False, and nothing changed, without a positive covariance.
bool momentum_step(const MomentumInputs &inputs, const double *u, const double *y, const double *R,
    double h, double *x, double *P, double *work);

class MomentumEstimator {
 public:
  struct Parameters : ArmModel {
    using ArmModel::ArmModel;
    std::array<double, max_joints> memory;    // correlation time of the torque error [s]
    std::array<double, max_joints> qd_noise;  // deviation of the measured velocity
    std::array<double, 6> rate, leak;         // of the wrench's walk [N^2/s, (N m)^2/s]; [1/s]
    double gain;                              // of the observer [1/s]
    bool filters;                             // Kalman filter, else the observer
    bool biased;                              // the filter has a hidden friction error per joint
  };

  explicit MomentumEstimator(const Parameters &parameters);

  int n() const { return p_.chain.n; }
  bool has_interval() const { return false; }
  void reset();
  // One sample. All NaN and flag 1 for a non-finite sample, which changes no state.
  void step(
      const double *q, const double *qd, const double *tau, double dt, WrenchEstimate &estimate);
  // Assigns the current torques to friction; false unless every joint rests and friction is hidden.
  bool tare();

 private:
  struct Joint {
    JointDrive drive;
    double q, qd, known, momentum;  // of the last sample
    double residual, unsure;        // of the observer: low-passed
    double since_tare;              // displacement, in presliding distances
  };
  // A prepared sample; the state of the estimator is still unchanged.
  struct Sample {
    std::array<Joint, max_joints> joints;
    double known[max_joints], middle[max_joints];  // torque and position in the middle of the step
    double change[max_joints], load[max_joints];   // of the momentum; torque of the links
    double moved[max_joints], rise[max_joints];    // displacement; variance of z that rest adds
    bool apart;  // from the last sample: nothing is known of the time between
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
  std::vector<double> x_, P_, work_;            // of the filter: [p; z; friction error]
  std::vector<double> M_, R_, G_, Qp_, q_, a_;  // of a step, kept so that none allocates
  double seen_, nominal_;       // share of the wrench that the observer has seen; first step
  bool first_, fresh_, tared_;  // fresh: at the last sample nothing was known of friction yet
};

}  // namespace armlab
