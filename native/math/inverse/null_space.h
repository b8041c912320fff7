// Linear algebra of the self-motion: null space of a task, and Newton steps in it.
#pragma once

#include "math/arm/chain.h"

namespace armlab {

constexpr double no_slope = 1e-6;  // relative slope that counts as zero if there is no curvature

// The null space of J (M rows) over the moving joints, and the projection of a gradient onto it:
// gradient = J^T mu + N reduced. Computed by Householder reflections of J^T.
template <int M>
struct NullSpace {
  int joints, joint[max_joints];         // the moving joints
  int size;                              // dimension
  double basis[max_joints][max_joints];  // N^T (size, joints), orthonormal
  double mu[M], reduced[max_joints];

  void find(int n, const double (*J)[M], const double *gradient, const bool *fixed) {
    joints = 0;
    for (int i = 0; i < n; ++i)
      if (!fixed[i]) joint[joints++] = i;
    size = std::max(joints - M, 0);
    std::fill_n(mu, M, 0.0);
    if (size == 0) return;
    double A[max_joints][M], V[M][max_joints], y[max_joints];
    for (int f = 0; f < joints; ++f) {
      std::copy_n(J[joint[f]], M, A[f]);
      y[f] = gradient[joint[f]];
    }
    for (int a = 0; a < M; ++a) {
      double square = 0.0, scale = 0.0, *v = V[a];
      for (int f = a; f < joints; ++f) square += A[f][a] * A[f][a];
      for (int f = a; f < joints; ++f) v[f] = A[f][a];
      v[a] += v[a] > 0.0 ? std::sqrt(square) : -std::sqrt(square);
      for (int f = a; f < joints; ++f) scale += v[f] * v[f];
      scale = scale > 0.0 ? std::sqrt(2.0 / scale) : 0.0;
      for (int f = a; f < joints; ++f) v[f] *= scale;
      for (int b = a; b < M; ++b) {
        double along = 0.0;
        for (int f = a; f < joints; ++f) along += v[f] * A[f][b];
        for (int f = a; f < joints; ++f) A[f][b] -= along * v[f];
      }
      mirror(v, a, y);
    }
    // R mu = the first M elements of y; in singular directions, the multiplier is 0
    for (int a = M - 1; a >= 0; --a) {
      mu[a] = y[a];
      for (int b = a + 1; b < M; ++b) mu[a] -= A[a][b] * mu[b];
      mu[a] = std::fabs(A[a][a]) > 1e-12 ? mu[a] / A[a][a] : 0.0;
    }
    for (int k = 0; k < size; ++k) {
      reduced[k] = y[M + k];
      std::fill_n(basis[k], joints, 0.0);
      basis[k][M + k] = 1.0;
      for (int a = M - 1; a >= 0; --a) mirror(V[a], a, basis[k]);
    }
  }

  double slope() const {
    double square = 0.0;
    for (int k = 0; k < size; ++k) square += reduced[k] * reduced[k];
    return std::sqrt(square);
  }

  // direction (n) = N z.
  void expand(int n, const double *z, double *direction) const {
    std::fill_n(direction, n, 0.0);
    for (int f = 0; f < joints; ++f)
      for (int k = 0; k < size; ++k) direction[joint[f]] += z[k] * basis[k][f];
  }

 private:
  void mirror(const double *v, int from, double *x) const {
    double along = 0.0;
    for (int f = from; f < joints; ++f) along += v[f] * x[f];
    for (int f = from; f < joints; ++f) x[f] -= along * v[f];
  }
};

inline void rotate(double &x, double &y, double c, double s) {
  const double turned = c * x - s * y;
  y = s * x + c * y;
  x = turned;
}

// z = -|H|^-1 g with the absolute values of the eigenvalues: a descent direction even with negative
// curvature, and zero along directions without slope and curvature. Jacobi rotations diagonalise
// H.
inline void newton_step(int size, double (*H)[max_joints], const double *g, double *z) {
  double V[max_joints][max_joints], largest = 0.0, length = 0.0;  // rows: eigenvectors
  for (int k = 0; k < size; ++k)
    for (int l = 0; l < size; ++l) V[k][l] = k == l ? 1.0 : 0.0;
  for (int sweep = 0; sweep < 30; ++sweep) {
    double off = 0.0, diagonal = 0.0;
    for (int k = 0; k < size; ++k) {
      diagonal += H[k][k] * H[k][k];
      for (int l = 0; l < k; ++l) off += H[k][l] * H[k][l];
    }
    if (off <= 1e-32 * diagonal) break;
    for (int k = 0; k < size; ++k)
      for (int l = 0; l < k; ++l) {
        if (H[k][l] == 0.0) continue;
        const double theta = (H[l][l] - H[k][k]) / (2.0 * H[k][l]);
        const double t =
            (theta < 0.0 ? -1.0 : 1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1.0));
        const double c = 1.0 / std::sqrt(t * t + 1.0), s = t * c;
        for (int m = 0; m < size; ++m) rotate(H[m][k], H[m][l], c, s);
        for (int m = 0; m < size; ++m) rotate(H[k][m], H[l][m], c, s);
        for (int m = 0; m < size; ++m) rotate(V[k][m], V[l][m], c, s);
      }
  }
  for (int k = 0; k < size; ++k) largest = std::max(largest, std::fabs(H[k][k]));
  for (int k = 0; k < size; ++k) length += g[k] * g[k];
  length = std::sqrt(length);
  std::fill_n(z, size, 0.0);
  for (int k = 0; k < size; ++k) {
    double along = 0.0;
    for (int l = 0; l < size; ++l) along -= V[k][l] * g[l];
    const double flat = 1e-9 * largest;
    if (std::fabs(H[k][k]) <= flat && std::fabs(along) <= no_slope * length) continue;
    along /= std::max(std::fabs(H[k][k]), flat);
    for (int l = 0; l < size; ++l) z[l] += along * V[k][l];
  }
}

}  // namespace armlab
