// Inverse kinematics of a chain within joint limits. Theory: docs/theory/inverse_kinematics.md.
//
// Levenberg-Marquardt from successive starts. Stalled starts are abandoned early. Each start is the
// posture nearest to the goal in a block of a table of random postures.
#pragma once

#include <type_traits>
#include <vector>

#include "math/arm/kinematics.h"

namespace armlab {

// The constrained part of the goal pose: the pose, the position, the position and the direction of
// a tool axis, or only that direction. The value is the number of rows of the task.
enum class Task { pose = 6, position = 3, position_axis = 5, axis = 2 };

struct Goal {
  Task task;
  Pose<double> T;                // T_base_tool
  Vec3<double> axis, across[2];  // in tool axes: the direction and its two normals

  Goal(Task task, const double *T, const double *axis);
};

// Calls `function` with the number of rows as a constant.
template <class Function>
auto with_rows(Task task, Function function) {
  if (task == Task::position) return function(std::integral_constant<int, 3>());
  if (task == Task::position_axis) return function(std::integral_constant<int, 5>());
  if (task == Task::axis) return function(std::integral_constant<int, 2>());
  return function(std::integral_constant<int, 6>());
}

// Objective for redundant joints. See self_motion.h.
struct Objective {
  enum class Kind { none = 0, posture = 1, limits = 2, manipulability = 3 };
  Kind kind;
  const double *reference, *scale;  // (n), for posture and limits
};

struct Search {
  int steps;  // per start, including failed steps
  int starts;
  double position_tolerance, rotation_tolerance;
  double damping;  // lambda = damping |e|^2, times 8 after each failed step
  Objective objective;
  double *history = nullptr;  // (steps + 1, 2): errors of the final start, then NaN
};

// The result. `bound` occurs only in `follow`.
enum class Status { solved, out_of_reach, limits, singular, iterations, bound };

struct Outcome {
  Status status;
  double position_error, rotation_error;  // NaN if unconstrained by the task
  double slope;       // of the objective along the self-motion; NaN without objective
  int steps, starts;  // total over all starts
};

// Box of allowed joint positions.
struct Box {
  double low[max_joints], high[max_joints];
};

template <int M>
class Descent;

class InverseSolver {
 public:
  static constexpr int block = 128, blocks = 16, postures = block * blocks;

  // low, high (n): limits, possibly infinite. home (n): the first posture; the others are random.
  InverseSolver(const Chain &chain, const double *low, const double *high, const double *home,
      std::uint64_t seed);

  const Chain &chain() const { return chain_; }
  const Box &limits() const { return limits_; }
  double weight() const { return weight_; }  // radians per metre

  // Solves from `start` (n) unless null, then from the table. `q` (n): the posture with the
  // smallest error, always within the limits. A start outside the limits is moved into them.
  Outcome solve(const Goal &goal, const Search &search, const double *start, double *q) const;

  // Solves from `start` alone, with all joints inside `bound`, a part of the limits. Used for
  // paths, where the start is the previous posture: damping bounds the steps near singular
  // postures, and the branch is kept. `q`: the posture with the smallest error within the bound.
  Outcome follow(const Goal &goal, const Search &search, const double *start, const Box &bound,
      double *q) const;
  // Clamps `q` to the limits, and returns the part of the limits within `change` of it.
  Box around(const double *q, double change) const;

 private:
  template <int M>
  Outcome solve_rows(const Goal &goal, const Search &search, const double *start, double *q) const;
  template <int M>
  Outcome follow_rows(const Goal &goal, const Search &search, const double *start, const Box &bound,
      double *q) const;
  template <int M>
  Outcome finish(const Descent<M> &descent, const Goal &goal, const Search &search, const Box &box,
      int starts, double *q) const;
  template <int M>
  bool leave_singularity(
      Descent<M> &descent, const Goal &goal, const Search &search, double *q) const;
  template <int M>
  bool turn_weakest(Descent<M> &descent, double *history, double *q) const;
  template <int M>
  Outcome explain(Descent<M> &descent, const Goal &goal, const Search &search, double *q) const;

  void take_start(const Goal &goal, int number, double *q) const;
  bool beyond_reach(const Goal &goal, double tolerance) const;
  bool wrap(double *q) const;

  Chain chain_;
  Box limits_, unlimited_;
  double wrist_reach_, tool_reach_;  // from the first joint to the last, and to the tool
  double weight_;
  std::vector<double> angles_;  // (postures, n)
  std::vector<double> poses_;   // (12, postures): rotation row by row, position
};

}  // namespace armlab
