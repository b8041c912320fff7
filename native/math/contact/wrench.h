// Wrench from joint torque errors, e = A^T x + d + noise; mathematics: tests/oracles/wrench.py.
//
// x are k <= 6 unknowns with prior N(0, diag(prior)): the wrench itself, or a force at a known
// point. d are bounded errors of the joints, |d_i| <= bound_i. Nothing here allocates.
#pragma once

#include "math/arm/chain.h"

namespace armlab {

enum class WrenchMethod { map, bounded, clip, interval, ls, lund };
constexpr int wrench_methods = static_cast<int>(WrenchMethod::lund) + 1;

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
// False when the set is empty; then violated (n) marks the joints that contradict the others. NaN:
// not finite.
bool wrench_interval(int n, int k, const double *A, const double *error, const double *spread,
    const double *box, double *interval, bool *violated);

// Lower factor L of S = L L^T (n, n) in place. False when a pivot is not above `least`.
inline bool cholesky(double *S, int n, double least = 0.0) {
  for (int j = 0; j < n; ++j) {
    for (int k = 0; k < j; ++k)
      for (int i = j; i < n; ++i) S[n * i + j] -= S[n * i + k] * S[n * j + k];
    if (!(S[n * j + j] > least)) return false;
    const double root = std::sqrt(S[n * j + j]);
    for (int i = j; i < n; ++i) S[n * i + j] /= root;
  }
  return true;
}

// x <- S^-1 x for the factor L of S.
inline void cholesky_solve(const double *L, int n, double *x) {
  for (int i = 0; i < n; ++i) {
    for (int k = 0; k < i; ++k) x[i] -= L[n * i + k] * x[k];
    x[i] /= L[n * i + i];
  }
  for (int i = n - 1; i >= 0; --i) {
    for (int k = i + 1; k < n; ++k) x[i] -= L[n * k + i] * x[k];
    x[i] /= L[n * i + i];
  }
}

}  // namespace armlab
