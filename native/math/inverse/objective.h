// Objectives for the joints that a task leaves free.
#pragma once

#include "math/inverse/inverse_step.h"

namespace armlab {

constexpr double tie = 1e-3;  // of the sum of squares in the objective "limits"

// With x = scale (q - reference), joint by joint:
// posture  sum of x^2 / 2
// limits   the largest |x| made smooth, log(sum of exp(s x) + exp(-s x)) / s with the sharpness s,
// and a little of the
//          sum of x^2 / 2 for the joints that are not the nearest to their limits
inline double posture_objective(int n, const Objective &wanted, const double *q, double *gradient) {
  double value = 0.0;
  for (int i = 0; i < n; ++i) {
    const double x = wanted.scale[i] * (q[i] - wanted.reference[i]);
    value += 0.5 * x * x;
    gradient[i] = wanted.scale[i] * x;
  }
  return value;
}
inline double limits_objective(
    int n, const Objective &wanted, double sharpness, const double *q, double *gradient) {
  double x[max_joints], largest = 0.0, sum = 0.0, squares = 0.0;
  for (int i = 0; i < n; ++i) {
    x[i] = wanted.scale[i] * (q[i] - wanted.reference[i]);
    largest = std::max(largest, std::fabs(x[i]));
  }
  for (int i = 0; i < n; ++i) {
    const double up = std::exp(sharpness * (x[i] - largest)),
                 down = std::exp(sharpness * (-x[i] - largest));
    sum += up + down;
    squares += x[i] * x[i];
    gradient[i] = up - down;
  }
  for (int i = 0; i < n; ++i) gradient[i] = wanted.scale[i] * (gradient[i] / sum + tie * x[i]);
  return largest + std::log(sum) / sharpness + 0.5 * tie * squares;
}

// -log(det(J J^T)) / 2 of the rows of the task. With G = (J J^T)^-1 J and c_j = rows of the task
// times G_j, a twist:
//   d/dq_i = -sum over j of c_j . dJ_j/dq_i,  dJ_j/dq_i = [w_i x v_j; w_i x w_j] (i <= j) or [w_j x
//   v_i; 0] (i > j),
// and what comes from the rows themselves where they turn with the tool.
template <int M>
inline double manipulability_objective(
    const Chain &chain, const Goal &goal, double weight, const Iterate<M> &at, double *gradient) {
  using I = Iterate<M>;
  const int n = chain.n;
  const Vec3<double> zero{0.0, 0.0, 0.0};
  Vec3<double> v[max_joints], w[max_joints], point[max_joints];
  const Pose<double> T =
      walk(chain, at.q, [&](int i, const Vec3<double> &z, const Vec3<double> &p) {
        v[i] = w[i] = z;
        point[i] = p;
      });
  bool all[max_joints];
  for (int i = 0; i < n; ++i) {
    all[i] = true;
    if (chain.steps[i].slides) w[i] = zero;
    else v[i] = cross(w[i], T.p - point[i]);
  }
  double A[M][M], inverse[M], value = 0.0;
  normal_matrix(n, at.J, all, 0.0, A);
  std::fill_n(gradient, n, 0.0);
  if (!factor(A, inverse)) return std::numeric_limits<double>::infinity();
  for (int a = 0; a < M; ++a) value += 0.5 * std::log(inverse[a]);

  Vec3<double> pull[max_joints], twist[max_joints],
      row_pull = zero;  // c_j, and of the rows across the axis
  for (int j = 0; j < n; ++j) {
    double G[M];
    std::copy_n(at.J[j], M, G);
    substitute(A, inverse, G);
    pull[j] = twist[j] = zero;
    if constexpr (I::has_position) pull[j] = weight * Vec3<double>{G[0], G[1], G[2]};
    if constexpr (I::has_rotation) twist[j] = {G[3], G[4], G[5]};
    if constexpr (I::has_axis) {
      twist[j] =
          G[I::first_turn] * T.turn(goal.across[0]) + G[I::first_turn + 1] * T.turn(goal.across[1]);
      row_pull = row_pull + cross(twist[j], w[j]);
    }
  }
  for (int i = 0; i < n; ++i) {
    double sum = dot(row_pull, w[i]);
    for (int j = 0; j < n; ++j)
      sum += j < i ? dot(pull[j], cross(w[j], v[i]))
                   : dot(pull[j], cross(w[i], v[j])) + dot(twist[j], cross(w[i], w[j]));
    gradient[i] = -sum;
  }
  return value;
}

// sharpness: of the objective "limits".
template <int M>
inline double objective(const Chain &chain, const Goal &goal, double weight,
    const Objective &wanted, double sharpness, const Iterate<M> &at, double *gradient) {
  switch (wanted.kind) {
    case Objective::Kind::posture:
      return posture_objective(chain.n, wanted, at.q, gradient);
    case Objective::Kind::limits:
      return limits_objective(chain.n, wanted, sharpness, at.q, gradient);
    default:
      return manipulability_objective(chain, goal, weight, at, gradient);
  }
}

}  // namespace armlab
