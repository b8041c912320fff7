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
  // One joint and the frame after it, with every E_i = Rz(beta_i) [p_i; Rx(alpha_i)] Rz(gamma_i).
  // Rotations about z merge with those of the neighbouring joints. A step is therefore
  // Rz(q + offset) (or Tz(q) for a prismatic joint), a translation by p, and Rx(alpha): at most 54
  // multiplications and additions instead of 81, for any E_i. Zero terms are omitted.
  // Nearly all arms have only twists of 0, 90 and -90 degrees.
  enum class Twist { none, quarter, minus_quarter, other };
  struct Step {
    double offset;                     // gamma_{i-1} + beta_i
    bool slides, has_x, has_y, has_z;  // prismatic; nonzero px, py, pz
    double px, py, pz;                 // p_i in axes rotated by beta_i
    Twist twist;
    double cos_alpha, sin_alpha;
  };

  // frames: (n + 1, 4, 4) rigid transformations, row by row.
  Chain(int joints, const double *frames, const bool *prismatic);

  int n;
  std::array<double, 16 * (max_joints + 1)> frames;
  std::array<Step, max_joints> steps;
  double cos_last, sin_last;  // cosine and sine of gamma_n

  const double *frame(int i) const { return frames.data() + 16 * i; }
};

}  // namespace armlab
