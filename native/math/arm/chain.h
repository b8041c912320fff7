// A serial chain, T_base_tool(q) = E_0 Z_1(q_1) E_1 ... Z_n(q_n) E_n, Z = Rz (revolute) or Tz.
#pragma once

#include <algorithm>
#include <array>

#include "math/lie/vec3.h"

namespace armlab {

constexpr int max_joints = 32;

inline bool finite(const double *values, int n) {
  return std::all_of(values, values + n, [](double x) { return std::isfinite(x); });
}

struct Chain {
  // One joint and what follows it, with every E_i = Rz(beta_i) [p_i; Rx(alpha_i)] Rz(gamma_i).
  // Rotations about z merge with those of the neighbouring joints, so a step is Rz(q + offset),
  // Tz(q) of a prismatic joint, a translation by p, and Rx(alpha): at most 54 multiplications and
  // additions instead of 81, for any E_i. Zero terms are omitted.
  // Twists by 0, 90, -90 degrees: nearly all arms have no other.
  enum class Twist { none, quarter, minus_quarter, other };
  struct Step {
    double offset;                     // gamma_{i-1} + beta_i
    bool slides, has_x, has_y, has_z;  // prismatic; px, py, pz are not zero
    double px, py, pz;                 // p_i in axes turned by beta_i
    Twist twist;
    double cos_alpha, sin_alpha;
  };

  // frames (n + 1, 4, 4) row by row, rigid.
  Chain(int joints, const double *frames, const bool *prismatic);

  int n;
  std::array<double, 16 * (max_joints + 1)> frames;
  std::array<Step, max_joints> steps;
  double cos_last, sin_last;  // of gamma_n

  const double *frame(int i) const { return frames.data() + 16 * i; }
};

}  // namespace armlab
