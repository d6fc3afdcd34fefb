// Bits that several threads write one after the other into one stream.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

namespace lfgs::cuda {

// Write bits from some place of the stream on, the lowest first. The stream is zero before; words at the ends of what
// a thread writes belong to its neighbours too.
class BitWriter {
 public:
  __device__ BitWriter(uint32_t* stream, unsigned long long bit) : word_(stream + bit / 32), filled_(int(bit % 32)) {}

  // count: at most 32.
  __device__ void put(uint32_t bits, int count) {
    waiting_ |= uint64_t(bits) << filled_, filled_ += count;
    if (filled_ < 32) return;
    if (shared_)
      atomicOr(word_++, uint32_t(waiting_));
    else
      *word_++ = uint32_t(waiting_);
    shared_ = false, waiting_ >>= 32, filled_ -= 32;
  }
  __device__ void finish() {
    if (waiting_ != 0) atomicOr(word_, uint32_t(waiting_));
  }

 private:
  uint32_t* word_;
  uint64_t waiting_ = 0;
  int filled_;
  bool shared_ = true;
};

}  // namespace lfgs::cuda
