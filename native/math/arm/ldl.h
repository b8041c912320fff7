// Factorisation A = L D L^T of small symmetric matrices over Real (double or Lanes), and solutions.
#pragma once

#include "math/arm/chain.h"

namespace armlab {

// Factorises in place: L below the diagonal of A (n, n), 1 / D on it. False if a pivot <= `least`.
template <class Real>
inline bool factor(Real *A, int n, Real least = Real(0.0)) {
  bool definite = true;
  Real D[max_joints], scaled[max_joints]{};
  for (int j = 0; j < n; ++j) {
    D[j] = A[n * j + j];
    for (int k = 0; k < j; ++k) {
      scaled[k] = A[n * j + k] * D[k];
      D[j] = D[j] - A[n * j + k] * scaled[k];
    }
    definite &= all(least < D[j]);
    A[n * j + j] = Real(1.0) / D[j];
    for (int i = j + 1; i < n; ++i) {
      for (int k = 0; k < j; ++k) A[n * i + j] = A[n * i + j] - A[n * i + k] * scaled[k];
      A[n * i + j] = A[n * i + j] * A[n * j + j];
    }
  }
  return definite;
}

// X <- A^-1 X (n, columns) with A from `factor`.
template <class Real>
inline void substitute(const Real *A, int n, Real *X, int columns = 1) {
  const auto subtract = [&](int i, int k, const Real &part) {
    for (int j = 0; j < columns; ++j)
      X[columns * i + j] = X[columns * i + j] - part * X[columns * k + j];
  };
  for (int i = 1; i < n; ++i)
    for (int k = 0; k < i; ++k) subtract(i, k, A[n * i + k]);
  for (int i = n - 1; i >= 0; --i) {
    for (int j = 0; j < columns; ++j) X[columns * i + j] = X[columns * i + j] * A[n * i + i];
    for (int k = i + 1; k < n; ++k) subtract(i, k, A[n * k + i]);
  }
}

}  // namespace armlab
