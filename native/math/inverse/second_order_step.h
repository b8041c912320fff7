// A step near a singular posture, where first-order steps stall. See inverse.h.
//
// Near a singularity, joint motions hardly change the residual along one direction u. The other
// rows determine all joint motions except z. The remaining scalar equation needs its second-order
// term:
//   u^T e = u^T J d + u^T S(d, d) / 2,   d = N z,   S(d, d) = (dJ/dq d) d
// N (n, n - M + 1) spans the joint motions that J maps to multiples of u.
#pragma once

#include "math/inverse/inverse_step.h"

namespace armlab {

template <int M>
class SecondOrderStep {
 public:
  SecondOrderStep(const Chain &chain, const Goal &goal, double weight, const Iterate<M> &at)
      : chain_(chain), goal_(goal), weight_(weight), at_(at) {
    find_residual_direction();
    find_motions();
    find_curvature();
    choose();
  }

  // Sets `next` to the posture after `share` of the step, with its residual.
  void take(double share, const Box &box, Iterate<M> &next) const {
    double e[M], dq[max_joints];
    for (int a = 0; a < M; ++a) {
      e[a] = at_.e[a];
      for (int i = 0; i < count_; ++i)
        for (int j = 0; j < count_; ++j)
          e[a] -= 0.5 * share * share * z_[i] * z_[j] * curvature_[i][j][a];
    }
    determined(e, dq);
    for (int i = 0; i < chain_.n; ++i) {
      next.q[i] = at_.q[i] + dq[i];
      for (int k = 0; k < count_; ++k) next.q[i] += share * z_[k] * motions_[k][i];
    }
    for (int correction = 0;; ++correction) {
      for (int i = 0; i < chain_.n; ++i) next.q[i] = clamp(next.q[i], box.low[i], box.high[i]);
      evaluate(chain_, goal_, weight_, next);
      if (correction == corrections) return;
      determined(next.e, dq);
      for (int i = 0; i < chain_.n; ++i) next.q[i] += dq[i];
    }
  }

 private:
  static constexpr int most = 3, angles = 16, corrections = 2;
  static constexpr double tiny = 1e-12, difference = 1e-4;  // damping; rad

  // Finds u, and factorises J J^T + |J|^2 u u^T.
  void find_residual_direction() {
    bool uses[max_joints];
    double A[M][M];
    std::fill_n(uses, chain_.n, true);
    normal_matrix(chain_.n, at_.J, uses, tiny, A);
    double size = 0.0;
    for (int a = 0; a < M; ++a) size += A[a][a];
    std::copy_n(A[0], M * M, A_[0]);
    factor(A[0], M);
    for (int a = 0; a < M; ++a) u_[a] = 1.0 + a;
    for (int round = 0; round < 4; ++round) {
      substitute(A[0], M, u_);
      const double length = std::sqrt(along(u_));
      for (int a = 0; a < M; ++a) u_[a] /= length;
    }
    for (int a = 0; a < M; ++a)
      for (int b = 0; b < M; ++b) A_[a][b] += size * u_[a] * u_[b];
    factor(A_[0], M);
  }

  double along(const double *e) const {  // u^T e
    double sum = 0.0;
    for (int a = 0; a < M; ++a) sum += u_[a] * e[a];
    return sum;
  }

  // The smallest motion that compensates e, except for its part along u.
  void determined(const double *e, double *dq) const {
    double y[M];
    const double part = along(e);
    for (int a = 0; a < M; ++a) y[a] = e[a] - part * u_[a];
    substitute(A_[0], M, y);
    for (int i = 0; i < chain_.n; ++i) {
      dq[i] = 0.0;
      for (int a = 0; a < M; ++a) dq[i] += at_.J[i][a] * y[a];
    }
  }

  // Finds an orthonormal basis of the motions that J maps to multiples of u: the unit motions of
  // the joints minus their `determined` part, longest first.
  void find_motions() {
    const int n = chain_.n;
    double left[max_joints][max_joints];
    for (int j = 0; j < n; ++j) {
      determined(at_.J[j], left[j]);
      for (int i = 0; i < n; ++i) left[j][i] = (i == j) - left[j][i];
    }
    const auto product = [n](const double *a, const double *b) {
      double sum = 0.0;
      for (int i = 0; i < n; ++i) sum += a[i] * b[i];
      return sum;
    };
    for (count_ = 0; count_ < std::min(most, n - M + 1); ++count_) {
      const double *longest = left[0];
      for (int j = 1; j < n; ++j)
        if (product(left[j], left[j]) > product(longest, longest)) longest = left[j];
      const double length = std::sqrt(product(longest, longest));
      double *motion = motions_[count_];
      for (int i = 0; i < n; ++i) motion[i] = longest[i] / length;
      for (int j = 0; j < n; ++j) {
        const double part = product(left[j], motion);
        for (int i = 0; i < n; ++i) left[j][i] -= part * motion[i];
      }
    }
  }

  // Computes S from central differences of J along the motions.
  void find_curvature() {
    Iterate<M> before, after;
    for (int k = 0; k < count_; ++k) {
      for (int i = 0; i < chain_.n; ++i) {
        before.q[i] = at_.q[i] - difference * motions_[k][i];
        after.q[i] = at_.q[i] + difference * motions_[k][i];
      }
      evaluate(chain_, goal_, weight_, before);
      evaluate(chain_, goal_, weight_, after);
      for (int j = 0; j < count_; ++j)
        for (int a = 0; a < M; ++a) {
          double &S = curvature_[k][j][a] = 0.0;
          for (int i = 0; i < chain_.n; ++i)
            S += (after.J[i][a] - before.J[i][a]) / (2.0 * difference) * motions_[j][i];
        }
    }
  }

  // Chooses the shortest z in the planes of two motions that solves the scalar equation; if there
  // is none, the z with the smallest remainder.
  void choose() {
    double slope[most], least = std::numeric_limits<double>::infinity(), shortest = least;
    for (int k = 0; k < count_; ++k) {
      double column[M] = {};
      for (int i = 0; i < chain_.n; ++i)
        for (int a = 0; a < M; ++a) column[a] += at_.J[i][a] * motions_[k][i];
      slope[k] = along(column);
    }
    const double error = along(at_.e);
    for (int k = 0; k < count_; ++k)
      for (int j = std::min(k + 1, count_ - 1); j < count_; ++j)
        for (int angle = 0; angle < angles; ++angle) {
          double z[most] = {};
          z[j] = std::sin(3.14159265358979323846 * angle / angles);
          z[k] = std::cos(3.14159265358979323846 * angle / angles);
          double a = 0.0, b = 0.0;
          for (int i = 0; i < count_; ++i) {
            b += z[i] * slope[i];
            for (int l = 0; l < count_; ++l) a += z[i] * z[l] * along(curvature_[i][l]);
          }
          const double square = b * b + 2.0 * a * error;
          const double t =
              square >= 0.0 ? 2.0 * error / (b + std::copysign(std::sqrt(square), b)) : -b / a;
          const double remains = square >= 0.0 ? 0.0 : std::fabs(error + 0.5 * b * b / a);
          if (!std::isfinite(t) || remains > least ||
              (remains == least && std::fabs(t) >= shortest))
            continue;
          least = remains;
          shortest = std::fabs(t);
          for (int i = 0; i < count_; ++i) z_[i] = t * z[i];
        }
  }

  const Chain &chain_;
  const Goal &goal_;
  const double weight_;
  const Iterate<M> &at_;
  double u_[M], A_[M][M];
  double motions_[most][max_joints], curvature_[most][most][M], z_[most] = {};
  int count_ = 0;
};

}  // namespace armlab
