// Wrench from joint torque errors, e = A^T x + d + noise. Specification: tests/oracles/wrench.py.
//
// The k <= 6 unknowns x have the prior N(0, diag(prior)): the wrench itself, or a force at a known
// point. d are bounded joint errors, |d_i| <= bound_i. Nothing here allocates.
#pragma once

#include "math/arm/chain.h"
#include "math/arm/ldl.h"

namespace armlab {

enum class WrenchMethod { map, bounded, clip, interval, ls, lund, ols };
constexpr int wrench_methods = static_cast<int>(WrenchMethod::ols) + 1;

struct WrenchProblem {
  int n, k;
  const double *A;         // (k, n), rows of the Jacobian for the unknowns
  const double *error;     // (n)
  const double *variance;  // (n)
  const double *bound;     // (n), used by bounded, clip and interval
  const double *prior;     // (k) variances
};

struct WrenchSolution {
  double x[6], P[36];       // P (k, k) row by row
  bool active[max_joints];  // informative joints
  int iterations;
  double kkt;     // largest gradient entry in units of the prior; bounded, clip
  bool singular;  // x is not determined, hence NaN
};

void solve_wrench(const WrenchProblem &problem, WrenchMethod method, WrenchSolution &solution);

// Smallest and largest values (k, 2) of each unknown in {x : |e - A^T x| <= spread, |x| <= box}.
// False if the set is empty; violated (n) then marks the contradictory joints. NaN: not finite.
bool wrench_interval(int n, int k, const double *A, const double *error, const double *spread,
    const double *box, double *interval, bool *violated);

}  // namespace armlab
