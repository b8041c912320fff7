// `Lanes`: the same quantity of several configurations side by side, one SIMD register wide.
//
// Kernels are templates over Real, which is double (one configuration) or Lanes (a batch). Both do the same operations in
// the same order and the compiler may not contract them, so a batch gives bit for bit what a loop over its samples gives.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

namespace armlab {

struct Lanes {
  static constexpr int width = 2;
  typedef double Doubles __attribute__((vector_size(8 * width)));
  typedef std::int64_t Bits __attribute__((vector_size(8 * width)));

  Doubles v;

  Lanes() = default;
  Lanes(Doubles values) : v(values) {}
  Lanes(double value) : v(value - Doubles{}) {}
};

inline Lanes operator+(Lanes a, Lanes b) { return a.v + b.v; }
inline Lanes operator-(Lanes a, Lanes b) { return a.v - b.v; }
inline Lanes operator*(Lanes a, Lanes b) { return a.v * b.v; }
inline Lanes operator-(Lanes a) { return -a.v; }

// Views of the bits, for the sine and cosine below.
inline std::int64_t to_bits(double x) {
  std::int64_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  return bits;
}
inline double from_bits(std::int64_t bits) {
  double x;
  std::memcpy(&x, &bits, sizeof x);
  return x;
}
inline Lanes::Bits to_bits(Lanes x) { return (Lanes::Bits)x.v; }
inline Lanes from_bits(Lanes::Bits bits) { return (Lanes::Doubles)bits; }

inline bool all_within(double x, double limit) { return std::fabs(x) <= limit; }
inline bool all_within(Lanes x, double limit) {
  bool within = true;
  for (int lane = 0; lane < Lanes::width; ++lane) within &= std::fabs(x.v[lane]) <= limit;
  return within;
}

inline void library_sincos(double x, double &sine, double &cosine) {
  sine = std::sin(x);
  cosine = std::cos(x);
}
inline void library_sincos(Lanes x, Lanes &sine, Lanes &cosine) {
  for (int lane = 0; lane < Lanes::width; ++lane) {
    sine.v[lane] = std::sin(x.v[lane]);
    cosine.v[lane] = std::cos(x.v[lane]);
  }
}

// Sine and cosine to about one unit in the last place.
// x = k pi/2 + r with pi/2 in three parts of 33 bits, so that k times a part is exact for |k| < 2^20; then the Taylor
// polynomials on |r| <= pi/4, whose first neglected terms are below 5e-17. Beyond that range, and for NaN: the C library.
template <class Real>
inline void sincos(Real x, Real &sine, Real &cosine) {
  if (__builtin_expect(!all_within(x, 1e6), 0)) return library_sincos(x, sine, cosine);
  const double two_over_pi = 0x1.45f306dc9c883p-1;
  const double half_pi_1 = 0x1.921fb54400000p0, half_pi_2 = 0x1.0b4611a600000p-34, half_pi_3 = 0x1.3198a2e037073p-69;
  const double shifter = 0x1.8p52;  // x + shifter holds the integer nearest to x in its low bits

  const Real shifted = x * Real(two_over_pi) + Real(shifter);
  const Real k = shifted - Real(shifter);
  const Real r = ((x - k * Real(half_pi_1)) - k * Real(half_pi_2)) - k * Real(half_pi_3);
  const Real r2 = r * r;

  Real s = Real(-1.0 / 1307674368000.0);
  for (double factor : {1.0 / 6227020800.0, -1.0 / 39916800.0, 1.0 / 362880.0, -1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0})
    s = s * r2 + Real(factor);
  s = s * (r2 * r) + r;
  Real c = Real(1.0 / 20922789888000.0);
  for (double factor : {-1.0 / 87178291200.0, 1.0 / 479001600.0, -1.0 / 3628800.0, 1.0 / 40320.0, -1.0 / 720.0, 1.0 / 24.0})
    c = c * r2 + Real(factor);
  c = (c * r2 - Real(0.5)) * r2 + Real(1.0);

  // Odd quadrants swap the two; the second bit of k (of k + 1) is the sign of the sine (cosine).
  const auto bits = to_bits(shifted);
  const auto swap = -(bits & 1);
  const auto s_bits = to_bits(s), c_bits = to_bits(c);
  sine = from_bits(((s_bits & ~swap) | (c_bits & swap)) ^ ((bits & 2) << 62));
  cosine = from_bits(((c_bits & ~swap) | (s_bits & swap)) ^ (((bits + 1) & 2) << 62));
}

}  // namespace armlab
