// Lay several arrays out in one buffer.
#pragma once

#include <cstddef>
#include <cstdint>

namespace lfgs::cuda {

// Hand out aligned parts of one buffer. When the buffer is null it only counts how long it must be.
struct Parts {
  char* base;
  size_t used = 0;

  template <class T>
  void take(T*& part, int64_t count) {
    used = (used + 255) / 256 * 256;
    part = reinterpret_cast<T*>(base ? base + used : nullptr);
    used += size_t(count) * sizeof(T);
  }
};

}  // namespace lfgs::cuda
