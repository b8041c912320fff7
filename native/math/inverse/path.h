// Inverse kinematics along a path of poses: each row starts from the previous one, on one branch.
#pragma once

#include "math/inverse/descent.h"
#include "math/inverse/null_space.h"

namespace armlab {

struct PathRow {
  Outcome outcome;    // Status::bound: all solutions are further than `change`
  bool other_branch;  // the row is on a different branch than the previous row
};

// The state between two rows: call `first` once, then `next`.
template <int M>
class PathFollower {
 public:
  // change (n): largest joint step per row; null: computed from the length of the pose step.
  PathFollower(const InverseSolver &solver, const double *change)
      : solver_(solver), chain_(solver.chain()), n_(solver.chain().n), change_(change) {}

  const double *q() const { return q_; }

  // The first row: from q0 (n), or from the solver's table if q0 is null or fails.
  PathRow first(const Goal &goal, const Search &search, const double *q0) {
    goal_ = &goal;
    search_ = &search;
    Outcome outcome{};
    if (q0) outcome = reach(q0, solver_.limits(), q_);
    if (!q0 || outcome.status != Status::solved) outcome = solver_.solve(goal, search, q0, q_);
    return finish(q_, outcome, false);
  }

  PathRow next(const Goal &goal, const Search &search) {
    goal_ = &goal;
    search_ = &search;
    ++row_;
    double before[max_joints], start[max_joints];
    std::copy_n(q_, n_, before);
    const Box bound = predict(start);
    Outcome outcome = reach(start, bound, q_);
    if (outcome.status != Status::solved) outcome = reach(before, bound, q_);
    if (outcome.status != Status::solved && outcome.status != Status::out_of_reach)
      return recover(before, bound, outcome);
    return finish(before, outcome, false);
  }

 private:
  // Without `change`: least joint step [rad], and joint step per length of the pose step.
  static constexpr double least_change = 0.05, most_change = 5.0;
  static constexpr int tries = 24, enough_found = 4;

  // The posture with the smallest error inside the bound, from `start`.
  Outcome reach(const double *start, const Box &bound, double *q) const {
    return solver_.follow(*goal_, *search_, start, bound, q);
  }

  // Extrapolates the last step, without its null-space component, to the start of the next row.
  // Returns the box reachable by the joints.
  Box predict(double *start) const {
    Iterate<M> here;
    std::copy_n(q_, n_, here.q);
    evaluate(chain_, *goal_, solver_.weight(), here);
    double unfelt[max_joints] = {};
    if (n_ > M) {
      const bool fixed[max_joints] = {};
      NullSpace<M> space;
      space.find(n_, here.J, moved_, fixed);
      space.expand(n_, space.reduced, unfelt);
    }
    Box bound;
    const double length = least_change + most_change * std::sqrt(here.square);
    for (int i = 0; i < n_; ++i) {
      start[i] = q_[i] + (moved_[i] - unfelt[i]);
      const double change = change_                  ? change_[i]
                            : chain_.steps[i].slides ? length / solver_.weight()
                                                     : length;
      bound.low[i] = std::max(q_[i] - change, solver_.limits().low[i]);
      bound.high[i] = std::min(q_[i] + change, solver_.limits().high[i]);
    }
    return bound;
  }

  // Used if the descent from the previous row ends within the bound without a solution. Tries
  // random starts near that row, then this branch beyond the bound, then other branches. If all
  // fail, returns the best result.
  PathRow recover(const double *before, const Box &bound, Outcome outcome) {
    const bool thorough = (failures_ & (failures_ - 1)) == 0;  // after 0, 1, 2, 4, 8 ... failures
    if (thorough && search_around(before, bound, outcome)) return finish(before, outcome, false);
    double there[max_joints];
    Outcome far = reach(before, solver_.limits(), there);
    const bool this_branch = far.status == Status::solved;
    if (this_branch) {
      outcome.status = Status::bound;
    } else if (thorough) {
      outcome.steps += far.steps;
      far = solver_.solve(*goal_, *search_, nullptr, there);
    }
    if (far.status == Status::solved) take(far, there, outcome);
    outcome.steps += far.steps;
    return finish(before, outcome, far.status == Status::solved && !this_branch);
  }

  // The nearest of a few solutions from random starts near the previous row.
  bool search_around(const double *before, const Box &bound, Outcome &outcome) {
    double start[max_joints], there[max_joints], nearest = std::numeric_limits<double>::infinity();
    int found = 0;
    for (int k = 0; k < tries && found < enough_found; ++k) {
      for (int i = 0; i < n_; ++i)
        start[i] =
            before[i] + (2.0 * uniform(row_, std::uint64_t(k) * n_ + i) - 1.0) * least_change;
      const Outcome other = reach(start, bound, there);
      outcome.steps += other.steps;
      if (other.status != Status::solved) continue;
      ++found;
      double far = 0.0;
      for (int i = 0; i < n_; ++i) far += (there[i] - before[i]) * (there[i] - before[i]);
      if (far >= nearest) continue;
      nearest = far;
      take(other, there, outcome);
      outcome.status = Status::solved;
    }
    return found > 0;
  }

  void take(const Outcome &there, const double *q, Outcome &outcome) {
    std::copy_n(q, n_, q_);
    outcome.position_error = there.position_error;
    outcome.rotation_error = there.rotation_error;
    outcome.slope = there.slope;
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
  const double *change_;
  const Goal *goal_ = nullptr;  // current row
  const Search *search_ = nullptr;
  std::uint64_t row_ = 0;
  std::uint64_t failures_ = 0;  // consecutive failed rows
  double q_[max_joints], moved_[max_joints];
};

}  // namespace armlab
