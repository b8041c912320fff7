// One start of the inverse kinematics: residual, Jacobian and damped steps inside a box. M is the
// number of rows of the task. See inverse.h.
#pragma once

#include <limits>

#include "math/arm/ldl.h"
#include "math/inverse/inverse.h"
#include "math/lie/lie.h"

namespace armlab {

// SplitMix64: element `index` of the sequence with seed `seed`, uniform in [0, 1).
inline double uniform(std::uint64_t seed, std::uint64_t index) {
  std::uint64_t z = seed + (index + 1) * 0x9e3779b97f4a7c15u;
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return static_cast<double>((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

inline double clamp(double x, double low, double high) { return std::min(std::max(x, low), high); }

// Residual and Jacobian at a posture, about the same point, in base axes. Rows are in radians
// (lengths times the weight). A small step dq changes the residual by -J dq.
template <int M>
struct Iterate {
  static constexpr bool has_position = M != 2, has_rotation = M == 6, has_axis = M == 5 || M == 2;
  static constexpr int first_turn = has_position ? 3 : 0;

  double q[max_joints];
  double J[max_joints][M];  // column by column
  double e[M];
  double square;  // |e|^2
  double position_error, rotation_error;

  bool within(const Search &search) const {
    return (!has_position || position_error <= search.position_tolerance) &&
           (M == 3 || rotation_error <= search.rotation_tolerance);
  }
};

// The shortest rotation from the tool axis to the goal axis, about two normals of the axis.
inline void axis_residual(
    const Goal &goal, const Pose<double> &T, Vec3<double> *across, double *e) {
  const Vec3<double> now = T.turn(goal.axis), wanted = goal.T.turn(goal.axis),
                     turn = cross(now, wanted);
  across[0] = T.turn(goal.across[0]);
  across[1] = T.turn(goal.across[1]);
  const double sine = norm(turn), cosine = dot(now, wanted);
  const double angle = std::atan2(sine, cosine);
  if (sine == 0.0) {  // parallel or opposite: every normal direction is equally short
    e[0] = angle;
    e[1] = 0.0;
    return;
  }
  e[0] = dot(across[0], turn) * (angle / sine);
  e[1] = dot(across[1], turn) * (angle / sine);
}

// R_goal R^T: the rotation from the tool to the goal, in base axes.
inline Rotation<double> rotation_between(const Pose<double> &T, const Pose<double> &goal) {
  return {T.x.x * goal.x + T.y.x * goal.y + T.z.x * goal.z,
      T.x.y * goal.x + T.y.y * goal.y + T.z.y * goal.z,
      T.x.z * goal.x + T.y.z * goal.y + T.z.z * goal.z};
}

template <int M>
inline void evaluate(const Chain &chain, const Goal &goal, double weight, Iterate<M> &at) {
  using I = Iterate<M>;
  constexpr double nan = std::numeric_limits<double>::quiet_NaN();
  Vec3<double> axis[max_joints], point[max_joints], across[2];
  const Pose<double> T =
      walk(chain, at.q, [&](int i, const Vec3<double> &z, const Vec3<double> &p) {
        axis[i] = z;
        point[i] = p;
      });
  at.position_error = at.rotation_error = nan;
  at.square = 0.0;
  if constexpr (I::has_position) {
    const Vec3<double> d = goal.T.p - T.p;
    at.position_error = norm(d);
    (weight * d).write(at.e);
    at.square = weight * weight * dot(d, d);
  }
  double *turn = at.e + I::first_turn;
  if constexpr (I::has_rotation) {
    const Vec3<double> w = so3_log(rotation_between(T, goal.T));
    w.write(turn);
    at.square += dot(w, w);
    at.rotation_error = norm(w);
  }
  if constexpr (I::has_axis) {
    axis_residual(goal, T, across, turn);
    const double square = turn[0] * turn[0] + turn[1] * turn[1];
    at.square += square;
    at.rotation_error = std::sqrt(square);
  }
  for (int i = 0; i < chain.n; ++i) {
    double *column = at.J[i];
    const bool slides = chain.steps[i].slides;
    const Vec3<double> &z = axis[i];
    if constexpr (I::has_position) {
      (weight * (slides ? z : cross(z, T.p - point[i]))).write(column);
    }
    if constexpr (I::has_rotation) {
      (slides ? Vec3<double>{0.0, 0.0, 0.0} : z).write(column + 3);
    }
    if constexpr (I::has_axis) {
      column[I::first_turn] = slides ? 0.0 : dot(across[0], z);
      column[I::first_turn + 1] = slides ? 0.0 : dot(across[1], z);
    }
  }
}

// A = J J^T + lambda I, over the columns of J selected by `uses`.
template <int M>
inline void normal_matrix(
    int n, const double (*J)[M], const bool *uses, double lambda, double (&A)[M][M]) {
  for (int a = 0; a < M; ++a) {
    for (int b = 0; b < M; ++b) A[a][b] = 0.0;
    A[a][a] = lambda;
  }
  for (int i = 0; i < n; ++i)
    if (uses[i])
      for (int a = 0; a < M; ++a)
        for (int b = 0; b < M; ++b) A[a][b] += J[i][a] * J[i][b];
}

// next.q = q + dq with dq = J^T (J J^T + lambda I)^-1 e within the box. Joints that would leave the
// box stop at their limit, and the others compensate. False if there is no solution.
template <int M>
inline bool step(int n, const Iterate<M> &at, const Box &box, double lambda, Iterate<M> &next) {
  bool moves[max_joints];
  double e[M];
  std::fill_n(moves, n, true);
  std::copy_n(at.e, M, e);
  for (bool again = true; again;) {
    double A[M][M], y[M];
    normal_matrix(n, at.J, moves, lambda, A);
    if (!factor(A[0], M)) return false;
    std::copy_n(e, M, y);
    substitute(A[0], M, y);
    again = false;
    for (int i = 0; i < n; ++i) {
      if (!moves[i]) continue;
      double dq = 0.0;
      for (int a = 0; a < M; ++a) dq += at.J[i][a] * y[a];
      const double wanted = at.q[i] + dq, allowed = clamp(wanted, box.low[i], box.high[i]);
      next.q[i] = allowed;
      if (allowed == wanted) continue;
      moves[i] = false;
      again = true;
      for (int a = 0; a < M; ++a) e[a] -= at.J[i][a] * (allowed - at.q[i]);
    }
  }
  return true;
}

}  // namespace armlab
