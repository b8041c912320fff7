// Wrench from joint torque errors, e = A^T x + d + noise; mathematics: tests/oracles/wrench.py.
//
// x are k <= 6 unknowns with prior N(0, diag(prior)): the wrench itself, or a force at a known
// point. d are bounded errors of the joints, |d_i| <= bound_i. Nothing here allocates.
#pragma once

#include "math/arm/chain.h"
#include "math/arm/ldl.h"

namespace armlab {

enum class WrenchMethod { map, bounded, clip, interval, ls, lund, ols };
constexpr int wrench_methods = static_cast<int>(WrenchMethod::ols) + 1;

struct WrenchProblem {
  int n, k;
  const double *A;         // (k, n), the Jacobian's rows for the unknowns
  const double *error;     // (n)
  const double *variance;  // (n)
  const double *bound;     // (n), used by bounded, clip and interval
  const double *prior;     // (k) variances
};

struct WrenchSolution {
  double x[6], P[36];       // P (k, k) row by row
  bool active[max_joints];  // joints that carry information
  int iterations;
  double kkt;     // largest entry of the gradient in units of the prior, bounded and clip
  bool singular;  // the numbers do not determine x, which is NaN then
};

void solve_wrench(const WrenchProblem &problem, WrenchMethod method, WrenchSolution &solution);

// Smallest and largest values (k, 2) of each unknown in {x : |e - A^T x| <= spread, |x| <= box}.
// False when the set is empty; then violated (n) marks the contradictory joints. NaN: not finite.
bool wrench_interval(int n, int k, const double *A, const double *error, const double *spread,
    const double *box, double *interval, bool *violated);

}  // namespace armlab
