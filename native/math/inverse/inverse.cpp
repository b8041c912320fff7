
#include "array/batch.h"
#include "math/inverse/descent.h"
#include "math/inverse/self_motion.h"

namespace armlab {
namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr double pi = 3.14159265358979323846;
// Fraction of the joint range by which postures in the second half of the table may exceed the
// limits before clamping.
constexpr double over_limits = 0.5;
constexpr double nearly = 1e-4;  // rad, largest error attributed to a singular posture
constexpr int turns = 16;        // rotations along the weakest direction, both ways
constexpr int few_starts = 10;   // out of reach, near a singular posture, or without limits

Vec3<double> direction_across(const Vec3<double> &axis) {
  const double x = std::fabs(axis.x), y = std::fabs(axis.y), z = std::fabs(axis.z);
  const Vec3<double> far{double(x <= y && x <= z), double(y < x && y <= z), double(z < x && z < y)};
  const Vec3<double> across = cross(axis, far);
  return (1.0 / norm(across)) * across;
}

}  // namespace

Goal::Goal(Task rows, const double *pose, const double *direction)
    : task(rows), T(pose), axis{direction[0], direction[1], direction[2]} {
  axis = (1.0 / norm(axis)) * axis;
  across[0] = direction_across(axis);
  across[1] = cross(axis, across[0]);
}

InverseSolver::InverseSolver(const Chain &chain, const double *low, const double *high,
    const double *home, std::uint64_t seed)
    : chain_(chain), angles_(postures * chain.n), poses_(12 * postures) {
  const int n = chain.n;
  // Largest displacement of joint i from zero.
  double slides[max_joints + 1] = {}, lengths = 0.0;
  for (int i = 0; i < n; ++i) {
    limits_.low[i] = low[i];
    limits_.high[i] = high[i];
    const bool prismatic = chain.steps[i].slides;
    unlimited_.low[i] = prismatic ? low[i] : -infinity;
    unlimited_.high[i] = prismatic ? high[i] : infinity;
    if (prismatic) slides[i] = std::max(std::fabs(low[i]), std::fabs(high[i]));
    lengths +=
        norm(Pose<double>(chain.frame(i + 1)).p) + (std::isfinite(slides[i]) ? slides[i] : 0.0);
  }
  if (lengths == 0.0) lengths = 1.0;
  weight_ = 3.0 / lengths;
  wrist_reach_ = slides[0];
  for (int i = 1; i < n; ++i) wrist_reach_ += norm(Pose<double>(chain.frame(i)).p) + slides[i];
  tool_reach_ = wrist_reach_ + norm(Pose<double>(chain.frame(n)).p);

  for (int k = 0; k < postures; ++k) {
    double *q = &angles_[k * n];
    const double over = k < postures / 2 ? 0.0 : over_limits;
    for (int i = 0; i < n; ++i) {
      // With one limit or none, the range is one revolution (prismatic: twice the arm length), and
      // begins or ends at that limit or is centred on zero.
      const double range = chain.steps[i].slides ? 2.0 * lengths : 2.0 * pi;
      const bool below = std::isfinite(low[i]), above = std::isfinite(high[i]);
      const double first = below ? low[i] : above ? high[i] - range : -0.5 * range;
      const double last = above ? high[i] : first + range;
      const double part = (1.0 + 2.0 * over) * uniform(seed, std::uint64_t(k) * n + i) - over;
      q[i] = clamp(first + (last - first) * part, low[i], high[i]);
    }
  }
  std::copy_n(home, n, angles_.begin());
  std::vector<double> T(16 * postures);
  run_batch<1, 1>(postures, {Reading{angles_.data(), n}}, {Writing{T.data(), 16}},
      [&](const auto &in, const auto &out) { forward(chain, in[0], out[0]); });
  for (int k = 0; k < postures; ++k)
    for (int a = 0; a < 12; ++a)
      poses_[a * postures + k] = T[16 * k + (a < 9 ? 4 * (a / 3) + a % 3 : 4 * (a - 9) + 3)];
}

