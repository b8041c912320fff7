// A movement primitive of orientations. tests/oracles/rotation_primitive.py states the mathematics. Time is
// counted in units of tau, and the angular velocity as z = tau w.
#pragma once

#include <cstddef>
#include <vector>

#include "math/lie/lie.h"
#include "math/motion/primitive.h"

namespace armlab {

class RotationStepper {
 public:
  explicit RotationStepper(const Primitive &primitive);  // of three coordinates, with a phase of time

  // Starts at phase time 0. q0, goal (4) of any length above zero; w0 (3); map (3, 3) turns and scales the forcing.
  void start(const double *q0, const double *w0, const double *goal, const double *map, double tau);
  void step(double dt);
  void change_goal(const double *goal, const double *map);
  void change_tau(double tau);
  void outputs(double *q, double *w, double *wd) const;
  double elapsed() const { return s_; }
  double tau() const { return tau_; }

  Primitive primitive;

 private:
  using Vector = Vec3<double>;
  Vector force(double s);
  Vector error(const Quaternion<double> &q) const;
  void advance(double h, const Vector &start, const Vector &middle, const Vector &end);

  Quaternion<double> q_{1.0, {0.0, 0.0, 0.0}}, goal_{1.0, {0.0, 0.0, 0.0}};
  Rotation<double> map_{};
  Vector z_{}, f_{};
  double tau_ = 1.0, s_ = 0.0;
  std::vector<double> psi_;
  std::vector<int> index_;
};

}  // namespace armlab
