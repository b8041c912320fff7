// Random numbers that depend on a seed and an index alone.
#pragma once

#include <cstdint>

namespace armlab {

// SplitMix64: number `index` of the sequence of `seed`, uniform in [0, 1).
inline double uniform(std::uint64_t seed, std::uint64_t index) {
  std::uint64_t z = seed + (index + 1) * 0x9e3779b97f4a7c15u;
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return static_cast<double>((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

}  // namespace armlab
