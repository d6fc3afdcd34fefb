// Sums over pieces of work that blocks take in order, in one pass: decoupled look-back (Merrill & Garland 2016,
// "Single-pass parallel prefix scan with decoupled look-back").
//
// A piece has a word: its number, or that of all pieces up to it, above a flag; 0 as long as neither is known. Who has
// read a word reads nothing else that its writer wrote, so accesses need no order, only to be whole: volatile ones of 8
// bytes are, and go past the L1. A block takes pieces in turn from an atomic counter: who has a lower one is running.
#pragma once

#include <cstdint>

namespace lfgs::cuda {

constexpr uint64_t kFlags = 3, kOfPiece = 1, kOfAll = 2;
constexpr int kFlagBits = 2;

__device__ inline uint64_t flagged(int64_t number, uint64_t flag) { return uint64_t(number) << kFlagBits | flag; }

// The sum over all pieces before this one, by one warp: 32 words at a time, back to the nearest that has all.
__device__ inline int64_t sum_before(const volatile uint64_t* words, int64_t piece) {
  const int lane = threadIdx.x % 32;
  int64_t sum = 0;
  for (unsigned found = 0; !found; piece -= 32) {
    const int64_t at = piece - 1 - lane;
    uint64_t word;
    unsigned needed;
    do {
      word = at < 0 ? kOfAll : words[at];
      found = __ballot_sync(~0u, (word & kFlags) == kOfAll);
      needed = found ^ (found - 1);  // up to the lowest bit, or all
    } while (__ballot_sync(~0u, (word & kFlags) == 0) & needed);
    if (needed >> lane & 1) sum += int64_t(word >> kFlagBits);
  }
  for (int step = 16; step > 0; step /= 2) sum += __shfl_xor_sync(~0u, sum, step);
  return sum;
}

// The sum of the values of a warp's lanes, up to one's own.
__device__ inline int64_t sum_to_lane(int64_t value) {
  for (int step = 1; step < 32; step *= 2) {
    const int64_t other = __shfl_up_sync(~0u, value, step);
    if (int(threadIdx.x % 32) >= step) value += other;
  }
  return value;
}

}  // namespace lfgs::cuda