// Start `number` from the table: in block number mod blocks, the posture of rank number / blocks by
// |e|^2 (rotations as 2 (1 - cos)).
void InverseSolver::take_start(const Goal &goal, int number, double *q) const {
  const double across = goal.task == Task::axis ? 0.0 : weight_ * weight_;
  double wanted[9] = {};  // rotation error = constant - sum(wanted * R)
  const Vec3<double> d = goal.T.turn(goal.axis), columns[3] = {goal.T.x, goal.T.y, goal.T.z};
  const double a[3] = {goal.axis.x, goal.axis.y, goal.axis.z};
  for (int c = 0; c < 3 && goal.task != Task::position; ++c) {
    const Vec3<double> column = goal.task == Task::pose ? columns[c] : 2.0 * a[c] * d;
    column.write(wanted + c, 3);
  }
  const double p[3] = {goal.T.p.x, goal.T.p.y, goal.T.p.z};
  const int first = number % blocks * block;
  double distance[block] = {};
  for (int c = 0; c < 3; ++c)
    for (int k = 0; k < block; ++k) {
      const double off = poses_[(9 + c) * postures + first + k] - p[c];
      distance[k] += across * off * off;
    }
  for (int c = 0; c < 9; ++c)
    for (int k = 0; k < block; ++k) distance[k] -= wanted[c] * poses_[c * postures + first + k];
  const double *best = nullptr;
  for (int rank = number / blocks % block; rank >= 0; --rank) {
    best = std::min_element(distance, distance + block);
    distance[best - distance] = infinity;
  }
  std::copy_n(&angles_[(first + (best - distance)) * chain_.n], chain_.n, q);
}

// Whether the goal is further from the first joint than the length of the links.
bool InverseSolver::beyond_reach(const Goal &goal, double tolerance) const {
  if (goal.task == Task::axis) return false;
  const Pose<double> last(chain_.frame(chain_.n));
  const bool whole = goal.task == Task::pose;
  const Vec3<double> shoulder = Pose<double>(chain_.frame(0)).p;
  const Vec3<double> end = whole ? goal.T.p - goal.T.turn(last.turn_back(last.p)) : goal.T.p;
  const double reach = whole ? wrist_reach_ : tool_reach_;
  return norm(end - shoulder) > (1.0 + 1e-9) * reach + tolerance;
}

// Moves revolute joints by full revolutions into their limits; false if impossible.
bool InverseSolver::wrap(double *q) const {
  for (int i = 0; i < chain_.n; ++i) {
    const double low = limits_.low[i], high = limits_.high[i];
    if (!chain_.steps[i].slides && q[i] < low)
      q[i] += 2.0 * pi * std::ceil((low - q[i]) / (2.0 * pi));
    if (!chain_.steps[i].slides && q[i] > high)
      q[i] -= 2.0 * pi * std::ceil((q[i] - high) / (2.0 * pi));
    if (!(q[i] >= low && q[i] <= high)) return false;
  }
  return true;
}

template <int M>
Outcome InverseSolver::solve_rows(
    const Goal &goal, const Search &search, const double *start, double *q) const {
  Descent<M> descent(chain_, goal, search, weight_);
  const bool beyond = beyond_reach(goal, search.position_tolerance);
  const int starts = beyond ? std::min(search.starts, few_starts) : search.starts;
  double from[max_joints], least = infinity;
  for (int number = 0; number < starts; ++number) {
    const bool own = start && number == 0;
    if (!own) take_start(goal, number - (start != nullptr), from);
    const bool found =
        descent.run(own ? start : from, limits_, own ? patient : hasty, search.history);
    if (found) return finish(descent, goal, search, limits_, number + 1, q);
    if (number == 0 || descent.best().square < least) std::copy_n(descent.best().q, chain_.n, q);
    least = std::min(least, descent.best().square);
  }
  const bool found =
      descent.run(q, limits_, patient, search.history);  // run the best start to its end
  if (found) return finish(descent, goal, search, limits_, starts, q);
  std::copy_n(descent.best().q, chain_.n, q);
  if (beyond) return descent.outcome(Status::out_of_reach, starts);
  if (descent.best().square <= nearly * nearly) {
    if (leave_singularity(descent, goal, search, q))
      return finish(descent, goal, search, limits_, starts, q);
    if (!descent.is_blocked(limits_)) return descent.outcome(Status::singular, starts);
  }
  return explain(descent, goal, search, q);
}

// Near a singular posture, a small error remains along the direction without first-order motion.
// Second-order steps reduce it, from here or from where other starts end near a singular posture.
// `q` is the best posture, also on failure.
template <int M>
bool InverseSolver::leave_singularity(
    Descent<M> &descent, const Goal &goal, const Search &search, double *q) const {
  double from[max_joints], least = infinity;
  for (int number = 0; number < std::min(search.starts, few_starts); ++number) {
    if (number > 0) {
      take_start(goal, number - 1, from);
      if (descent.run(from, limits_, patient, search.history)) return true;
    }
    const bool reached = chain_.n >= M && descent.best().square <= nearly * nearly &&
                         descent.leave_singularity(limits_);
    if (reached || descent.best().square < least) std::copy_n(descent.best().q, chain_.n, q);
    if (reached) return descent.run(q, limits_, patient, search.history);
    least = std::min(least, descent.best().square);
  }
  descent.run(q, limits_, patient, search.history);
  return turn_weakest(descent, search.history, q);
}

