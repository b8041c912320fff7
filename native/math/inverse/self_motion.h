// Self-motion of a redundant arm: minimises an objective in the null space of the task.
//
// Newton steps in the null space of the task, with the curvature of the task in the Hessian. Joints
// stay at limits that a step would push them against. Each step ends at the goal.
#pragma once

#include "math/inverse/null_space.h"
#include "math/inverse/inverse_step.h"

namespace armlab {

// Objectives for redundant joints.
constexpr double tie = 1e-3;  // weight of the sum of squares in the objective "limits"

// With x = scale (q - reference), per joint:
// posture  sum of x^2 / 2
// limits   smoothed largest |x|, log(sum of exp(s x) + exp(-s x)) / s with sharpness s, plus a
//          small multiple of the sum of x^2 / 2 for joints that are not nearest to their limits
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

// -log(det(J J^T)) / 2 over the rows of the task. With G = (J J^T)^-1 J and the twist c_j = rows of
// the task times G_j:
//   d/dq_i = -sum over j of c_j . dJ_j/dq_i,  dJ_j/dq_i = [w_i x v_j; w_i x w_j] (i <= j) or [w_j x
//   v_i; 0] (i > j),
// plus the derivative of the rows themselves if they rotate with the tool.
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
  std::fill_n(all, max_joints, true);
  for (int i = 0; i < n; ++i) {
    if (chain.steps[i].slides) w[i] = zero;
    else v[i] = cross(w[i], T.p - point[i]);
  }
  double A[M][M], value = 0.0;
  normal_matrix(n, at.J, all, 0.0, A);
  std::fill_n(gradient, n, 0.0);
  if (!factor(A[0], M)) return std::numeric_limits<double>::infinity();
  for (int a = 0; a < M; ++a) value += 0.5 * std::log(A[a][a]);

