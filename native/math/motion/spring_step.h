// The spring of a movement primitive, advanced exactly under a forcing term that is quadratic over
// the step. It is a header so that vectorised loops can inline it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace armlab {

// One exact step over r of y'' = stiffness (g - y) - alpha y' + f, with f a quadratic through its
// values at the start, the middle and the end: fourth order in f, and stable for any r.
struct SpringStep {
  double yy, yz, zy, zz;             // gains of the state, with y relative to the goal
  double f0, fm, f1, vf0, vfm, vf1;  // gains of the three forces on y and on z

  SpringStep() = default;
  SpringStep(double alpha, double stiffness, double r);

  void advance(std::ptrdiff_t count, const double *start, const double *middle, const double *end,
      const double *g, double *y, double *z) const;
};

// Integral of G(r - s) s^k over s from 0 to r, k = 1, 2, from the series of the impulse response G.
inline void short_moments(double alpha, double stiffness, double r, double &first, double &second) {
  double g = 1.0, before = 0.0, power = r * r * r / 6.0;  // G = sum g_j r^j / j!
  first = power;
  second = 0.0;
  for (int j = 1; j < 60; ++j) {
    const double term = 2.0 * power * r / (j + 3) * g;  // for the second moment, one power behind
    second += term;
    const double next = -(alpha * g + stiffness * before);
    before = g;
    g = next;
    power *= r / (j + 3);
    first += power * g;
    if (std::fabs(term) < 1e-18 * second && std::fabs(power * g) < 1e-18 * first) break;
  }
}

// The impulse response and its derivative, unless r is short.
inline void long_response(double alpha, double stiffness, double r, double &G, double &slope) {
  const double sigma = 0.5 * alpha, square = sigma * sigma - stiffness;
  const double mu = std::sqrt(std::fabs(square)), angle = mu * r;
  double even, odd;  // e^(-sigma r) cosh(mu r), e^(-sigma r) sinh(mu r) / mu
  if (angle < 1e-3) {
    const double decay = std::exp(-sigma * r), a = square * r * r;
    even = decay * (1.0 + a / 2.0 * (1.0 + a / 12.0));
    odd = decay * r * (1.0 + a / 6.0 * (1.0 + a / 20.0));
  } else if (square > 0.0) {
    const double slow = std::exp((mu - sigma) * r), fast = std::exp(-(mu + sigma) * r);
    even = 0.5 * (slow + fast);
    odd = 0.5 * (slow - fast) / mu;
  } else {
    const double decay = std::exp(-sigma * r);
    even = decay * std::cos(angle);
    odd = decay * std::sin(angle) / mu;
  }
  G = odd;
  slope = even - sigma * odd;
}

inline SpringStep::SpringStep(double alpha, double stiffness, double r) {
  double G, slope, zeroth, first, second;  // impulse response, its derivative, its moments
  r = std::max(r, 1e-100);  // shorter steps have no effect, and their powers would be 0
  const double fastest = std::max(alpha, std::sqrt(stiffness));
  // over a short time, the slow mode hardly changes, and its moments would cancel
  if (fastest * r < 1.0 || stiffness * r < alpha) {
    double h = r;
    int doublings = 0;
    for (; fastest * h >= 1.0; ++doublings) h *= 0.5;
    short_moments(alpha, stiffness, h, first, second);
    zeroth = 0.5 * (h * h - stiffness * second) - alpha * first;
    G = h - alpha * zeroth - stiffness * first;
    slope = 1.0 - alpha * G - stiffness * zeroth;
    for (; doublings > 0; --doublings) {  // free response of the first half, plus the second
      const double stays = slope + alpha * G + 1.0;
      second = stays * second + 2.0 * (G + h) * first + h * h * zeroth;
      first = stays * first + (G + h) * zeroth;
      zeroth = stays * zeroth + G * G;
      const double before = slope;
      slope = slope * slope - stiffness * (G * G);
      G *= 2.0 * before + alpha * G;
      h *= 2.0;
    }
  } else {
    long_response(alpha, stiffness, r, G, slope);
    zeroth = (1.0 - slope - alpha * G) / stiffness;
    first = (r - alpha * zeroth - G) / stiffness;
    second = (r * r - 2.0 * alpha * first - 2.0 * zeroth) / stiffness;
  }
  yy = slope + alpha * G;
  yz = G;
  zy = -stiffness * G;
  zz = slope;
  const double linear = first / r, quadratic = second / (r * r);
  f0 = zeroth - 3.0 * linear + 2.0 * quadratic;
  fm = 4.0 * (linear - quadratic);
  f1 = 2.0 * quadratic - linear;
  const double rate = zeroth / r, curve = first / (r * r);
  vf0 = G - 3.0 * rate + 4.0 * curve;
  vfm = 4.0 * rate - 8.0 * curve;
  vf1 = 4.0 * curve - rate;
}

inline void SpringStep::advance(std::ptrdiff_t count, const double *start, const double *middle,
    const double *end, const double *g, double *__restrict y, double *__restrict z) const {
  const SpringStep s = *this;  // in registers, because y and z could alias members
  for (std::ptrdiff_t i = 0; i < count; ++i) {
    const double d = y[i] - g[i], v = z[i];
    y[i] = g[i] + (s.yy * d + s.yz * v) + (s.f0 * start[i] + s.fm * middle[i] + s.f1 * end[i]);
    z[i] = (s.zy * d + s.zz * v) + (s.vf0 * start[i] + s.vfm * middle[i] + s.vf1 * end[i]);
  }
}

}  // namespace armlab
