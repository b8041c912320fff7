// The rotation nearest to a matrix. Specification: tests/oracles/lie.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "math/lie/lie.h"

namespace armlab {

// Eigenvalues (on the diagonal of K) and eigenvectors (columns of V) of a symmetric matrix, by Jacobi's rotations.
inline void eigenvectors(double (&K)[4][4], double (&V)[4][4]) {
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) V[i][j] = i == j;
  for (int sweep = 0; sweep < 20; ++sweep) {  // a handful suffices: convergence is quadratic
    bool diagonal = true;
    for (int p = 0; p < 3; ++p)
      for (int q = p + 1; q < 4; ++q) {
        if (std::fabs(K[p][q]) <= 1e-17) continue;  // of entries of the order of 1
        diagonal = false;
        const double zeta = (K[q][q] - K[p][p]) / (2.0 * K[p][q]);
        const double t = std::copysign(1.0, zeta) / (std::fabs(zeta) + std::hypot(zeta, 1.0));
        const double c = 1.0 / std::sqrt(t * t + 1.0), s = t * c;
        for (int i = 0; i < 4; ++i) {
          const double a = K[i][p], b = K[i][q], v = V[i][p], w = V[i][q];
          K[i][p] = c * a - s * b;
          K[i][q] = s * a + c * b;
          V[i][p] = c * v - s * w;
          V[i][q] = s * v + c * w;
        }
        for (int i = 0; i < 4; ++i) {
          const double a = K[p][i], b = K[q][i];
          K[p][i] = c * a - s * b;
          K[q][i] = s * a + c * b;
        }
      }
    if (diagonal) return;
  }
}

// One Newton step from R = rotation_from(q): R exp(w), (tr S I - S) w = vee(A - A^T), with A = R^T M and its symmetric
// part S. It removes the rounding of the eigenvector.
inline Quaternion<double> refined(const Quaternion<double> &q, const Rotation<double> &M) {
  const Rotation<double> A = rotation_from(q).inverse() * M;
  const double xy = 0.5 * (A.x.y + A.y.x), xz = 0.5 * (A.x.z + A.z.x), yz = 0.5 * (A.y.z + A.z.y);
  const Vec3<double> a{A.y.z - A.z.y, A.z.x - A.x.z, A.x.y - A.y.x};
  const Vec3<double> x{A.y.y + A.z.z, -xy, -xz}, y{-xy, A.x.x + A.z.z, -yz}, z{-xz, -yz, A.x.x + A.y.y};
  const Vec3<double> yz_cross = cross(y, z);
  const double determinant = dot(x, yz_cross);
  if (!(std::fabs(determinant) > 0.0)) return q;
  const Vec3<double> w = (1.0 / determinant) * Vec3<double>{dot(a, yz_cross), dot(x, cross(a, z)), dot(x, cross(y, a))};
  return norm(w) < 1e-3 ? unit(q * Quaternion<double>{1.0, 0.5 * w}) : q;
}

// R maximises tr(R^T M) = q^T K q: q is the eigenvector of the largest eigenvalue of K, which is linear in M. With the
// singular values of M, and d = det(U V^T), the eigenvalues are s1 + s2 + d s3, s1 - s2 - d s3, -s1 + s2 - d s3,
// -s1 - s2 + d s3; `sigma` gets s1, s2, d s3.
inline Rotation<double> nearest_rotation(Rotation<double> M, double *sigma) {
  double largest = 0.0;
  for (const Vec3<double> *a : {&M.x, &M.y, &M.z})
    for (double number : {a->x, a->y, a->z}) largest = std::fabs(number) <= largest ? largest : std::fabs(number);
  if (!std::isfinite(largest)) {
    constexpr double missing = std::numeric_limits<double>::quiet_NaN();
    std::fill(sigma, sigma + 3, missing);
    return {{missing, missing, missing}, {missing, missing, missing}, {missing, missing, missing}};
  }
  std::fill(sigma, sigma + 3, 0.0);
  if (largest == 0.0) return {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
  M = {{M.x.x / largest, M.x.y / largest, M.x.z / largest},
       {M.y.x / largest, M.y.y / largest, M.y.z / largest},
       {M.z.x / largest, M.z.y / largest, M.z.z / largest}};
  const double wx = M.y.z - M.z.y, wy = M.z.x - M.x.z, wz = M.x.y - M.y.x;
  const double xy = M.x.y + M.y.x, xz = M.x.z + M.z.x, yz = M.y.z + M.z.y;
  double V[4][4], K[4][4] = {{M.x.x + M.y.y + M.z.z, wx, wy, wz},
                             {wx, M.x.x - M.y.y - M.z.z, xy, xz},
                             {wy, xy, M.y.y - M.x.x - M.z.z, yz},
                             {wz, xz, yz, M.z.z - M.x.x - M.y.y}};
  eigenvectors(K, V);
  int order[4] = {0, 1, 2, 3};
  std::sort(order, order + 4, [&](int i, int j) { return K[i][i] > K[j][j]; });
  const int best = order[0];
  for (int i = 0; i < 3; ++i) sigma[i] = 0.5 * largest * (K[best][best] + K[order[i + 1]][order[i + 1]]);
  const Quaternion<double> q = unit(Quaternion<double>{V[0][best], {V[1][best], V[2][best], V[3][best]}});
  return rotation_from(refined(q, M));
}

}  // namespace armlab
