// Movement primitives: spring, damper and a forcing term over a phase. Specification:
// tests/oracles/primitive.py. Time is in units of tau_d and velocity is z = tau_d yd, so nothing
// depends on tau_d.
#pragma once

#include <vector>

#include "math/motion/spring_step.h"

namespace armlab {

// External term in the acceleration of a movement primitive.
class Coupling {
 public:
  virtual ~Coupling() = default;
  // Whether it may be nonzero at y (n).
  virtual bool acts(const double *y) = 0;
  // Adds to the acceleration ydd (n) of a motion to g, at position y and velocity yd.
  virtual void add(const double *y, const double *yd, const double *g, double *ydd) = 0;
  // Advances time, dt >= 0.
  virtual void advance(double dt) = 0;
};

enum class PhaseKind { canonical, time, position, periodic };

struct Primitive {
  int n = 0, m = 0;  // coordinates, kernels
  double alpha = 0, stiffness = 0, decay = 0, pace = 0;
  PhaseKind phase = PhaseKind::canonical;
  std::vector<double> centres, curvatures, weights;  // (m), 1 / (2 sd^2) (m), (m, n)

  double phase_at(double s) const;  // phase at time s
  double share(double x) const;     // remaining share of the forcing at phase x

  // Normalised kernels at x that exceed 1e-17 of the largest: indices, and values times `factor`.
  int kernels(double x, double factor, int *index, double *psi) const;
  // The same for N phases, times factors (N) if given. Number j of phase k is written to
  // psi[k row + j column]; omitted numbers are not written.
  void basis(std::ptrdiff_t N, const double *x, const double *factors, std::ptrdiff_t row,
      std::ptrdiff_t column, double *psi) const;
  // psi(x) . w times the remaining share, for phases shared by all coordinates.
  void forcing(double x, int *index, double *psi, double *f) const;
  // The same for the position phase: x (n).
  void forcing_each(const double *x, int *index, double *psi, double *f) const;
};

// Sample-by-sample run of a primitive, without allocation after construction.
class PrimitiveStepper {
 public:
  explicit PrimitiveStepper(const Primitive &primitive);

  // Starts at phase time 0. Arrays (n); scale multiplies the forcing.
  void start(const double *y0, const double *v0, const double *g, const double *scale, double tau);
  void step(double dt);                                               // dt > 0
  void outputs(double *y, double *yd, double *ydd, double *f) const;  // f may be null
  const std::vector<double> &force() const { return f0_; }
  double elapsed() const { return s_; }  // time in units of tau
  double tau() const { return tau_; }

  // Takes effect now. `limit` (n): largest deceleration of the brake, 0 for none; null: no brake.
  void change_goal(const double *g, const double *scale, const double *limit);
  void change_tau(double tau);

  Primitive primitive;
  double filter = 0.0;           // rate of the goal filter times tau; 0: immediate
  Coupling *coupling = nullptr;  // adds to the acceleration; not owned

 private:
  void force(double s, const double *y, double *f);
  void step_spring(double r);
  void step_position(double r);
  void step_coupled(double r);
  void step_runge(double h);
  void brake();

  std::vector<double> y_, z_, y0_, g_, target_, scale_;
  std::vector<double> f0_, fm_, f1_, limit_, side_, braking_;
  std::vector<double> goal_, rise_;  // fading differences of goal and scale
  std::vector<double> work_, psi_;
  std::vector<int> index_;
  SpringStep spring_;
  double tau_ = 1.0, s_ = 0.0, moved_ = 0.0, r_ = -1.0;
  bool moving_ = false;  // the filtered goal has not reached the target
};

// Runs on one clock t (N); y0, v0, g, scale (K, n); weights null or (K, m, n); y ... (N, K, n),
// x (N).
void rollout(const Primitive &primitive, std::ptrdiff_t N, const double *t, double tau,
    std::ptrdiff_t K, const double *y0, const double *v0, const double *g, const double *scale,
    const double *weights, double *y, double *yd, double *ydd, double *x, double *f);

// Response of position and velocity (N, m + 3) to each kernel, y0, v0 and g alone; steps are at
// most `longest`.
void response(const Primitive &primitive, std::ptrdiff_t N, const double *t, double tau,
    double longest, double *y, double *yd);

}  // namespace armlab
