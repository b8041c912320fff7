#include "two_dof.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace armlab {
namespace {

constexpr double gate_share = 0.1, thaw = 0.8;
constexpr double least = -40.0;  // kernels this far below the largest exponent add less than rounding

double gate(double u) {
  const double s = std::min(std::max((u - 1.0) / gate_share, 0.0), 1.0);
  return 1.0 - s * s * s * (10.0 + s * (6.0 * s - 15.0));
}

bool finite(const double *values, int n) {
  return std::all_of(values, values + n, [](double x) { return std::isfinite(x); });
}

}  // namespace

struct TwoDof::Law {
  double ycd[max_joints], ycdd[max_joints], yadd[max_joints], zd[max_joints], ed[max_joints], xd;
};

TwoDof::TwoDof(Parameters parameters) : p_(std::move(parameters)), exponents_(p_.m) {}

void TwoDof::basis(double x, int first, int last, double *sums) {
  const int m = p_.m, n = p_.n;
  double *exponents = exponents_.data();
  double largest = -HUGE_VAL, total = 0.0;
  for (int j = 0; j < m; ++j) {
    const double u = (x - p_.centres[j]) / p_.widths[j];
    exponents[j] = -0.5 * (u * u);
    largest = std::max(largest, exponents[j]);
  }
  std::fill(sums + first, sums + last, 0.0);
  for (int j = 0; j < m; ++j) {
    const double below = exponents[j] - largest;
    if (below < least) continue;
    const double psi = std::exp(below);
    const double *w = &p_.weights[j * n];
    total += psi;
    for (int i = first; i < last; ++i) sums[i] += psi * w[i];
  }
  for (int i = first; i < last; ++i) sums[i] /= total;
}

void TwoDof::forcing(double x, const double *yc, double *f) {
  const int n = p_.n;
  if (p_.phase != Phase::position) {
    basis(x, 0, n, f);
    const double share = p_.phase == Phase::canonical ? x : gate(x);
    for (int i = 0; i < n; ++i) f[i] *= share;
    return;
  }
  for (int i = 0; i < n; ++i) {
    const double way = p_.g[i] - p_.y0[i];
    const double p = way == 0.0 ? 0.0 : std::min(std::max((p_.g[i] - yc[i]) / way, 0.0), 1.0);
    basis(p, i, i + 1, f);
    f[i] *= p;
  }
}

double TwoDof::frozen(const double *state) const {
  const int n = p_.n;
  double worst = 0.0;
  for (int i = 0; i < n; ++i) worst = std::max(worst, std::fabs(state[3 * n + i] - state[i]) / p_.scale[i]);
  return worst > (state[5 * n + 1] != 0.0 ? thaw * p_.e_max : p_.e_max) ? 1.0 : 0.0;
}

double TwoDof::time_constant(const double *state) const {
  double sum = 0.0;
  for (int i = 0; i < p_.n; ++i) {
    const double d = std::max(std::fabs(state[2 * p_.n + i]) - p_.dead_zone[i], 0.0) / p_.scale[i];
    sum += d * d;
  }
  return p_.tau * (1.0 + p_.kc * sum);
}

void TwoDof::law(const double *state, double v, double rate, Law &law) {
  const int n = p_.n;
  const double *yc = state, *z = yc + n, *e = z + n, *ya = e + n, *yad = ya + n, x = state[5 * n];
  if (state[5 * n + 1] != 0.0) v = rate = 0.0;
  const double tau_a = time_constant(state);
  double turned = 0.0, f[max_joints];
  for (int i = 0; i < n; ++i) {
    const double d = std::copysign(std::max(std::fabs(e[i]) - p_.dead_zone[i], 0.0), e[i]);
    law.ed[i] = p_.alpha_e * (ya[i] - yc[i] - e[i]);
    turned += d / (p_.scale[i] * p_.scale[i]) * law.ed[i];
  }
  const double tau_ad = 2.0 * p_.tau * p_.kc * turned;
  forcing(x, yc, f);
  for (int i = 0; i < n; ++i) {
    law.ycd[i] = v * z[i] / tau_a;
    law.zd[i] = v * (p_.alpha_z * (p_.beta_z * (p_.g[i] - yc[i]) - z[i]) + f[i]) / tau_a;
    law.ycdd[i] = (v * law.zd[i] - law.ycd[i] * tau_ad + rate * z[i]) / tau_a;
    law.yadd[i] = p_.kp * (yc[i] - ya[i]) + p_.kv * (law.ycd[i] - yad[i]) + law.ycdd[i];
  }
  law.xd = p_.phase == Phase::time ? v * p_.tau / (p_.duration * tau_a) : -v * p_.alpha_x * x / tau_a;
}

void TwoDof::rates(const double *state, double v, double rate, const double *driven, double *out) {
  const int n = p_.n;
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

void TwoDof::advance(double *state, double dt, long steps, const double *driven, const Speed &speed) {
  if (dt == 0.0) return;
  const int n = p_.n, N = size();
  const double h = dt / steps, rate = (speed.end - speed.start) / dt;
  double k1[most], k2[most], k3[most], k4[most], stage[most];
  for (int i = 0; i < n; ++i)
    if (std::isfinite(driven[i])) state[4 * n + i] = driven[i];
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

void TwoDof::reference(const double *state, const Speed &speed, double *out) {
  const int n = p_.n;
  Law now;
  law(state, speed.end, speed.rate, now);
  std::copy_n(now.ycd, n, out);
  std::copy_n(now.ycdd, n, out + n);
  std::copy_n(now.yadd, n, out + 2 * n);
}

void TwoDof::follow(double *state, double dt, long steps, const Speed &speed, const double *ya, const double *yad,
                    double *out) {
  const int n = p_.n;
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