// Rotates the joints that do not change the residual, such as two aligned axes of a wrist, until
// the others can reduce it.
template <int M>
bool InverseSolver::turn_weakest(Descent<M> &descent, double *history, double *q) const {
  double weakest[max_joints], from[max_joints];
  descent.find_weakest(weakest);
  for (int k = 1; k <= turns; ++k) {
    const double turn = (k % 2 ? 1 : -1) * 2.0 * pi * k / turns;
    for (int i = 0; i < chain_.n; ++i) from[i] = q[i] + turn * weakest[i];
    if (descent.run(from, limits_, patient, history)) return true;
  }
  return descent.run(q, limits_, patient, history);
}

// Returns the solution, after optimisation along the self-motion if there is an objective.
template <int M>
Outcome InverseSolver::finish(const Descent<M> &descent, const Goal &goal, const Search &search,
    const Box &box, int starts, double *q) const {
  Outcome outcome = descent.outcome(Status::solved, starts);
  std::copy_n(descent.best().q, chain_.n, q);
  if (search.objective.kind == Objective::Kind::none) return outcome;
  Iterate<M> at = descent.best();
  SelfMotion<M> motion(chain_, goal, search, weight_, box);
  outcome.slope = motion.descend(at);
  outcome.steps += motion.steps();
  outcome.position_error = at.position_error;
  outcome.rotation_error = at.rotation_error;
  std::copy_n(at.q, chain_.n, q);
  return outcome;
}

// Returns the reason for failure; replaces q if it finds a solution in the process.
template <int M>
Outcome InverseSolver::explain(
    Descent<M> &descent, const Goal &goal, const Search &search, double *q) const {
  Outcome outcome = descent.outcome(Status::iterations, search.starts);
  const bool stationary = descent.is_stationary(limits_), blocked = descent.is_blocked(limits_);
  const bool singular = descent.is_singular();
  double from[max_joints];
  bool without_limits = false;
  for (int number = 0; number < std::min(search.starts, few_starts) && !without_limits; ++number) {
    if (number > 0) take_start(goal, number - 1, from);
    without_limits =
        descent.run(number > 0 ? from : q, unlimited_, number > 0 ? hasty : patient, nullptr);
  }
  if (without_limits) {
    std::copy_n(descent.best().q, chain_.n, from);
    if (wrap(from) && descent.run(from, limits_, patient, search.history))
      return finish(descent, goal, search, limits_, search.starts, q);
  }
  outcome.steps = descent.steps();
  if (without_limits || (stationary && blocked && search.starts == 1))
    outcome.status = Status::limits;
  else if (stationary)
    outcome.status = search.starts > 1 || !singular ? Status::out_of_reach : Status::singular;
  return outcome;
}

template <int M>
Outcome InverseSolver::follow_rows(
    const Goal &goal, const Search &search, const double *start, const Box &box, double *q) const {
  Descent<M> descent(chain_, goal, search, weight_);
  if (descent.run(start, box, patient, search.history))
    return finish(descent, goal, search, box, 1, q);
  std::copy_n(descent.best().q, chain_.n, q);
  Status status = Status::iterations;
  if (beyond_reach(goal, search.position_tolerance)) status = Status::out_of_reach;
  else if (descent.is_blocked(limits_)) status = Status::limits;
  else if (descent.is_blocked(box)) status = Status::bound;
  else if (descent.is_stationary(box))
    status = descent.is_singular() ? Status::singular : Status::out_of_reach;
  return descent.outcome(status, 1);
}

Outcome InverseSolver::solve(
    const Goal &goal, const Search &search, const double *start, double *q) const {
  return with_rows(goal.task, [&](auto rows) { return solve_rows<rows>(goal, search, start, q); });
}

Outcome InverseSolver::follow(const Goal &goal, const Search &search, const double *start,
    const Box &bound, double *q) const {
  return with_rows(
      goal.task, [&](auto rows) { return follow_rows<rows>(goal, search, start, bound, q); });
}

Box InverseSolver::around(const double *q, double change) const {
  Box box;
  for (int i = 0; i < chain_.n; ++i) {
    const double from = clamp(q[i], limits_.low[i], limits_.high[i]);
    box.low[i] = std::max(limits_.low[i], from - change);
    box.high[i] = std::min(limits_.high[i], from + change);
  }
  return box;
}

}  // namespace armlab
