// Give lists of splats their places in memory, once their lengths are known.
#pragma once

#include <cstdint>

#include "cuda/common/blend.cuh"
#include "cuda/common/short_list.h"

namespace lfgs::cuda {

// Give every list a place, as long as its count says but empty at first, and collect the numbers of the long lists. A
// thread of the launch has a list. The lists of a warp lie side by side in memory, the warps in no particular order.
//
// ranges [lists]: with the count of each list in y on entry, and where it begins in x and y afterwards. total and
// long_count, zero on entry, receive the sum of the counts and how many lists are long; long_lists their numbers.
__device__ inline void place_lists(int64_t lists, uint2* ranges, unsigned long long& total, unsigned& long_count,
                                   uint32_t* long_lists) {
  const int64_t list = int64_t(blockIdx.x) * blockDim.x + threadIdx.x;
  const int lane = threadIdx.x % 32;
  const bool inside = list < lists;
  const unsigned count = inside ? ranges[list].y : 0;

  // Where this list begins among those of the warp, and which lists are long
  const unsigned long long to_here = sum_to_lane<unsigned long long>(count);
  const bool is_long = count > kShortList;
  const unsigned longs = __ballot_sync(~0u, is_long);

  // The last lane asks for memory for all lists of the warp
  unsigned long long first = 0;
  unsigned first_long = 0;
  if (lane == 31 && to_here) first = atomicAdd(&total, to_here);
  if (lane == 31 && longs) first_long = atomicAdd(&long_count, unsigned(__popc(longs)));
  first = __shfl_sync(~0u, first, 31), first_long = __shfl_sync(~0u, first_long, 31);
  if (is_long) long_lists[first_long + __popc(longs & ((1u << lane) - 1))] = uint32_t(list);
  const uint32_t begin = uint32_t(first + to_here - count);  // wraps beyond 2^32: the caller refuses so many
  if (inside) ranges[list] = make_uint2(begin, begin);
}

}  // namespace lfgs::cuda
