// `Lanes`: the same quantity of four configurations side by side.
//
// Kernels are templates over Real, which is double (one configuration) or Lanes (a batch). Both
// perform the same operations in the same order, and the compiler must not contract them. A batch
// is therefore bit-identical to a loop over its samples, on every machine.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

// Lanes need the vector extension of GCC and Clang. Other compilers, and builds with ARMLAB_PLAIN,
// compile only the double kernels, which give bit-identical results.
#if defined(__GNUC__) && !defined(ARMLAB_PLAIN)
#define ARMLAB_LANES
#endif

// Functions marked with ARMLAB_VECTORISED are compiled for several instruction sets, including all
// callees, and the loader selects one. With ARMLAB_DISPATCH, batch.h selects it. From AVX-512, only
// the 32 registers are used, which makes a Jacobian 10 % faster. (Eight lanes would save another
// 7 %, but cost 10 % with the 16 registers of AVX2.)
#ifdef ARMLAB_VECTORISED
#elif defined(ARMLAB_LANES) && defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__)
#define ARMLAB_DISPATCH
#if __GNUC__ >= 12
#define ARMLAB_VECTORISED \
  __attribute__((target_clones("arch=x86-64-v4", "avx2", "default"), flatten))
#else
#define ARMLAB_VECTORISED __attribute__((target_clones("avx2", "default"), flatten))
#endif
#else
#define ARMLAB_VECTORISED
#endif

// For functions with Lanes parameters by value: always inlined, because the calling convention
// depends on the instruction set.
#ifdef ARMLAB_LANES
#define ARMLAB_INLINE inline __attribute__((always_inline))
#else
#define ARMLAB_INLINE inline
#endif

namespace armlab {

#ifdef ARMLAB_LANES
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

ARMLAB_INLINE Lanes select(Lanes::Bits condition, Lanes yes, Lanes no) {
  return condition ? yes.v : no.v;
}
ARMLAB_INLINE bool all(Lanes::Bits condition) {
  return (condition[0] & condition[1] & condition[2] & condition[3]) != 0;
}
ARMLAB_INLINE Lanes square_root(Lanes x) {
  return Lanes::Doubles{std::sqrt(x.v[0]), std::sqrt(x.v[1]), std::sqrt(x.v[2]), std::sqrt(x.v[3])};
}
ARMLAB_INLINE Lanes::Bits to_bits(Lanes x) { return (Lanes::Bits)x.v; }
ARMLAB_INLINE Lanes from_bits(Lanes::Bits bits) { return (Lanes::Doubles)bits; }
ARMLAB_INLINE Lanes::Bits is_negative(Lanes::Bits bits) { return bits < 0; }
#endif

// Lane-by-lane selection; the condition is bool for double and Lanes::Bits for Lanes.
ARMLAB_INLINE double select(bool condition, double yes, double no) { return condition ? yes : no; }
ARMLAB_INLINE bool all(bool condition) { return condition; }
ARMLAB_INLINE double square_root(double x) { return std::sqrt(x); }

// The bit pattern of a number, for sine and cosine.
ARMLAB_INLINE std::uint64_t to_bits(double x) {
  std::uint64_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  return bits;
}
ARMLAB_INLINE double from_bits(std::uint64_t bits) {
  double x;
  std::memcpy(&x, &bits, sizeof x);
  return x;
}
ARMLAB_INLINE bool is_negative(std::uint64_t bits) { return bits >> 63; }

}  // namespace armlab
