// A movement primitive for orientations, with time in units of tau, ' = d/d(t/tau), and z = tau w
// in base axes:
//
//   q' = z q / 2,   z' = stiffness e - alpha z + map f,
//   e = rotation vector of goal q^-1 along the shorter arc
//
// f is the forcing of a primitive with three coordinates; map (3, 3) rotates and scales it. An RK4
// step uses the chart exp(theta) q around its initial orientation, theta' = z - theta x z / 2 +
// theta x (theta x z) / 12, with the forcing at start, middle and end. It has fourth order and
// stays on the group. Steps too long for the spring are divided.
#pragma once

#include "math/lie/lie.h"
#include "math/motion/primitive.h"

namespace armlab {

class RotationStepper {
 public:
  explicit RotationStepper(const Primitive &primitive);  // three coordinates, time phase

  // Starts at phase time 0. q0, goal (4): nonzero quaternions; w0 (3); map (3, 3): rotates and
  // scales the forcing.
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
