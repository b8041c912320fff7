// Descent of the inverse kinematics from successive starts. See inverse.h.
#pragma once

#include <cstddef>
#include <utility>

#include "math/inverse/second_order_step.h"

namespace armlab {

constexpr double least_damping = 1e-12;
constexpr int grace = 3;  // consecutive steps without a new best before they are undone
constexpr int second_order_window = 8;      // second-order steps that must halve the error
constexpr double least_share = 1e-3;        // smallest share of a second-order step
constexpr double stationary_cosine = 1e-2;  // between the residual and its reducible part

// A start is abandoned if more than `rate` of |e|^2 is left after the last `window` steps.
struct Patience {
  int window;
  double rate;
};
constexpr int most_window = 24;
constexpr Patience hasty{4, 0.5}, patient{most_window, 1.0 - 1e-6};

// Steps towards one goal from successive starts.
template <int M>
class Descent {
 public:
  Descent(const Chain &chain, const Goal &goal, const Search &search, double weight)
      : chain_(chain), goal_(goal), search_(search), weight_(weight) {}

  // Descends from q inside the box; true if it reaches the goal. A step that does not reduce the
  // error may still make progress, for example along a curved valley near a singular posture.
  // `grace` such steps are allowed before the damping increases.
  bool run(const double *q, const Box &box, Patience patience, double *history) {
    for (int i = 0; i < chain_.n; ++i) best_->q[i] = clamp(q[i], box.low[i], box.high[i]);
    evaluate(chain_, goal_, weight_, *best_);
    if (history)
      std::fill_n(history, 2 * (std::ptrdiff_t{search_.steps} + 1),
          std::numeric_limits<double>::quiet_NaN());
    const Iterate<M> *from = best_;
    double squares[most_window], damping = search_.damping;
    int left = grace;
    for (int k = 0;; ++k) {
      if (history) {
        *history++ = best_->position_error;
        *history++ = best_->rotation_error;
      }
      if (best_->within(search_)) return true;
      double &before = squares[k % patience.window];
      if (k == search_.steps ||
          (k >= patience.window && !(best_->square <= patience.rate * before)))
        return false;
      before = best_->square;
      ++steps_;
      const bool moved =
          step(chain_.n, *from, box, damping * from->square + least_damping, *trial_);
      if (moved) evaluate(chain_, goal_, weight_, *trial_);
      if (moved && trial_->square < best_->square) {
        std::swap(best_, trial_);
        damping = std::max(damping / 4.0, search_.damping);
        left = grace;
        from = best_;
      } else if (moved && --left > 0) {
        std::swap(astray_, trial_);
        from = astray_;
      } else {
        damping *= 8.0;
        left = grace;
        from = best_;
      }
    }
  }

  // Takes second-order steps from the best posture, near a singularity; true if they reach the
  // goal.
  bool leave_singularity(const Box &box) {
    double before = std::numeric_limits<double>::infinity();
    for (int k = 0; k < search_.steps && !best_->within(search_); ++k) {
      if (k % second_order_window == 0) {
        if (!(best_->square <= 0.25 * before)) return false;
        before = best_->square;
      }
      ++steps_;
      const SecondOrderStep<M> second_order(chain_, goal_, weight_, *best_);
      double share = 1.0;
      do {
        if (share < least_share) return false;
        second_order.take(share, box, *trial_);
        share *= 0.5;
      } while (!(trial_->square < best_->square));
      std::swap(best_, trial_);
    }
    return best_->within(search_);
  }

  // The posture with the smallest error in the last run.
  const Iterate<M> &best() const { return *best_; }

  // Whether the residual pushes joint i against its limit in the box.
  bool is_blocked(const Box &box, int i) const {
    return (best_->q[i] >= box.high[i] && slope(i) > 0.0) ||
           (best_->q[i] <= box.low[i] && slope(i) < 0.0);
  }
  bool is_blocked(const Box &box) const {
    for (int i = 0; i < chain_.n; ++i)
      if (is_blocked(box, i)) return true;
    return false;
  }
  // Whether no free joint can reduce the error.
  bool is_stationary(const Box &box) const {
    double slopes = 0.0, sizes = 0.0;
    for (int i = 0; i < chain_.n; ++i) {
      if (is_blocked(box, i)) continue;
      slopes += slope(i) * slope(i);
      for (int a = 0; a < M; ++a) sizes += best_->J[i][a] * best_->J[i][a];
    }
    return slopes <= stationary_cosine * stationary_cosine * sizes * best_->square;
  }

  // Whether the best posture is singular. With enough joints for the task, a stationary residual
  // indicates a singularity; otherwise, linearly dependent columns of J do.
  bool is_singular() const {
    if (chain_.n >= M) return true;
    double Q[M][M];  // orthogonalised by Gram-Schmidt
    for (int i = 0; i < chain_.n; ++i) {
      double before = 0.0, after = 0.0;
      std::copy_n(best_->J[i], M, Q[i]);
      for (int a = 0; a < M; ++a) before += Q[i][a] * Q[i][a];
      for (int j = 0; j < i; ++j) {
        double along = 0.0;
        for (int a = 0; a < M; ++a) along += Q[i][a] * Q[j][a];
        for (int a = 0; a < M; ++a) Q[i][a] -= along * Q[j][a];
      }
      for (int a = 0; a < M; ++a) after += Q[i][a] * Q[i][a];
      if (after <= stationary_cosine * stationary_cosine * before) return true;
      for (int a = 0; a < M; ++a) Q[i][a] /= std::sqrt(after);
    }
    return false;
  }

  // The unit motion v (n) that changes the residual least, by inverse iteration.
  void find_weakest(double *v) const {
    const int n = chain_.n;
    double A[max_joints * max_joints];
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) {
        A[n * i + j] = i == j ? least_damping : 0.0;
        for (int a = 0; a < M; ++a) A[n * i + j] += best_->J[i][a] * best_->J[j][a];
      }
    factor(A, n);
    for (int i = 0; i < n; ++i) v[i] = 1.0 + i;
    for (int round = 0; round < 3; ++round) {
      double square = 0.0;
      substitute(A, n, v);
      for (int i = 0; i < n; ++i) square += v[i] * v[i];
      for (int i = 0; i < n; ++i) v[i] /= std::sqrt(square);
    }
  }

  int steps() const { return steps_; }  // total over all runs
  Outcome outcome(Status status, int starts) const {
    constexpr double nan = std::numeric_limits<double>::quiet_NaN();
    return {status, best_->position_error, best_->rotation_error, nan, steps_, starts};
  }

 private:
  double slope(int i) const {  // rate at which |e|^2 / 2 decreases along joint i
    double sum = 0.0;
    for (int a = 0; a < M; ++a) sum += best_->J[i][a] * best_->e[a];
    return sum;
  }

  const Chain &chain_;
  const Goal &goal_;
  const Search &search_;
  const double weight_;
  Iterate<M> iterates_[3];
  Iterate<M> *best_ = &iterates_[0], *trial_ = &iterates_[1], *astray_ = &iterates_[2];
  int steps_ = 0;
};

}  // namespace armlab
