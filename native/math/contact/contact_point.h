// What is unknown of a contact: the wrench F, or a force f at a known point of the tool, F = S f
// with S = [1; hat(r)].
#pragma once

#include <algorithm>

#include "math/arm/kinematics.h"

namespace armlab {

struct Unknowns {
  int k = 6;
  double S[18];  // (6, 3), of a known point

  // `point` (3) in tool axes, or null. J (6, n) becomes A = S^T J in its first k rows.
  Unknowns(const double *point, const Pose<double> &T_base_tool, int n, double *J) {
    if (!point) return;
    k = 3;
    const Vec3<double> r =
        point[0] * T_base_tool.x + point[1] * T_base_tool.y + point[2] * T_base_tool.z;
    const double map[18] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, -r.z, r.y, r.z, 0, -r.x, -r.y, r.x, 0};
    std::copy_n(map, 18, S);
    for (int i = 0; i < n; ++i)
      for (int a = 0; a < 3; ++a)
        for (int m = 3; m < 6; ++m) J[n * a + i] += S[3 * m + a] * J[n * m + i];
  }

  // F (6) and its covariance (6, 6) from x (k) and P (k, k).
  void wrench(const double *x, const double *P, double *F, double *cov) const {
    if (k == 6) {
      std::copy_n(x, 6, F);
      std::copy_n(P, 36, cov);
      return;
    }
    for (int m = 0; m < 6; ++m) {
      F[m] = 0.0;
      for (int a = 0; a < 3; ++a) F[m] += S[3 * m + a] * x[a];
      for (int l = 0; l < 6; ++l) {
        double sum = 0.0;
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b) sum += S[3 * m + a] * P[3 * a + b] * S[3 * l + b];
        cov[6 * m + l] = sum;
      }
    }
  }

  // Prior variance of axis m of the wrench.
  double variance(const double *prior, int m) const {
    if (k == 6 || m < 3) return prior[m];
    double sum = 0.0;
    for (int a = 0; a < 3; ++a) sum += S[3 * m + a] * S[3 * m + a] * prior[a];
    return sum;
  }
};

}  // namespace armlab
