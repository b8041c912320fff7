#include "math/motion/primitive.h"

namespace armlab {
namespace {

constexpr double coupled_step = 0.35;  // time constants of the spring in a step with a coupling

}  // namespace

PrimitiveStepper::PrimitiveStepper(const Primitive &p)
    : primitive(p), work_(8 * p.n), psi_(p.m), index_(p.m) {
  for (auto *part : {&y_, &z_, &y0_, &g_, &target_, &scale_, &f0_, &fm_, &f1_, &goal_, &rise_,
           &limit_, &side_, &braking_})
    part->assign(p.n, 0.0);
}

void PrimitiveStepper::start(
    const double *y0, const double *v0, const double *g, const double *scale, double tau) {
  const int n = primitive.n;
  tau_ = tau;
  s_ = 0.0;
  moving_ = false;
  for (int i = 0; i < n; ++i) {
    y_[i] = y0_[i] = y0[i];
    z_[i] = tau * v0[i];
    g_[i] = target_[i] = g[i];
    scale_[i] = scale[i];
    limit_[i] = side_[i] = braking_[i] = rise_[i] = 0.0;
  }
  force(0.0, y_.data(), f0_.data());
}

void PrimitiveStepper::force(double s, const double *y, double *f) {
  const int n = primitive.n;
  if (primitive.phase == PhaseKind::position) {
    double *p = work_.data() + 5 * n;
    for (int i = 0; i < n; ++i) {
      const double way = g_[i] - y0_[i];
      p[i] = way == 0.0 ? 0.0 : std::min(std::max((g_[i] - y[i]) / way, 0.0), 1.0);
    }
    primitive.forcing_each(p, index_.data(), psi_.data(), f);
  } else {
    primitive.forcing(primitive.phase_at(s), index_.data(), psi_.data(), f);
  }
  const double left = moving_ ? std::exp(-filter * (s - moved_)) : 0.0;
  for (int i = 0; i < n; ++i) f[i] *= scale_[i] + rise_[i] * left;
}

void PrimitiveStepper::step(double dt) {
  const double r = dt / tau_;
  if (coupling) step_coupled(r);
  else if (primitive.phase == PhaseKind::position) step_position(r);
  else step_spring(r);
  brake();
}

void PrimitiveStepper::step_spring(double r) {
  const int n = primitive.n;
  if (r != r_) spring_ = SpringStep(primitive.alpha, primitive.stiffness, r_ = r);
  force(s_ + 0.5 * r, nullptr, fm_.data());
  force(s_ += r, nullptr, f1_.data());
  if (!moving_) {
    spring_.advance(n, f0_.data(), fm_.data(), f1_.data(), g_.data(), y_.data(), z_.data());
  } else {  // measured from where the goal will be; how far it still has to go pulls as a force
    double *start = work_.data(), *middle = start + n, *end = middle + n;
    const double half = std::exp(-0.5 * filter * r), k = primitive.stiffness;
    for (int i = 0; i < n; ++i) {
      const double ahead = k * (g_[i] - target_[i]);
      start[i] = f0_[i] + ahead;
      middle[i] = fm_[i] + ahead * half;
      end[i] = f1_[i] + ahead * half * half;
      g_[i] = target_[i] + (g_[i] - target_[i]) * half * half;
    }
    spring_.advance(n, start, middle, end, target_.data(), y_.data(), z_.data());
  }
  f0_.swap(f1_);
}

// In steps that the spring allows: the forcing depends on where the motion is.
void PrimitiveStepper::step_position(double r) {
  const double parts =
      std::max(std::ceil(std::max(primitive.alpha, std::sqrt(primitive.stiffness)) * r), 1.0);
  for (double part = 0.0; part < parts; part += 1.0) step_runge(r / parts);
}

// Exactly where nothing acts from outside, else in steps that are short for the spring.
void PrimitiveStepper::step_coupled(double r) {
  const double stiff = std::max(primitive.alpha, std::sqrt(primitive.stiffness)) * r;
  const double parts = std::max(std::ceil(stiff / coupled_step), 1.0), h = r / parts;
  for (double part = 0.0; part < parts; part += 1.0) {
    if (primitive.phase == PhaseKind::position || coupling->acts(y_.data())) {
      step_runge(h);
    } else {
      step_spring(h);
      coupling->advance(h * tau_);
    }
  }
}

void PrimitiveStepper::step_runge(double h) {
  const int n = primitive.n;
  double *y = work_.data(), *z = y + n, *sum_y = z + n, *sum_z = sum_y + n, *f = sum_z + n,
         *v = f + 2 * n, *a = v + n;
  for (int stage = 0; stage < 4; ++stage) {
    const double reach = stage == 3 ? h : 0.5 * h,
                 weight = stage == 0 || stage == 3 ? h / 6.0 : h / 3.0;
    if (stage == 0) {
      for (int i = 0; i < n; ++i) {
        y[i] = sum_y[i] = y_[i];
        z[i] = sum_z[i] = z_[i];
      }
    }
    const double now = s_ + (stage == 0 ? 0.0 : reach);
    if (moving_)
      for (int i = 0; i < n; ++i)
        g_[i] = target_[i] + goal_[i] * std::exp(-filter * (now - moved_));
    force(now, y, f);
    if (coupling && stage % 2 == 1) coupling->advance(0.5 * h * tau_);
    for (int i = 0; i < n; ++i)
      a[i] = primitive.stiffness * (g_[i] - y[i]) - primitive.alpha * z[i] + f[i];
    if (coupling) {
      for (int i = 0; i < n; ++i) {
        v[i] = z[i] / tau_;
        a[i] /= tau_ * tau_;
      }
      coupling->add(y, v, g_.data(), a);
      for (int i = 0; i < n; ++i) a[i] *= tau_ * tau_;
    }
    for (int i = 0; i < n; ++i) {
      const double dy = z[i], dz = a[i];
      sum_y[i] += weight * dy;
      sum_z[i] += weight * dz;
      const double next = stage == 2 ? h : 0.5 * h;
      y[i] = y_[i] + next * dy;
      z[i] = z_[i] + next * dz;
    }
  }
  std::copy_n(sum_y, n, y_.data());
  std::copy_n(sum_z, n, z_.data());
  s_ += h;
  if (moving_)
    for (int i = 0; i < n; ++i) g_[i] = target_[i] + goal_[i] * std::exp(-filter * (s_ - moved_));
  force(s_, y_.data(), f0_.data());
}

// Keeps v^2 <= 2 a |g - y| on the way to a goal that has changed, and y on its side of it.
void PrimitiveStepper::brake() {
  for (int i = 0; i < primitive.n; ++i) {
    if (side_[i] == 0.0) continue;
    const double left = side_[i] * (target_[i] - y_[i]), v = side_[i] * z_[i] / tau_;
    braking_[i] = 0.0;
    if (left <= 0.0) {
      y_[i] = target_[i];
      if (v > 0.0) z_[i] = 0.0;
      braking_[i] = 1.0;
    } else if (v > 0.0 && v * v > 2.0 * limit_[i] * left) {
      z_[i] = side_[i] * tau_ * std::sqrt(2.0 * limit_[i] * left);
      braking_[i] = 1.0;
    }
  }
}

void PrimitiveStepper::change_goal(const double *g, const double *scale, const double *limit) {
  const double left = moving_ ? std::exp(-filter * (s_ - moved_)) : 0.0;
  for (int i = 0; i < primitive.n; ++i) {
    rise_[i] = filter == 0.0 ? 0.0 : scale_[i] + rise_[i] * left - scale[i];
    scale_[i] = scale[i];
    target_[i] = g[i];
    if (filter == 0.0) g_[i] = g[i];
    goal_[i] = g_[i] - target_[i];
    const double way = g[i] - y_[i], v = z_[i] / tau_;
    const bool brakes = limit && limit[i] > 0.0 && way * v >= 0.0 && way != 0.0 &&
                        v * v <= 2.0 * limit[i] * std::fabs(way);
    side_[i] = brakes ? std::copysign(1.0, way) : 0.0;
    limit_[i] = limit ? limit[i] : 0.0;
    braking_[i] = 0.0;
  }
  moving_ = filter > 0.0;
  moved_ = s_;
  force(s_, y_.data(), f0_.data());
}

void PrimitiveStepper::change_tau(double tau) {
  for (double &z : z_) z *= tau / tau_;
  tau_ = tau;
}

void PrimitiveStepper::outputs(double *y, double *yd, double *ydd, double *f) const {
  const int n = primitive.n;
  for (int i = 0; i < n; ++i) {
    y[i] = y_[i];
    yd[i] = z_[i] / tau_;
    ydd[i] =
        (primitive.stiffness * (g_[i] - y_[i]) - primitive.alpha * z_[i] + f0_[i]) / (tau_ * tau_);
    if (f) f[i] = f0_[i];
  }
  if (coupling) coupling->add(y, yd, g_.data(), ydd);
  for (int i = 0; i < n; ++i)
    if (braking_[i] != 0.0) ydd[i] = yd[i] == 0.0 ? 0.0 : -side_[i] * limit_[i];
}

}  // namespace armlab
