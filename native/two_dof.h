// Two-degree-of-freedom control of a movement primitive. Specification: armlab/kernels/_reference/two_dof.py.
#pragma once

#include <vector>

#include "chain.h"

namespace armlab {

enum class Phase { canonical, time, position };

class TwoDof {
 public:
  struct Parameters {
    Phase phase;
    int n, m;                                      // coordinates, kernels
    std::vector<double> centres, widths, weights;  // (m), (m), (m, n)
    std::vector<double> y0, g, dead_zone, scale;   // (n)
    double alpha_z, beta_z, alpha_x, tau, duration;
    double kp, kv, kc, alpha_e, e_max;
  };
  // The speed at the beginning and at the end of a step, and its change after it.
  struct Speed {
    double start, end, rate;
  };

  explicit TwoDof(Parameters parameters);

  int n() const { return p_.n; }
  int size() const { return 5 * p_.n + 2; }  // of a state

  // Moves a state on in place. driven (n): velocity of ya from outside, NaN where it follows its reference.
  void advance(double *state, double dt, long steps, const double *driven, const Speed &speed);
  // out (3, n): yc', yc'' and ya_ref''.
  void reference(const double *state, const Speed &speed, double *out);
  // `advance` with the velocity measured last, then ya and yad (n) are measured; out as of `reference`.
  void follow(double *state, double dt, long steps, const Speed &speed, const double *ya, const double *yad, double *out);
  double time_constant(const double *state) const;

 private:
  static constexpr int most = 5 * max_joints + 2;
  struct Law;

  double frozen(const double *state) const;
  void law(const double *state, double v, double rate, Law &law);
  void rates(const double *state, double v, double rate, const double *driven, double *out);
  void forcing(double x, const double *yc, double *f);
  void basis(double x, int first, int last, double *sums);

  Parameters p_;
  std::vector<double> exponents_;  // room for one evaluation
};

}  // namespace armlab
