// Runs a kernel over a batch, four samples side by side. Threads exist only during a call, so a
// fork cannot break a thread pool or global state.
#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <cstddef>
#include <system_error>
#include <thread>
#include <vector>

#ifdef __SSE2__
#include <emmintrin.h>
#endif

#include "array/lanes.h"

namespace armlab {

// `width` doubles per sample; samples are contiguous.
struct Reading {
  const double *data;
  int width;
};
struct Writing {
  double *data;
  int width;
  bool streams = false;  // bypass the caches; needs even width and 16-byte alignment
};

#ifdef ARMLAB_LANES
// Transfer four samples between rows in memory and `values`, where values[i] holds element i of
// each sample. Blocks of four by four are transposed in registers; the last may overlap its
// predecessor.
typedef double Row __attribute__((vector_size(32), aligned(8)));

#ifdef __clang__
#define ARMLAB_SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define ARMLAB_SHUFFLE(a, b, ...) __builtin_shuffle(a, b, Lanes::Bits{__VA_ARGS__})
#endif

ARMLAB_INLINE void transpose(Lanes (&row)[4]) {
  const Lanes::Doubles low02 = ARMLAB_SHUFFLE(row[0].v, row[2].v, 0, 1, 4, 5);
  const Lanes::Doubles low13 = ARMLAB_SHUFFLE(row[1].v, row[3].v, 0, 1, 4, 5);
  const Lanes::Doubles high02 = ARMLAB_SHUFFLE(row[0].v, row[2].v, 2, 3, 6, 7);
  const Lanes::Doubles high13 = ARMLAB_SHUFFLE(row[1].v, row[3].v, 2, 3, 6, 7);
  row[0] = ARMLAB_SHUFFLE(low02, low13, 0, 4, 2, 6);
  row[1] = ARMLAB_SHUFFLE(low02, low13, 1, 5, 3, 7);
  row[2] = ARMLAB_SHUFFLE(high02, high13, 0, 4, 2, 6);
  row[3] = ARMLAB_SHUFFLE(high02, high13, 1, 5, 3, 7);
}

ARMLAB_INLINE void read_rows(const double *rows, int width, Lanes *values) {
  const auto block = [&](int i) {
    Lanes row[4];
    for (int k = 0; k < 4; ++k) row[k] = *reinterpret_cast<const Row *>(rows + k * width + i);
    transpose(row);
    for (int k = 0; k < 4; ++k) values[i + k] = row[k];
  };
  int i = 0;
  for (; i + 4 <= width; i += 4) block(i);
  if (i < width && width > 4) return block(width - 4);
  for (; i < width; ++i)
    for (int lane = 0; lane < 4; ++lane) values[i].v[lane] = rows[lane * width + i];
}

ARMLAB_INLINE void write_rows(const Lanes *values, int width, double *rows) {
  const auto block = [&](int i) {
    Lanes row[4] = {values[i], values[i + 1], values[i + 2], values[i + 3]};
    transpose(row);
    for (int k = 0; k < 4; ++k) *reinterpret_cast<Row *>(rows + k * width + i) = row[k].v;
  };
  int i = 0;
  for (; i + 4 <= width; i += 4) block(i);
  if (i < width && width > 4) return block(width - 4);
  for (; i < width; ++i)
    for (int lane = 0; lane < 4; ++lane) rows[lane * width + i] = values[i].v[lane];
}

// Variant with streaming stores, for Writing::streams. Inlining it would cost other batches 5 %.
#ifdef __SSE2__
__attribute__((noinline)) inline void stream_rows(const Lanes *values, int width, double *rows) {
  for (int i = 0; i < width; i += 2)
    for (int lane = 0; lane < 4; lane += 2) {
      const __m128d a{values[i].v[lane], values[i].v[lane + 1]},
          b{values[i + 1].v[lane], values[i + 1].v[lane + 1]};
      _mm_stream_pd(rows + lane * width + i, _mm_unpacklo_pd(a, b));
      _mm_stream_pd(rows + (lane + 1) * width + i, _mm_unpackhi_pd(a, b));
    }
}
inline void end_stream() { _mm_sfence(); }
#else
ARMLAB_INLINE void stream_rows(const Lanes *values, int width, double *rows) {
  write_rows(values, width, rows);
}
inline void end_stream() {}
#endif
#endif

#ifdef ARMLAB_LANES
template <std::size_t Ins, std::size_t Outs, class Kernel>
void four_samples(std::ptrdiff_t count, const std::array<Reading, Ins> &ins,
    const std::array<Writing, Outs> &outs, Kernel &kernel) {
  constexpr int width = Lanes::width;
  std::size_t total = 0;
  for (const Reading &in : ins) total += in.width;
  for (const Writing &out : outs) total += out.width;
  std::vector<Lanes> scratch(total);
  std::array<Lanes *, Ins> in;
  std::array<Lanes *, Outs> out;
  Lanes *next = scratch.data();
  for (std::size_t k = 0; k < Ins; ++k, next += ins[k - 1].width) in[k] = next;
  for (std::size_t k = 0; k < Outs; ++k, next += outs[k - 1].width) out[k] = next;

  for (std::ptrdiff_t sample = 0; sample < count; sample += width) {
    if (sample > count - width) sample = count - width;  // the last four, with repetition
    for (std::size_t k = 0; k < Ins; ++k)
      read_rows(ins[k].data + sample * ins[k].width, ins[k].width, in[k]);
    kernel(in, out);
    for (std::size_t k = 0; k < Outs; ++k) {
      double *rows = outs[k].data + sample * outs[k].width;
      outs[k].streams ? stream_rows(out[k], outs[k].width, rows)
                      : write_rows(out[k], outs[k].width, rows);
    }
  }
  end_stream();
}

#ifdef ARMLAB_DISPATCH
template <std::size_t Ins, std::size_t Outs, class Kernel>
__attribute__((target("avx2"), flatten)) void four_by_avx2(std::ptrdiff_t count,
    const std::array<Reading, Ins> &ins, const std::array<Writing, Outs> &outs, Kernel &kernel) {
  four_samples(count, ins, outs, kernel);
}

template <std::size_t Ins, std::size_t Outs, class Kernel>
__attribute__((target("avx512vl,avx512dq"), flatten)) void four_by_avx512(std::ptrdiff_t count,
    const std::array<Reading, Ins> &ins, const std::array<Writing, Outs> &outs, Kernel &kernel) {
  four_samples(count, ins, outs, kernel);
}
#endif
#endif

// Runs kernel(in, out), where in[k] and out[k] point to the values of one sample, as `const Real *`
// and `Real *`. It may process a sample twice. Single samples, and all samples on an x86-64 without
// AVX2, use code for the baseline instruction set. Compiling that code for each instruction set
// would take a third longer and make a single call at most 15 % faster.
template <std::size_t Ins, std::size_t Outs, class Kernel>
void run_batch(std::ptrdiff_t count, const std::array<Reading, Ins> &ins,
    const std::array<Writing, Outs> &outs, Kernel kernel) {
#ifdef ARMLAB_DISPATCH
  if (count >= Lanes::width && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512dq"))
    return four_by_avx512(count, ins, outs, kernel);
  if (count >= Lanes::width && __builtin_cpu_supports("avx2"))
    return four_by_avx2(count, ins, outs, kernel);
#elif defined(ARMLAB_LANES)
  if (count >= Lanes::width) return four_samples(count, ins, outs, kernel);
#endif
  for (std::ptrdiff_t sample = 0; sample < count; ++sample) {
    std::array<const double *, Ins> in;
    std::array<double *, Outs> out;
    for (std::size_t k = 0; k < Ins; ++k) in[k] = ins[k].data + sample * ins[k].width;
    for (std::size_t k = 0; k < Outs; ++k) out[k] = outs[k].data + sample * outs[k].width;
    kernel(in, out);
  }
}

constexpr int max_threads = 256;  // upper limit of the argument `threads`

// Calls work(begin, end) for the parts [0, grain), [grain, 2 grain), ... of [0, count), in up to
// `threads` threads including the calling one; each thread takes the next part when it is free.
// Parts do not depend on `threads`, so the results are bit-identical for any number of threads.
// With one thread or one part, the only call is work(0, count). `work` must not throw or use
// Python; release the GIL first. Choose `grain` for parts of at least 0.1 ms: starting and joining
// a thread takes 30 us.
template <class Work>
void run_parallel(std::ptrdiff_t count, std::ptrdiff_t grain, int threads, const Work &work) {
  const std::ptrdiff_t parts = (count + grain - 1) / grain;
  if (threads <= 1 || parts <= 1) return work(std::ptrdiff_t{0}, count);
  std::atomic<std::ptrdiff_t> next{0};
  const auto take_parts = [&]() noexcept {
    for (std::ptrdiff_t part; (part = next.fetch_add(1, std::memory_order_relaxed)) < parts;)
      work(part * grain, std::min(count, (part + 1) * grain));
  };
  std::vector<std::thread> others(std::min<std::ptrdiff_t>(threads, parts) - 1);
  try {
    for (std::thread &other : others) other = std::thread(take_parts);
  } catch (const std::system_error &) {
    // no more threads are available: continue with those already running
  }
  take_parts();
  for (std::thread &other : others)
    if (other.joinable()) other.join();
}

}  // namespace armlab
