// Cholesky factors of small symmetric positive definite matrices, row by row, whose size is known
// only at run time.
#pragma once

#include <cmath>

namespace armlab {

// Lower factor L of S = L L^T (n, n) in place; what is above the diagonal stays. False when a pivot
// is not above `least`.
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