  // c_j, and the contribution of the rows normal to the axis
  Vec3<double> pull[max_joints], twist[max_joints], row_pull = zero;
  for (int j = 0; j < n; ++j) {
    double G[M];
    std::copy_n(at.J[j], M, G);
    substitute(A[0], M, G);
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

// sharpness: for the objective "limits".
template <int M>
inline double objective(const Chain &chain, const Goal &goal, double weight,
    const Objective &wanted, double sharpness, const Iterate<M> &at, double *gradient) {
  if (wanted.kind == Objective::Kind::posture)
    return posture_objective(chain.n, wanted, at.q, gradient);
  if (wanted.kind == Objective::Kind::limits)
    return limits_objective(chain.n, wanted, sharpness, at.q, gradient);
  return manipulability_objective(chain, goal, weight, at, gradient);
}

constexpr int most_null_steps = 100;
constexpr double least_slope = 1e-10;                    // slope at which the descent ends
constexpr double longest_step = 0.3;                     // longest step of a joint [rad or m]
constexpr double difference = 1e-6;                      // joint step for second derivatives
constexpr double sharpnesses[] = {30.0, 300.0, 1000.0};  // successive values for "limits"

template <int M>
class SelfMotion {
 public:
  SelfMotion(
      const Chain &chain, const Goal &goal, const Search &search, double weight, const Box &box)
      : chain_(chain), goal_(goal), search_(search), weight_(weight), box_(box), n_(chain.n) {}

  // Moves `at` from a solution. Returns the remaining slope along the free self-motion.
  double descend(Iterate<M> &at) {
    trial_ = at;
    if (restore(box_)) at = trial_;
    double slope = 0.0;
    for (double sharpness : sharpnesses) {
      sharpness_ = sharpness;
      slope = descend_once(at);
      if (search_.objective.kind != Objective::Kind::limits) break;
    }
    return slope;
  }
  int steps() const { return steps_; }

 private:
  double descend_once(Iterate<M> &at) {
    for (int k = 0;; ++k) {
      const double value = value_at(at, gradient_);
      std::fill_n(fixed_, n_, false);
      find_null_space(at);
      const double slope = space_.slope();
      if (slope <= least_slope || k == most_null_steps) return slope;
      find_direction(at);
      if (!advance(at, value)) return slope;
      ++steps_;
    }
  }

  double value_at(const Iterate<M> &at, double *gradient) const {
    return objective(chain_, goal_, weight_, search_.objective, sharpness_, at, gradient);
  }

  // Finds the null space of the free joints; blocked joints at limits are fixed.
  void find_null_space(const Iterate<M> &at) {
    double uphill[max_joints];
    do {
      space_.find(n_, at.J, gradient_, fixed_);
      space_.expand(n_, space_.reduced, uphill);
      for (int i = 0; i < n_; ++i) step_[i] = -uphill[i];
    } while (fix_blocked(at));
  }

  // Fixes the joints at limits that step_ pushes against; false if there are none.
  bool fix_blocked(const Iterate<M> &at) {
    bool any = false;
    for (int i = 0; i < n_; ++i)
      if ((at.q[i] >= box_.high[i] && step_[i] > 0.0) || (at.q[i] <= box_.low[i] && step_[i] < 0.0))
        fixed_[i] = any = true;
    return any;
  }

  // Sets step_ to the Newton step, and fixes joints that it pushes against a limit. If no joint is
  // left free, uses steepest descent.
  void find_direction(const Iterate<M> &at) {
    bool fixed[max_joints];
    double z[max_joints];
    std::copy_n(fixed_, n_, fixed);
    while (space_.slope() > least_slope) {
      find_newton_step(at, z);
      if (!fix_blocked(at)) return;
      find_null_space(at);
    }
    std::copy_n(fixed, n_, fixed_);
    space_.find(n_, at.J, gradient_, fixed_);
    for (int k = 0; k < space_.size; ++k) z[k] = -space_.reduced[k];
    go_along(z);
  }

  // Newton step with the Hessian of objective - mu^T task in the null space, from differences of
  // its gradient.
  void find_newton_step(const Iterate<M> &at, double *z) {
    double H[max_joints][max_joints], other[max_joints], change[max_joints];
    const int size = space_.size;
    for (int k = 0; k < size; ++k) {
      std::copy_n(at.q, n_, trial_.q);
      for (int f = 0; f < space_.joints; ++f)
        trial_.q[space_.joint[f]] += difference * space_.basis[k][f];
      evaluate(chain_, goal_, weight_, trial_);
      value_at(trial_, other);
      for (int f = 0; f < space_.joints; ++f) {
        const int i = space_.joint[f];
        change[f] = other[i] - gradient_[i];
        for (int a = 0; a < M; ++a) change[f] -= (trial_.J[i][a] - at.J[i][a]) * space_.mu[a];
      }
      for (int l = 0; l < size; ++l) {
        H[l][k] = 0.0;
        for (int f = 0; f < space_.joints; ++f)
          H[l][k] += space_.basis[l][f] * change[f] / difference;
      }
    }
    for (int k = 0; k < size; ++k)
      for (int l = 0; l < k; ++l) H[k][l] = H[l][k] = 0.5 * (H[k][l] + H[l][k]);
    newton_step(size, H, space_.reduced, z);
    go_along(z);
  }

  // Sets step_ = N z, shortened to `longest_step`, and fall_, the predicted decrease.
  void go_along(const double *z) {
    space_.expand(n_, z, step_);
    double longest = longest_step;
    for (int i = 0; i < n_; ++i) longest = std::max(longest, std::fabs(step_[i]));
    for (int i = 0; i < n_; ++i) step_[i] *= longest_step / longest;
    fall_ = 0.0;
    for (int k = 0; k < space_.size; ++k)
      fall_ -= longest_step / longest * z[k] * space_.reduced[k];
  }

  // Moves along step_ as far as limits and objective allow, and back to the goal. False if the
  // objective does not improve.
  bool advance(Iterate<M> &at, double value) {
    double part = 1.0, there[max_joints], unused[max_joints];
    for (int i = 0; i < n_; ++i)
      if (std::fabs(step_[i]) > std::fabs(end(i) - at.q[i]))
        part = std::min(part, (end(i) - at.q[i]) / step_[i]);
    const double rounding = 1e-13 * std::max(1.0, std::fabs(value));
    for (const double shortest = 1e-6 * part; part > shortest; part *= 0.5) {
      Box kept = box_;  // joints at a limit stay there on the way back, if possible
      for (int i = 0; i < n_; ++i) {
        const double moved = part * step_[i];
        const bool arrives =
            moved != 0.0 && std::fabs(moved) >= (1.0 - 1e-12) * std::fabs(end(i) - at.q[i]);
        there[i] = arrives ? end(i) : clamp(at.q[i] + moved, box_.low[i], box_.high[i]);
        if (arrives || fixed_[i]) kept.low[i] = kept.high[i] = there[i];
      }
      std::copy_n(there, n_, trial_.q);
      if (!restore(kept)) {
        std::copy_n(there, n_, trial_.q);
        if (!restore(box_)) continue;
      }
      if (value_at(trial_, unused) <= value - 1e-4 * part * fall_ + rounding) {
        at = trial_;
        return true;
      }
    }
    return false;
  }
  double end(int i) const { return step_[i] > 0.0 ? box_.high[i] : box_.low[i]; }

  // Moves trial_ back to the goal; false on failure.
  bool restore(const Box &box) {
    evaluate(chain_, goal_, weight_, trial_);
    for (int k = 0; k < 8 && trial_.square > 1e-30; ++k) {
      if (!step(n_, trial_, box, 1e-12, better_)) break;
      evaluate(chain_, goal_, weight_, better_);
      if (!(better_.square < trial_.square)) break;
      trial_ = better_;
    }
    return trial_.within(search_);
  }

  const Chain &chain_;
  const Goal &goal_;
  const Search &search_;
  const double weight_;
  const Box &box_;
  const int n_;
  Iterate<M> trial_, better_;
  NullSpace<M> space_;
  bool fixed_[max_joints];
  double gradient_[max_joints], step_[max_joints], fall_ = 0.0, sharpness_ = sharpnesses[0];
  int steps_ = 0;
};

}  // namespace armlab
