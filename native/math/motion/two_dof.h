// Two-degree-of-freedom control for a movement primitive. Specification: tests/oracles/two_dof.py.
#pragma once

#include "math/arm/chain.h"
#include "math/motion/primitive.h"

namespace armlab {

class TwoDof {
 public:
  struct Parameters {
    Primitive primitive;  // at most max_joints coordinates
    double tau, kp, kv, kc, alpha_e, e_max;
    std::vector<double> y0, g, scale, dead_zone, unit;  // (n)
  };
  // The speed at the start and end of a step, and its rate of change after the step.
  struct Speed {
    double start, end, rate;
  };

  explicit TwoDof(Parameters parameters);

  int n() const { return p_.primitive.n; }
  int size() const { return 5 * n() + 2; }  // length of a state

  // Advances a state in place. driven (n): velocity of ya, or NaN if ya follows its reference.
  void advance(double *state, double dt, long steps, const double *driven, const Speed &speed);
  // out (3, n): yc', yc'' and ya_ref''.
  void reference(const double *state, const Speed &speed, double *out);
  // Time derivative of a state with ya'' = ya_ref''.
  void slopes(const double *state, const Speed &speed, double *out);
  // Advances with the last velocity, then sets ya and yad (n) to measurements; out: see
  // `reference`.
  void follow(double *state, double dt, long steps, const Speed &speed, const double *ya,
      const double *yad, double *out);
  double time_constant(const double *state) const;

 private:
  static constexpr int most = 5 * max_joints + 2;
  struct Law;

  double frozen(const double *state) const;
  void law(const double *state, double v, double rate, Law &law);
  void rates(const double *state, double v, double rate, const double *driven, double *out);
  void forcing(double x, const double *yc, double *f);

  Parameters p_;
  std::vector<int> index_;  // workspace of one evaluation
  std::vector<double> psi_;
};

}  // namespace armlab
