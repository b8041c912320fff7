// Sine and cosine over Real (double or Lanes), bit-identical in both.
#pragma once

#include "array/lanes.h"

namespace armlab {

// Beyond this |x|, sine and cosine are taken from the C library.
constexpr double far_angle = 1e6;

inline void replace_far(double x, double &sine, double &cosine) {
  if (std::fabs(x) <= far_angle) return;
  sine = std::sin(x);
  cosine = std::cos(x);
}
#ifdef ARMLAB_LANES
inline void replace_far(const Lanes &x, Lanes &sine, Lanes &cosine) {
  for (int lane = 0; lane < Lanes::width; ++lane) {
    double s = sine.v[lane], c = cosine.v[lane];
    replace_far(x.v[lane], s, c);
    sine.v[lane] = s;
    cosine.v[lane] = c;
  }
}
#endif

// Sine and cosine for |x| <= far_angle in three steps, with an error below 2.5e-16; NaN and
// infinity give NaN. Process several angles through each step together: instruction-level
// parallelism saves a third of the time.
//
// Step 1: x = k pi/2 + r with pi/2 in two parts. The first has 33 bits, so k times it is exact for
// |k| < 2^20; the second has an error of 4e-27. `quadrant` holds k in its low bits.
template <class Real>
inline void reduce_angle(const Real &x, Real &quadrant, Real &r) {
  constexpr Real two_over_pi(0x1.45f306dc9c883p-1), half_pi_1(0x1.921fb54400000p0),
      half_pi_2(0x1.0b4611a626331p-34);
  constexpr Real shifter(0x1.8p52);
  quadrant = x * two_over_pi + shifter;
  const Real k = quadrant - shifter;
  r = (x - k * half_pi_1) - k * half_pi_2;
}

// Step 2: minimax (Remez) polynomials on |r| <= pi/4, with errors of 2e-18 and 5e-20.
template <class Real>
inline void sincos_of_remainder(const Real &r, Real &sine, Real &cosine) {
  constexpr Real s3(-0x1.555555555553dp-3), s5(0x1.111111110eb1fp-7), s7(-0x1.a01a019ab4acep-13);
  constexpr Real s9(0x1.71de347563b5fp-19), s11(-0x1.ae5db477d3136p-26), s13(0x1.5d64c90301615p-33);
  constexpr Real c2(-0.5), c4(0x1.555555555554cp-5), c6(-0x1.6c16c16c15184p-10),
      c8(0x1.a01a019cb26e5p-16);
  constexpr Real c10(-0x1.27e4f80a75e5bp-22), c12(0x1.1ee9ec47628f5p-29),
      c14(-0x1.8faecf0464361p-37), one(1.0);
  const Real r2 = r * r, r4 = r2 * r2;
  sine = r + r * r2 * ((s3 + s5 * r2) + r4 * ((s7 + s9 * r2) + r4 * (s11 + s13 * r2)));
  cosine = (one + c2 * r2) + r4 * ((c4 + c6 * r2) + r4 * ((c8 + c10 * r2) + r4 * (c12 + c14 * r2)));
}

// Step 3: the quadrant. An odd quadrant swaps the two values. The second bit of k is the sign of
// the sine; the cosine is negative if the two lowest bits differ.
template <class Real>
inline void turn_to_quadrant(const Real &quadrant, Real &sine, Real &cosine) {
  const auto bits = to_bits(quadrant);
  const auto swap = bits << 63, sign = (bits & 2) << 62;
  const Real s = sine, c = cosine;
  sine = from_bits(to_bits(select(is_negative(swap), c, s)) ^ sign);
  cosine = from_bits(to_bits(select(is_negative(swap), s, c)) ^ (sign ^ swap));
}

// Raises `farthest` to |x|, except for NaN, whose sine and cosine are already NaN.
template <class Real>
inline void note_distance(const Real &x, Real &farthest) {
  const Real distance = from_bits(to_bits(x) & 0x7fffffffffffffff);
  farthest = select(farthest < distance, distance, farthest);
}

// Sine and cosine of any x.
template <class Real>
inline void sincos(const Real &x, Real &sine, Real &cosine) {
  Real quadrant, r, farthest(0.0);
  reduce_angle(x, quadrant, r);
  sincos_of_remainder(r, sine, cosine);
  turn_to_quadrant(quadrant, sine, cosine);
  note_distance(x, farthest);
  if (!all(farthest <= Real(far_angle))) replace_far(x, sine, cosine);
}

}  // namespace armlab
