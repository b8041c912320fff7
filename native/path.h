// Inverse kinematics along a path of poses: each from the one before, on one branch. Specification:
// armlab/kernels/_reference/path.py.
#pragma once

#include "descent.h"
#include "projection.h"
#include "random.h"

namespace armlab {

struct PathSettings {
  Search search;          // of every pose; its starts are those of a search for another branch
  const double *change;   // (n): how far a joint may move from row to row; null: by the length of the pose step
  const double *posture;  // (n) or (rows, n): where a redundant arm would like to be; null: near the row before
  const double *weights;  // (n): of the squared distances from `posture`
  bool one_posture;       // for all rows
};

struct PathRow {
  Outcome outcome;    // Status::bound: only further than `change`
  bool other_branch;  // the row is on another branch than the one before
};

// The state between two rows; `first` once, then `next`.
template <int M>
class PathFollower {
 public:
  PathFollower(const InverseSolver &solver, const PathSettings &settings)
      : solver_(solver), chain_(solver.chain()), n_(solver.chain().n), settings_(settings) {}

  const double *q() const { return q_; }

  // The first row: nearest to q0 (n), or, when that is null, to the home posture of the solver.
  PathRow first(const Goal &goal, const double *q0) {
    goal_ = &goal;
    Outcome outcome{};
    if (q0) outcome = reach(q0, solver_.limits(), q_);
    if (!q0 || outcome.status != Status::solved) outcome = solver_.solve(*goal_, settings_.search, q0, q_);
    if (outcome.status == Status::solved) settle(solver_.limits(), first_rounds, outcome);
    std::fill_n(moved_, n_, 0.0);
    failures_ = outcome.status == Status::solved ? 0 : 1;
    return {outcome, false};
  }

  PathRow next(const Goal &goal) {
    ++row_;
    goal_ = &goal;
    double before[max_joints], start[max_joints];
    std::copy_n(q_, n_, before);
    const Box bound = predict(start);
    Outcome outcome = reach(start, bound, q_);
    if (outcome.status == Status::solved) {
      settle(bound, rounds, outcome);
    } else {
      outcome = reach(before, bound, q_);
      if (outcome.status != Status::solved && outcome.status != Status::out_of_reach) return recover(before, bound, outcome);
    }
    return finish(before, outcome, false);
  }

 private:
  static constexpr double least_change = 0.05;  // rad: see PathSettings::change
  static constexpr double most_change = 5.0;    // of the length of the pose step
  static constexpr double settled = 1e-9;       // rad: what is not worth another round
  static constexpr double widest_round = 0.1;   // rad: along the null space
  static constexpr int rounds = 12, first_rounds = 500;
  static constexpr int tries = 24, enough_found = 4;

  Iterate<M> at(const double *q) const {
    Iterate<M> here;
    std::copy_n(q, n_, here.q);
    evaluate(chain_, *goal_, solver_.weight(), here);
    return here;
  }

  // The posture with the least error inside the bound, from `start`.
  Outcome reach(const double *start, const Box &bound, double *q) const {
    return solver_.follow(*goal_, settings_.search, start, bound, q);
  }

  // Where to start from: as far again as the last row went, without what the tool did not feel. Returns what the joints
  // may reach.
  Box predict(double *start) const {
    const Iterate<M> here = at(q_);
    if (n_ > M) {
      double unfelt[max_joints];
      std::copy_n(moved_, n_, unfelt);
      Projection<M>(n_, here).project(unfelt);
      for (int i = 0; i < n_; ++i) start[i] = q_[i] + (moved_[i] - unfelt[i]);
    } else {
      for (int i = 0; i < n_; ++i) start[i] = q_[i] + moved_[i];
    }
    Box bound;
    const double reach = least_change + most_change * std::sqrt(here.square);
    for (int i = 0; i < n_; ++i) {
      const double unit = chain_.steps[i].slides ? 1.0 / solver_.weight() : 1.0;
      const double change = settings_.change ? settings_.change[i] : reach * unit;
      bound.low[i] = std::max(q_[i] - change, solver_.limits().low[i]);
      bound.high[i] = std::min(q_[i] + change, solver_.limits().high[i]);
    }
    return bound;
  }

