// Work items are handed out by a counter that all threads share.
#include "base/parallel.h"

#include <algorithm>
#include <atomic>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace lfgs {

void parallel_for(int64_t items, int threads, const std::function<void(int64_t, int)>& body) {
  std::atomic<int64_t> next{0};
  std::exception_ptr failure;
  std::mutex failure_mutex;

  // The loop of every thread; the first failure ends the work of all
  auto work = [&](int worker) {
    try {
      for (int64_t item = next++; item < items; item = next++) body(item, worker);
    } catch (...) {
      next = items;
      std::lock_guard<std::mutex> lock(failure_mutex);
      if (!failure) failure = std::current_exception();
    }
  };

  // The calling thread is worker 0
  int64_t helpers = std::min<int64_t>(threads, items) - 1;
  std::vector<std::thread> pool;
  pool.reserve(size_t(std::max<int64_t>(helpers, 0)));
  try {
    for (int64_t i = 0; i < helpers; ++i) pool.emplace_back(work, int(i + 1));
  } catch (const std::system_error&) {  // no more threads can be had: the running ones do all items
  }
  work(0);
  for (auto& thread : pool) thread.join();
  if (failure) std::rethrow_exception(failure);
}

void parallel_for_chunks(int64_t items, int64_t grain, int threads,
                         const std::function<void(int64_t, int64_t, int)>& body) {
  int64_t chunks = (items + grain - 1) / grain;
  parallel_for(chunks, threads,
               [&](int64_t chunk, int worker) { body(chunk * grain, std::min(items, (chunk + 1) * grain), worker); });
}

}  // namespace lfgs
