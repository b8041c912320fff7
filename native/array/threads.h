// Shares independent items among threads that live for one call: no pool, no global state, nothing
// to break at a fork.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <system_error>
#include <thread>
#include <vector>

namespace armlab {

constexpr int max_threads = 256;  // what an argument `threads` may be at most

// Calls work(begin, end) for the parts [0, grain), [grain, 2 grain), ... of [0, count), in up to
// `threads` threads, the calling one among them; each takes the next part when it is done with one,
// so that parts may take different times. The parts do not depend on `threads`, nor may what `work`
// does with one: any number of threads gives the same bits. With one thread, or one part, it is a
// single call work(0, count). `work` must not throw, nor touch Python; release the GIL before.
// Choose `grain` for parts of 0.1 ms or more: a thread takes 30 us to start and to join.
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
  } catch (
      const std::system_error &) {  // the system gives no more: go on with those that there are
  }
  take_parts();
  for (std::thread &other : others)
    if (other.joinable()) other.join();
}

}  // namespace armlab
