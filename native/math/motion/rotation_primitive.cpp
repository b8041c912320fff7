#include "math/motion/rotation_primitive.h"

namespace armlab {
namespace {

using Vector = Vec3<double>;

Quaternion<double> conjugate(const Quaternion<double> &q) { return {q.w, -q.v}; }

Quaternion<double> read(const double *q) {
  return unit(Quaternion<double>{q[0], {q[1], q[2], q[3]}});
}

// exp(theta) q
Quaternion<double> turned(const Vector &theta, const Quaternion<double> &q) {
  const Angle<double> t(theta);
  return Quaternion<double>{t.cosine, t.k * theta} * q;
}

// theta' of exp(theta) q at angular velocity w, to fourth order in theta.
Vector chart(const Vector &theta, const Vector &w) {
  const Vector once = cross(theta, w);
  return w - 0.5 * once + (1.0 / 12.0) * cross(theta, once);
}

}  // namespace

RotationStepper::RotationStepper(const Primitive &p) : primitive(p), psi_(p.m), index_(p.m) {}

void RotationStepper::start(
    const double *q0, const double *w0, const double *goal, const double *map, double tau) {
  q_ = read(q0);
  z_ = {tau * w0[0], tau * w0[1], tau * w0[2]};
  tau_ = tau;
  s_ = 0.0;
  change_goal(goal, map);
}

void RotationStepper::change_goal(const double *goal, const double *map) {
  goal_ = read(goal);
  map_ = Rotation<double>::read(map, 3);
  f_ = force(s_);
}

void RotationStepper::change_tau(double tau) {
  z_ = (tau / tau_) * z_;
  tau_ = tau;
}

Vector RotationStepper::force(double s) {
  double f[3];
  primitive.forcing(primitive.phase_at(s), index_.data(), psi_.data(), f);
  return map_.turn({f[0], f[1], f[2]});
}

// The shorter rotation vector to the goal.
Vector RotationStepper::error(const Quaternion<double> &q) const {
  const Quaternion<double> way = goal_ * conjugate(q);
  return rotation_vector(way.w < 0.0 ? Quaternion<double>{-way.w, -way.v} : way);
}

void RotationStepper::step(double dt) {
  const double r = dt / tau_, fastest = std::max(primitive.alpha, std::sqrt(primitive.stiffness));
  const double parts = std::max(std::ceil(fastest * r), 1.0), h = r / parts, begin = s_;
  for (double part = 1.0; part <= parts; part += 1.0) {
    const Vector middle = force(begin + (part - 0.5) * h), end = force(begin + part * h);
    advance(h, f_, middle, end);
    f_ = end;
  }
  s_ = begin + r;
}

// One RK4 step in the chart exp(theta) q around the orientation at its start.
void RotationStepper::advance(
    double h, const Vector &start, const Vector &middle, const Vector &end) {
  const double alpha = primitive.alpha, stiffness = primitive.stiffness;
  const Vector *forces[4] = {&start, &middle, &middle, &end};
  Vector theta{0.0, 0.0, 0.0}, z = z_, theta_sum = theta, z_sum = z_;
  for (int stage = 0; stage < 4; ++stage) {
    const Vector rate = stage ? chart(theta, z) : z;
    const Vector pull =
        stiffness * error(stage ? turned(theta, q_) : q_) - alpha * z + *forces[stage];
    const double weight = stage == 0 || stage == 3 ? h / 6.0 : h / 3.0,
                 reach = stage == 2 ? h : 0.5 * h;
    theta_sum = theta_sum + weight * rate;
    z_sum = z_sum + weight * pull;
    theta = reach * rate;
    z = z_ + reach * pull;
  }
  q_ = unit(turned(theta_sum, q_));
  z_ = z_sum;
}

void RotationStepper::outputs(double *q, double *w, double *wd) const {
  const Vector rate = (1.0 / tau_) * z_;
  const Vector pull = primitive.stiffness * error(q_) - primitive.alpha * z_ + f_;
  const Vector acceleration = (1.0 / (tau_ * tau_)) * pull;
  const double values[10] = {q_.w, q_.v.x, q_.v.y, q_.v.z, rate.x, rate.y, rate.z, acceleration.x,
      acceleration.y, acceleration.z};
  std::copy_n(values, 4, q);
  std::copy_n(values + 4, 3, w);
  std::copy_n(values + 7, 3, wd);
}

}  // namespace armlab