  // Moves along the null space towards `posture`: gradient steps, their length by the secant rule.
  void settle(const Box &bound, int most, Outcome &outcome) {
    if (n_ <= M || !settings_.posture) return;
    double slope[max_joints], next[max_joints], next_slope[max_joints], largest = 0.0;
    for (int i = 0; i < n_; ++i) largest = std::max(largest, settings_.weights[i]);
    if (largest == 0.0) return;
    double rate = 0.5 / largest;
    posture_slope(q_, slope);
    for (int round = 0; round < most; ++round) {
      double size = 0.0, start[max_joints];
      for (int i = 0; i < n_; ++i) size += slope[i] * slope[i];
      size = std::sqrt(size) * rate;
      if (size <= settled) return;
      const double step = rate * std::min(1.0, widest_round / size);
      for (int i = 0; i < n_; ++i) start[i] = q_[i] - step * slope[i];
      Outcome there = reach(start, bound, next);
      outcome.steps += there.steps;
      if (there.status != Status::solved) return;
      posture_slope(next, next_slope);
      double ss = 0.0, sy = 0.0;
      for (int i = 0; i < n_; ++i) {
        ss += (next[i] - q_[i]) * (next[i] - q_[i]);
        sy += (next[i] - q_[i]) * (next_slope[i] - slope[i]);
      }
      std::copy_n(next, n_, q_);
      std::copy_n(next_slope, n_, slope);
      outcome.position_error = there.position_error;
      outcome.rotation_error = there.rotation_error;
      if (ss <= settled * settled) return;
      rate = sy > 0.0 ? clamp(ss / sy, 0.1 / largest, 10.0 / largest) : 1.0 / largest;
    }
  }

  // The gradient of half the weighted square, in the null space.
  void posture_slope(const double *q, double *slope) const {
    const double *posture = settings_.posture + (settings_.one_posture ? 0 : row_ * n_);
    for (int i = 0; i < n_; ++i) slope[i] = settings_.weights[i] * (q[i] - posture[i]);
    const Iterate<M> here = at(q);
    Projection<M>(n_, here).project(slope);
  }

  // The nearest of a few solutions from random starts about the row before.
  bool search_around(const double *before, const Box &bound, Outcome &outcome) {
    double start[max_joints], there[max_joints], nearest = std::numeric_limits<double>::infinity();
    int found = 0;
    for (int k = 0; k < tries && found < enough_found; ++k) {
      for (int i = 0; i < n_; ++i) {
        const double share = 2.0 * uniform(row_, std::uint64_t(k) * n_ + i) - 1.0;
        start[i] = before[i] + share * least_change;
      }
      const Outcome other = reach(start, bound, there);
      outcome.steps += other.steps;
      if (other.status != Status::solved) continue;
      ++found;
      double far = 0.0;
      for (int i = 0; i < n_; ++i) far += (there[i] - before[i]) * (there[i] - before[i]);
      if (far >= nearest) continue;
      nearest = far;
      std::copy_n(there, n_, q_);
      outcome = {other.status, other.position_error, other.rotation_error, outcome.steps, outcome.starts};
    }
    return found > 0;
  }

  // Where the descent from the row before ends within the bound without a solution. Random starts near that row;
  // then further away on this branch; then on other branches; else the posture with the least error stays.
  PathRow recover(const double *before, const Box &bound, Outcome outcome) {
    const bool thorough = (failures_ & (failures_ - 1)) == 0;  // after 0, 1, 2, 4, 8 ... failures without a gap
    if (thorough && search_around(before, bound, outcome)) return finish(before, outcome, false);
    double there[max_joints];
    Outcome far = reach(before, solver_.limits(), there);
    const bool this_branch = far.status == Status::solved;
    if (this_branch)
      outcome.status = Status::bound;
    else if (thorough)
      far = solver_.solve(*goal_, settings_.search, nullptr, there);
    outcome.steps += far.steps;
    if (far.status == Status::solved) {
      std::copy_n(there, n_, q_);
      outcome.position_error = far.position_error;
      outcome.rotation_error = far.rotation_error;
    }
    return finish(before, outcome, far.status == Status::solved && !this_branch);
  }

  PathRow finish(const double *before, const Outcome &outcome, bool other_branch) {
    const bool solved = outcome.status == Status::solved;
    failures_ = solved ? 0 : failures_ + 1;
    for (int i = 0; i < n_; ++i) moved_[i] = solved ? q_[i] - before[i] : 0.0;
    return {outcome, other_branch};
  }

  const InverseSolver &solver_;
  const Chain &chain_;
  const int n_;
  const PathSettings settings_;
  const Goal *goal_ = nullptr;  // of the row
  double q_[max_joints], moved_[max_joints];
  std::uint64_t row_ = 0, failures_ = 0;  // failures: of the last rows, in a row
};

}  // namespace armlab
