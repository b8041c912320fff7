#include "math/motion/two_dof.h"

#include <limits>
#include <utility>

namespace armlab {
namespace {

constexpr double thaw = 0.8;

}  // namespace

struct TwoDof::Law {
  double ycd[max_joints], ycdd[max_joints], yadd[max_joints], zd[max_joints], ed[max_joints], xd;
};

TwoDof::TwoDof(Parameters parameters)
    : p_(std::move(parameters)), index_(p_.primitive.m), psi_(p_.primitive.m) {}

void TwoDof::forcing(double x, const double *yc, double *f) {
  const Primitive &primitive = p_.primitive;
  if (primitive.phase != PhaseKind::position)
    return primitive.forcing(x, index_.data(), psi_.data(), f);
  double left[max_joints];
  for (int i = 0; i < n(); ++i) {
    const double way = p_.g[i] - p_.y0[i];
    left[i] = way == 0.0 ? 0.0 : std::min(std::max((p_.g[i] - yc[i]) / way, 0.0), 1.0);
  }
  primitive.forcing_each(left, index_.data(), psi_.data(), f);
}

double TwoDof::frozen(const double *state) const {
  const int n = this->n();
  double worst = 0.0;
  for (int i = 0; i < n; ++i)
    worst = std::max(worst, std::fabs(state[3 * n + i] - state[i]) / p_.unit[i]);
  return worst > (state[5 * n + 1] != 0.0 ? thaw * p_.e_max : p_.e_max) ? 1.0 : 0.0;
}

double TwoDof::time_constant(const double *state) const {
  double sum = 0.0;
  for (int i = 0; i < n(); ++i) {
    const double d = std::max(std::fabs(state[2 * n() + i]) - p_.dead_zone[i], 0.0) / p_.unit[i];
    sum += d * d;
  }
  return p_.tau * (1.0 + p_.kc * sum);
}

void TwoDof::law(const double *state, double v, double rate, Law &law) {
  const Primitive &primitive = p_.primitive;
  const int n = this->n();
  const double *yc = state, *z = yc + n, *e = z + n, *ya = e + n, *yad = ya + n, x = state[5 * n];
  if (state[5 * n + 1] != 0.0) v = rate = 0.0;
  const double tau_a = time_constant(state);
  double turned = 0.0, f[max_joints];
  for (int i = 0; i < n; ++i) {
    const double d = std::copysign(std::max(std::fabs(e[i]) - p_.dead_zone[i], 0.0), e[i]);
    law.ed[i] = p_.alpha_e * (ya[i] - yc[i] - e[i]);
    turned += d / (p_.unit[i] * p_.unit[i]) * law.ed[i];
  }
  const double tau_ad = 2.0 * p_.tau * p_.kc * turned;
  forcing(x, yc, f);
  for (int i = 0; i < n; ++i) {
    law.ycd[i] = v * z[i] / tau_a;
    law.zd[i] =
        v *
        (primitive.stiffness * (p_.g[i] - yc[i]) - primitive.alpha * z[i] + p_.scale[i] * f[i]) /
        tau_a;
    law.ycdd[i] = (v * law.zd[i] - law.ycd[i] * tau_ad + rate * z[i]) / tau_a;
    law.yadd[i] = p_.kp * (yc[i] - ya[i]) + p_.kv * (law.ycd[i] - yad[i]) + law.ycdd[i];
  }
  law.xd = v * (primitive.phase == PhaseKind::time ? primitive.pace : -primitive.decay * x) / tau_a;
}

void TwoDof::rates(const double *state, double v, double rate, const double *driven, double *out) {
  const int n = this->n();
  Law now;
  law(state, v, rate, now);
  for (int i = 0; i < n; ++i) {
    out[i] = now.ycd[i];
    out[n + i] = now.zd[i];
    out[2 * n + i] = now.ed[i];
    out[3 * n + i] = state[4 * n + i];
    out[4 * n + i] = std::isfinite(driven[i]) ? 0.0 : now.yadd[i];
  }
  out[5 * n] = now.xd;
  out[5 * n + 1] = 0.0;
}

void TwoDof::advance(
    double *state, double dt, long steps, const double *driven, const Speed &speed) {
  const int n = this->n(), N = size();
  const double h = dt / steps, rate = (speed.end - speed.start) / dt;
  double k1[most], k2[most], k3[most], k4[most], stage[most];
  for (int i = 0; i < n; ++i)
    if (std::isfinite(driven[i])) state[4 * n + i] = driven[i];
  if (dt == 0.0) {
    state[N - 1] = frozen(state);
    return;
  }
  for (long step = 0; step < steps; ++step) {
    state[N - 1] = frozen(state);
    const double start = speed.start + rate * (step * h), middle = start + 0.5 * h * rate;
    rates(state, start, rate, driven, k1);
    for (int i = 0; i < N; ++i) stage[i] = state[i] + 0.5 * h * k1[i];
    rates(stage, middle, rate, driven, k2);
    for (int i = 0; i < N; ++i) stage[i] = state[i] + 0.5 * h * k2[i];
    rates(stage, middle, rate, driven, k3);
    for (int i = 0; i < N; ++i) stage[i] = state[i] + h * k3[i];
    rates(stage, start + h * rate, rate, driven, k4);
    for (int i = 0; i < N; ++i) state[i] += (h / 6.0) * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
  }
}

void TwoDof::slopes(const double *state, const Speed &speed, double *out) {
  double nothing[max_joints];
  std::fill_n(nothing, n(), std::numeric_limits<double>::quiet_NaN());
  rates(state, speed.end, speed.rate, nothing, out);
}

void TwoDof::reference(const double *state, const Speed &speed, double *out) {
  const int n = this->n();
  Law now;
  law(state, speed.end, speed.rate, now);
  std::copy_n(now.ycd, n, out);
  std::copy_n(now.ycdd, n, out + n);
  std::copy_n(now.yadd, n, out + 2 * n);
}

void TwoDof::follow(double *state, double dt, long steps, const Speed &speed, const double *ya,
    const double *yad, double *out) {
  const int n = this->n();
  double driven[max_joints];
  std::copy_n(state + 4 * n, n, driven);
  advance(state, dt, steps, driven, speed);
  if (finite(ya, n) && finite(yad, n)) {
    std::copy_n(ya, n, state + 3 * n);
    std::copy_n(yad, n, state + 4 * n);
  }
  state[5 * n + 1] = frozen(state);
  reference(state, speed, out);
}

}  // namespace armlab
