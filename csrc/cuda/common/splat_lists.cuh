// Lists of splats on the device: place them in memory, and sort every list by depth, nearest first, ties by number.
//
// To be sorted, a list is spread over buckets of depth, mostly of a splat or two each. Within a bucket every splat
// counts the splats before it, which gives its place. Where depths crowd, or the list does not fit shared memory,
// bitonic merging sorts it (Batcher 1968, "Sorting networks and their applications"). Every comparison sorts upwards:
// items beyond the end count as the largest, and need no memory. A team sorts a list: a warp for a short one, a block
// for a long one.
#pragma once

#include <cstdint>

#include "cuda/common/blend.cuh"

namespace lfgs::cuda {

constexpr unsigned kShortList = 256;  // the longest list that a warp sorts; longer ones are left to blocks

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

namespace sorting {

constexpr int kThreads = 256, kWarps = kThreads / 32;
constexpr unsigned kEach = kShortList / 32;   // how many keys, and how many buckets, a thread has
constexpr unsigned kKept = kThreads * kEach;  // keys that shared memory holds: those of a block, or of all its warps
constexpr unsigned kCrowd = 16;               // the most keys of a bucket: each of them looks at all of them

// The teams. rank() is a thread's number in its team.
struct Warp {
  static constexpr unsigned kSize = 32;
  __device__ static unsigned rank() { return threadIdx.x % 32; }
  __device__ static void wait() { __syncwarp(); }
  __device__ static bool any(bool value) {
    wait();  // a vote does not order accesses to memory
    return __any_sync(~0u, value);
  }
};
struct Block {
  static constexpr unsigned kSize = kThreads;
  __device__ static unsigned rank() { return threadIdx.x; }
  __device__ static void wait() { __syncthreads(); }
  __device__ static bool any(bool value) { return __syncthreads_or(value); }
};

// The shared memory of a team.
struct Memory {
  uint64_t* keys;     // [kEach * kSize]
  unsigned* buckets;  // [kEach * kSize]
  unsigned* warps;    // [2 * kWarps], for a block only
};

// The sort key: depth, which is positive, then number.
struct Keys {
  const uint32_t* depths;
  __device__ uint64_t operator()(uint32_t id) const { return uint64_t(depths[id]) << 32 | id; }
};
// For items that are keys themselves.
struct Same {
  __device__ uint64_t operator()(uint64_t key) const { return key; }
};

// Do one step of bitonic merging. In every 2 * half items, compare each of the first half with one of the second, and
// put the smaller first. Its partner is `half` items on, or when mirrored, the one that is as far from the end as it is
// from the beginning. A thread of the team has every kSize-th comparison.
template <class Team, class Item, class ToKey = Same>
__device__ void compare_halves(Item* items, unsigned count, unsigned half, bool mirrored, const ToKey& key = {}) {
  const unsigned pairs = (count + 2 * half - 1) / (2 * half) * half, partner = mirrored ? 2 * half - 1 : half;
  for (unsigned pair = Team::rank(); pair < pairs; pair += Team::kSize) {
    const unsigned low = pair + (pair & ~(half - 1)), high = low ^ partner;
    if (high >= count) continue;
    const Item a = items[low], b = items[high];
    if (key(b) < key(a)) items[low] = b, items[high] = a;
  }
  Team::wait();
}

// Ends the merging of runs: does the steps of this and all smaller halves.
template <class Team>
__device__ void finish_runs(uint64_t* keys, unsigned count, unsigned half) {
  for (; half > 0; half /= 2) compare_halves<Team>(keys, count, half, false);
}

// Sort keys by merging, from runs of one key up.
template <class Team>
__device__ void merge_all(uint64_t* keys, unsigned count) {
  for (unsigned run = 1; run < count; run *= 2) {
    compare_halves<Team>(keys, count, run, true);
    finish_runs<Team>(keys, count, run / 2);
  }
}

// Call sort(kept, count) with the keys of a list in shared memory, and write their order back.
template <class Team, class Sort>
__device__ void in_shared_memory(uint32_t* ids, unsigned count, const Keys& key, uint64_t* kept, const Sort& sort) {
  for (unsigned i = Team::rank(); i < count; i += Team::kSize) kept[i] = key(ids[i]);
  Team::wait();
  sort(kept, count);
  for (unsigned i = Team::rank(); i < count; i += Team::kSize) ids[i] = uint32_t(kept[i]);
  Team::wait();
}

// Sort a list that is too long for shared memory, by all threads of a block. Pieces that fit are sorted there; longer
// steps run in the list itself. A list of n keys takes log2(n / kKept)^2 / 2 rounds through memory.
__device__ inline void sort_in_pieces(uint32_t* ids, unsigned count, const Keys& key, uint64_t* kept) {
  auto in_pieces = [&](auto sort) {
    for (unsigned first = 0; first < count; first += kKept)
      in_shared_memory<Block>(ids + first, min(kKept, count - first), key, kept, sort);
  };
  in_pieces(merge_all<Block>);
  for (unsigned run = kKept; run < count; run *= 2) {
    compare_halves<Block>(ids, count, run, true, key);
    for (unsigned half = run / 2; half >= kKept; half /= 2) compare_halves<Block>(ids, count, half, false, key);
    in_pieces([](uint64_t* piece, unsigned n) { finish_runs<Block>(piece, n, kKept / 2); });
  }
}

__device__ inline float to_depth(uint64_t key) { return __uint_as_float(unsigned(key >> 32)); }

// Reduce the least and the largest depth of each thread to those of the team.
template <class Team>
__device__ void find_extent(float& nearest, float& farthest, const Memory& memory) {
  for (int step = 16; step > 0; step /= 2) {
    nearest = fminf(nearest, __shfl_xor_sync(~0u, nearest, step));
    farthest = fmaxf(farthest, __shfl_xor_sync(~0u, farthest, step));
  }
  if constexpr (Team::kSize > 32) {
    float* of_warps = reinterpret_cast<float*>(memory.warps);
    if (threadIdx.x % 32 == 0) of_warps[threadIdx.x / 32] = nearest, of_warps[kWarps + threadIdx.x / 32] = farthest;
    Team::wait();
    for (int warp = 0; warp < kWarps; ++warp)
      nearest = fminf(nearest, of_warps[warp]), farthest = fmaxf(farthest, of_warps[kWarps + warp]);
  }
  Team::wait();
}

// Turn the number of keys in every bucket into the place where each bucket begins. A thread has kEach buckets in a
// row.
template <class Team>
__device__ void sum_buckets(const Memory& memory) {
  unsigned* mine = memory.buckets + kEach * Team::rank();
  unsigned counts[kEach], sum = 0;
#pragma unroll
  for (unsigned k = 0; k < kEach; ++k) counts[k] = mine[k], sum += counts[k];
  const unsigned to_here = sum_to_lane(sum);
  unsigned first = to_here - sum;
  if constexpr (Team::kSize > 32) {
    if (threadIdx.x % 32 == 31) memory.warps[threadIdx.x / 32] = to_here;
    Team::wait();
    for (unsigned warp = 0; warp < threadIdx.x / 32; ++warp) first += memory.warps[warp];
  }
#pragma unroll
  for (unsigned k = 0; k < kEach; ++k) mine[k] = first, first += counts[k];
  Team::wait();
}

// Sort a list of at most kEach * kSize splats. Return false, and leave the list as it is, where depths crowd.
template <class Team>
__device__ bool sort_by_buckets(uint32_t* ids, unsigned count, const Keys& key, const Memory& memory) {
  constexpr unsigned kBuckets = kEach * Team::kSize, kBucketBits = 16, kBucket = (1u << kBucketBits) - 1;
  uint64_t mine[kEach];
  unsigned bucket[kEach];  // of each key; in the upper bits, its place there

  // Read the keys
  float nearest = INFINITY, farthest = 0;
#pragma unroll
  for (unsigned k = 0; k < kEach; ++k) {
    const unsigned i = k * Team::kSize + Team::rank();
    memory.buckets[i] = 0;
    mine[k] = i < count ? key(ids[i]) : 0;
    if (i < count) nearest = fminf(nearest, to_depth(mine[k])), farthest = fmaxf(farthest, to_depth(mine[k]));
  }

  // Choose their buckets, by equal parts of the depth from the nearest to the farthest
  find_extent<Team>(nearest, farthest, memory);
  const float per_depth = fminf(float(kBuckets) / (farthest - nearest), 3e38f);  // not infinite, if all are alike
  bool crowd = false;
#pragma unroll
  for (unsigned k = 0; k < kEach; ++k) {
    if (k * Team::kSize + Team::rank() >= count) break;
    bucket[k] = min(unsigned((to_depth(mine[k]) - nearest) * per_depth), kBuckets - 1);
    const unsigned place = atomicAdd(&memory.buckets[bucket[k]], 1u);
    crowd |= place >= kCrowd, bucket[k] |= place << kBucketBits;
  }
  if (Team::any(crowd)) return false;

  // Put them into their buckets
  sum_buckets<Team>(memory);
#pragma unroll
  for (unsigned k = 0; k < kEach; ++k) {
    if (k * Team::kSize + Team::rank() >= count) break;
    memory.keys[memory.buckets[bucket[k] & kBucket] + (bucket[k] >> kBucketBits)] = mine[k];
  }
  Team::wait();

  // In each bucket, count the keys before this one
#pragma unroll
  for (unsigned k = 0; k < kEach; ++k) {
    if (k * Team::kSize + Team::rank() >= count) break;
    const unsigned of = bucket[k] & kBucket, first = memory.buckets[of];
    const unsigned end = of + 1 < kBuckets ? memory.buckets[of + 1] : count;
    unsigned before = 0;
    for (unsigned i = first; i < end; ++i) before += memory.keys[i] < mine[k];
    ids[first + before] = uint32_t(mine[k]);
  }
  Team::wait();
  return true;
}

// Sort a list that fits the team's shared memory.
template <class Team>
__device__ void sort_kept(uint32_t* ids, unsigned count, const Keys& key, const Memory& memory) {
  if (!sort_by_buckets<Team>(ids, count, key, memory))
    in_shared_memory<Team>(ids, count, key, memory.keys, merge_all<Team>);
}

// Lists of splats, and where their depths are.
struct SplatLists {
  int64_t count;
  const uint2* ranges;         // [count]: first and end of every list among the ids
  uint32_t* ids;               // the splats of all lists
  const uint32_t* depths;      // of every splat, the bits of its depth
  const uint32_t* long_lists;  // the numbers of the lists with more than kShortList splats
  unsigned long_count;
};

// Sort all lists, by all blocks of a launch: first every block takes long ones, then every warp short ones.
__device__ inline void sort_lists(const SplatLists& lists, const Memory& memory) {
  const Keys key{lists.depths};
  for (unsigned i = blockIdx.x; i < lists.long_count; i += gridDim.x) {
    const uint2 range = lists.ranges[lists.long_lists[i]];
    const unsigned count = range.y - range.x;
    if (count <= kKept)
      sort_kept<Block>(lists.ids + range.x, count, key, memory);
    else
      sort_in_pieces(lists.ids + range.x, count, key, memory.keys);
  }

  const unsigned warp = threadIdx.x / 32, mine = warp * kShortList;
  const int64_t step = int64_t(gridDim.x) * kWarps;
  for (int64_t list = int64_t(blockIdx.x) * kWarps + warp; list < lists.count; list += step) {
    const uint2 range = lists.ranges[list];
    const unsigned count = range.y - range.x;
    if (count > 0 && count <= kShortList)
      sort_kept<Warp>(lists.ids + range.x, count, key, {memory.keys + mine, memory.buckets + mine, nullptr});
  }
}

}  // namespace sorting
}  // namespace lfgs::cuda
