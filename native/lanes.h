// `Lanes`: the same quantity of four configurations side by side.
//
// Kernels are templates over Real, which is double (one configuration) or Lanes (a batch). Both do the same operations
// in the same order and the compiler may not contract them, so a batch gives bit for bit what a loop over its samples
// gives, on every machine. (Fused multiply-add was measured: it gains nothing here.)
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

// A function marked so is compiled for AVX2 and for any machine, with all that it calls; the loader chooses.
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define ARMLAB_VECTORISED __attribute__((target_clones("avx2", "default"), flatten))
#else
#define ARMLAB_VECTORISED
#endif

// For functions with Lanes by value: how those are passed depends on the instruction set, so they must never be called.
#define ARMLAB_INLINE inline __attribute__((always_inline))

namespace armlab {

struct alignas(32) Lanes {
  static constexpr int width = 4;
  typedef double Doubles __attribute__((vector_size(8 * width)));
  typedef std::int64_t Bits __attribute__((vector_size(8 * width)));

  Doubles v;

  Lanes() = default;
  ARMLAB_INLINE Lanes(Doubles values) : v(values) {}
  ARMLAB_INLINE constexpr Lanes(double value) : v{value, value, value, value} {}
};

ARMLAB_INLINE Lanes operator+(Lanes a, Lanes b) { return a.v + b.v; }
ARMLAB_INLINE Lanes operator-(Lanes a, Lanes b) { return a.v - b.v; }
ARMLAB_INLINE Lanes operator*(Lanes a, Lanes b) { return a.v * b.v; }
ARMLAB_INLINE Lanes operator/(Lanes a, Lanes b) { return a.v / b.v; }
ARMLAB_INLINE Lanes operator-(Lanes a) { return -a.v; }
ARMLAB_INLINE Lanes::Bits operator<(Lanes a, Lanes b) { return a.v < b.v; }
ARMLAB_INLINE Lanes::Bits operator<=(Lanes a, Lanes b) { return a.v <= b.v; }
ARMLAB_INLINE Lanes::Bits operator==(Lanes a, Lanes b) { return a.v == b.v; }

// What a condition chooses, lane by lane; a condition is bool for double and Lanes::Bits for Lanes.
ARMLAB_INLINE double select(bool condition, double yes, double no) { return condition ? yes : no; }
ARMLAB_INLINE Lanes select(Lanes::Bits condition, Lanes yes, Lanes no) { return condition ? yes.v : no.v; }
ARMLAB_INLINE bool all(bool condition) { return condition; }
ARMLAB_INLINE bool all(Lanes::Bits condition) {
  return (condition[0] & condition[1] & condition[2] & condition[3]) != 0;
}

ARMLAB_INLINE double square_root(double x) { return std::sqrt(x); }
ARMLAB_INLINE Lanes square_root(Lanes x) {
  for (int lane = 0; lane < Lanes::width; ++lane) x.v[lane] = std::sqrt(x.v[lane]);
  return x;
}

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
ARMLAB_INLINE Lanes::Bits to_bits(Lanes x) { return (Lanes::Bits)x.v; }
ARMLAB_INLINE Lanes from_bits(Lanes::Bits bits) { return (Lanes::Doubles)bits; }

// Where |x| is beyond `limit`, infinite or NaN: sine and cosine from the C library instead.
inline void replace_far(double x, double limit, double &sine, double &cosine) {
  if (__builtin_expect(std::fabs(x) <= limit, 1)) return;
  sine = std::sin(x);
  cosine = std::cos(x);
}
inline void replace_far(const Lanes &x, double limit, Lanes &sine, Lanes &cosine) {
  bool near = true;
  for (int lane = 0; lane < Lanes::width; ++lane) near &= std::fabs(x.v[lane]) <= limit;
  if (__builtin_expect(near, 1)) return;
  for (int lane = 0; lane < Lanes::width; ++lane)
    if (!(std::fabs(x.v[lane]) <= limit)) {
      sine.v[lane] = std::sin(x.v[lane]);
      cosine.v[lane] = std::cos(x.v[lane]);
    }
}

// Sine and cosine, error below 2.5e-16.
// x = k pi/2 + r with pi/2 in three parts of 33 bits, so that k times a part is exact for |k| < 2^20; then the Taylor
// polynomials on |r| <= pi/4, whose first neglected terms are below 5e-17. Far angles are left to the C library.
template <class Real>
inline void sincos(const Real &x, Real &sine, Real &cosine) {
  constexpr Real two_over_pi(0x1.45f306dc9c883p-1);
  constexpr Real half_pi_1(0x1.921fb54400000p0), half_pi_2(0x1.0b4611a600000p-34), half_pi_3(0x1.3198a2e037073p-69);
  constexpr Real shifter(0x1.8p52);  // x + shifter holds the integer nearest to x in its low bits

  const Real shifted = x * two_over_pi + shifter;
  const Real k = shifted - shifter;
  const Real r = ((x - k * half_pi_1) - k * half_pi_2) - k * half_pi_3;

  constexpr Real s3(-1.0 / 6.0), s5(1.0 / 120.0), s7(-1.0 / 5040.0), s9(1.0 / 362880.0), s11(-1.0 / 39916800.0);
  constexpr Real s13(1.0 / 6227020800.0), s15(-1.0 / 1307674368000.0);
  constexpr Real c2(-0.5), c4(1.0 / 24.0), c6(-1.0 / 720.0), c8(1.0 / 40320.0), c10(-1.0 / 3628800.0);
  constexpr Real c12(1.0 / 479001600.0), c14(-1.0 / 87178291200.0), c16(1.0 / 20922789888000.0), one(1.0);
  const Real r2 = r * r, r4 = r2 * r2, r8 = r4 * r4;
  const Real s = r + r2 * r * ((s3 + s5 * r2) + (s7 + s9 * r2) * r4 + ((s11 + s13 * r2) + s15 * r4) * r8);
  const Real c = (one + c2 * r2) + r4 * ((c4 + c6 * r2) + (c8 + c10 * r2) * r4 + ((c12 + c14 * r2) + c16 * r4) * r8);

  // Odd quadrants swap the two; the second bit of k (of k + 1) is the sign of the sine (cosine).
  const auto bits = to_bits(shifted);
  const auto swap = -(bits & 1);
  const auto s_bits = to_bits(s), c_bits = to_bits(c);
  sine = from_bits(((s_bits & ~swap) | (c_bits & swap)) ^ ((bits & 2) << 62));
  cosine = from_bits(((c_bits & ~swap) | (s_bits & swap)) ^ (((bits + 1) & 2) << 62));
  replace_far(x, 1e6, sine, cosine);
}

}  // namespace armlab
