// Runs a kernel over the samples of a batch: four samples side by side, the last few one by one.
#pragma once

#include <array>
#include <cstddef>
#include <vector>

#include "lanes.h"

namespace armlab {

// `width` doubles per sample, samples one after the other.
struct Reading {
  const double *data;
  int width;
};
struct Writing {
  double *data;
  int width;
};

// kernel(in, out) with in[k] and out[k] pointing to the values of one sample: `const Real *` and `Real *`.
template <std::size_t Ins, std::size_t Outs, class Kernel>
ARMLAB_VECTORISED void run_batch(std::ptrdiff_t count, const std::array<Reading, Ins> &ins,
                                 const std::array<Writing, Outs> &outs, Kernel kernel) {
  constexpr int width = Lanes::width;
  std::ptrdiff_t sample = 0;
  if (count >= width) {
    std::size_t total = 0;
    for (const Reading &in : ins) total += in.width;
    for (const Writing &out : outs) total += out.width;
    std::vector<Lanes> scratch(total);
    std::array<Lanes *, Ins> in;
    std::array<Lanes *, Outs> out;
    Lanes *next = scratch.data();
    for (std::size_t k = 0; k < Ins; ++k, next += ins[k - 1].width) in[k] = next;
    for (std::size_t k = 0; k < Outs; ++k, next += outs[k - 1].width) out[k] = next;

    for (; sample + width <= count; sample += width) {
      for (std::size_t k = 0; k < Ins; ++k)
        for (int i = 0; i < ins[k].width; ++i)
          for (int lane = 0; lane < width; ++lane) in[k][i].v[lane] = ins[k].data[(sample + lane) * ins[k].width + i];
      kernel(in, out);
      for (std::size_t k = 0; k < Outs; ++k)
        for (int lane = 0; lane < width; ++lane) {
          double *row = outs[k].data + (sample + lane) * outs[k].width;
          for (int i = 0; i < outs[k].width; ++i) row[i] = out[k][i].v[lane];
        }
    }
  }
  for (; sample < count; ++sample) {
    std::array<const double *, Ins> in;
    std::array<double *, Outs> out;
    for (std::size_t k = 0; k < Ins; ++k) in[k] = ins[k].data + sample * ins[k].width;
    for (std::size_t k = 0; k < Outs; ++k) out[k] = outs[k].data + sample * outs[k].width;
    kernel(in, out);
  }
}

}  // namespace armlab
