// The exponential of what is not positive, for loops that a compiler turns into vector
// instructions.
#pragma once

#include "array/lanes.h"

namespace armlab {

// exp(x) for -700 < x <= 0 with an error below 1.5 units in the last place; NaN gives NaN. x = k ln
// 2 + r with ln 2 in two parts, the first of 32 bits, so that k times it is exact; then the series
// of exp(r), |r| <= ln(2) / 2, whose first term left out is below 5e-18; then k is added to the
// exponent.
ARMLAB_INLINE double exponential(double x) {
  constexpr double shifter = 0x1.8p52, one_over_ln2 = 0x1.71547652b82fep0;
  constexpr double ln2_1 = 0x1.62e42fee00000p-1, ln2_2 = 0x1.a39ef35793c76p-33;
  const double shifted = x * one_over_ln2 + shifter, k = shifted - shifter;
  const double r = (x - k * ln2_1) - k * ln2_2, r2 = r * r, r4 = r2 * r2;
  const double low = (0.5 + r * (1.0 / 6)) + r2 * (1.0 / 24 + r * (1.0 / 120));
  const double middle = (1.0 / 720 + r * (1.0 / 5040)) + r2 * (1.0 / 40320 + r * (1.0 / 362880));
  const double high =
      (1.0 / 3628800 + r * (1.0 / 39916800)) + r2 * (1.0 / 479001600 + r * (1.0 / 6227020800.0));
  const double e = 1.0 + (r + r2 * (low + r4 * (middle + r4 * high)));
  return from_bits(to_bits(e) + (to_bits(shifted) << 52));
}

}  // namespace armlab
