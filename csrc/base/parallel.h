// A parallel for over independent work items. Results never depend on the number of threads: each item writes its own
// outputs, and `worker` only selects scratch memory.
#pragma once

#include <cstdint>
#include <functional>

namespace lfgs {

// Call body(item, worker) for item in [0, items), worker in [0, threads). Items are handed out in order. The first
// exception that a body throws is rethrown here after all threads have stopped.
void parallel_for(int64_t items, int threads, const std::function<void(int64_t item, int worker)>& body);

// The same over contiguous chunks of `grain` items: body(begin, end, worker).
void parallel_for_chunks(int64_t items, int64_t grain, int threads,
                         const std::function<void(int64_t begin, int64_t end, int worker)>& body);

}  // namespace lfgs
