// Variance w^T C w of the modelled torque due to the parameter covariance C, in excess of its mean
// on the identified motion, which the error on held-out rows of that motion already contains.
#pragma once

#include "math/arm/rigid_body.h"
#include "math/contact/drive.h"

namespace armlab {

constexpr double settling = 60.0;  // 1/s, rate of the acceleration filter in row w

// Columns of joint i: those of the regressor [links (10 n), rotors (n)], then its own friction
// parameters: viscous, Coulomb in each direction, offset, Stribeck, root, load.
class ParameterDoubt {
 public:
  enum Term { viscous, coulomb_pos, coulomb_neg, offset, stribeck, root, load, terms };

  struct Joint {
    std::vector<int> columns;
    std::vector<double> cov;  // C, row by row up to the diagonal
    double mean;
  };
  std::vector<Joint> joints;  // empty for exact parameters

  // Torque variance (n) of joints with these states; x (n) is the torque transmitted to the links.
  template <class Joints>
  void variance(const RigidBody &arm, const Drive &drive, const double *q, const double *qd,
      const Joints &states, const double *x, double *out) const {
    const int n = arm.chain.n;
    if (joints.empty()) {
      std::fill_n(out, n, 0.0);
      return;
    }
    double Y[10 * max_joints * max_joints], w[11 * max_joints + terms], qdd[max_joints] = {};
    for (int i = 0; i < n; ++i) qdd[i] = states[i].drive.acceleration;
    rigid_regressor(arm.chain, q, qd, qdd, arm.gravity.data(), Y);
    for (int i = 0; i < n; ++i) {
      const double *row = joints[i].cov.data();
      const int size = static_cast<int>(joints[i].columns.size());
      double friction[terms], sum = 0.0;
      drive.columns(i, qd[i], x[i], states[i].drive.state, friction);
      for (int k = 0; k < size; ++k) {
        const int c = joints[i].columns[k];
        w[k] = c < 10 * n ? Y[10 * n * i + c] : c < 11 * n ? qdd[i] : friction[c - 11 * n];
        sum += w[k] * (2.0 * dot(row, w, k) + row[k] * w[k]);
        row += k + 1;
      }
      out[i] = std::max(sum - joints[i].mean, 0.0);
    }
  }

 private:
  // Four partial sums, which a processor adds in parallel.
  static double dot(const double *a, const double *b, int size) {
    double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
    int k = 0;
    for (; k + 4 <= size; k += 4) {
      s0 += a[k] * b[k];
      s1 += a[k + 1] * b[k + 1];
      s2 += a[k + 2] * b[k + 2];
      s3 += a[k + 3] * b[k + 3];
    }
    for (; k < size; ++k) s0 += a[k] * b[k];
    return (s0 + s1) + (s2 + s3);
  }
};

}  // namespace armlab
