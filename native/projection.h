// The part of a joint motion that the tool does not feel.
#pragma once

#include "inverse_step.h"

namespace armlab {

// At one posture, of the task with M rows: A = J J^T = L D L^T.
template <int M>
class Projection {
 public:
  Projection(int n, const Iterate<M> &at) : n_(n), at_(at) {
    for (int a = 0; a < M; ++a)
      for (int b = 0; b <= a; ++b) {
        L_[a][b] = a == b ? least : 0.0;
        for (int i = 0; i < n; ++i) L_[a][b] += at.J[i][a] * at.J[i][b];
      }
    for (int j = 0; j < M; ++j) {
      for (int k = 0; k < j; ++k) L_[j][j] -= L_[j][k] * L_[j][k] * D_[k];
      D_[j] = std::max(L_[j][j], least);
      for (int i = j + 1; i < M; ++i) {
        for (int k = 0; k < j; ++k) L_[i][j] -= L_[i][k] * L_[j][k] * D_[k];
        L_[i][j] /= D_[j];
      }
    }
  }

  // y = A^-1 y
  void divide(double *y) const {
    for (int i = 1; i < M; ++i)
      for (int k = 0; k < i; ++k) y[i] -= L_[i][k] * y[k];
    for (int i = 0; i < M; ++i) y[i] /= D_[i];
    for (int i = M - 2; i >= 0; --i)
      for (int k = i + 1; k < M; ++k) y[i] -= L_[k][i] * y[k];
  }

  // v (n) becomes its part that leaves the tool where it is: v - J^T A^-1 J v.
  void project(double *v) const {
    double y[M] = {};
    for (int i = 0; i < n_; ++i)
      for (int a = 0; a < M; ++a) y[a] += at_.J[i][a] * v[i];
    divide(y);
    for (int i = 0; i < n_; ++i)
      for (int a = 0; a < M; ++a) v[i] -= at_.J[i][a] * y[a];
  }

 private:
  static constexpr double least = 1e-14;  // keeps A invertible in singular postures

  int n_;
  const Iterate<M> &at_;
  double L_[M][M], D_[M];
};

}  // namespace armlab
