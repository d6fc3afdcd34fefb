// Stage order of a light-field frame: every list by depth, nearest first, ties by number.
//
// Short lists are sorted by a warp each, long ones by a block, which goes through those beyond what it keeps in shared
// memory piece by piece. All by bitonic merging (Batcher 1968, "Sorting networks and their applications"), in the form
// in which every comparison sorts upwards: what lies beyond a list's end then counts as the largest, and needs no place.
#include "cuda/check.h"
#include "cuda/lens_frame.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / 32;
constexpr unsigned kKept = kWarps * kShortList;  // keys in shared memory: of a long list's piece, or of a list a warp

// Who sorts a list.
struct Warp {
  static constexpr unsigned kSize = 32;
  __device__ static unsigned rank() { return threadIdx.x % 32; }
  __device__ static void wait() { __syncwarp(); }
};
struct Block {
  static constexpr unsigned kSize = kThreads;
  __device__ static unsigned rank() { return threadIdx.x; }
  __device__ static void wait() { __syncthreads(); }
};

enum class Partner { kMirrored, kSame };  // of a key in the first half: as far from the end, or from the beginning

// Of every 2 * half keys: compares those of the first half with those of the second.
template <class Team, Partner partner>
__device__ void compare_halves(uint64_t* keys, unsigned count, unsigned half) {
  const unsigned pairs = (count + 2 * half - 1) / (2 * half) * half;
  for (unsigned pair = Team::rank(); pair < pairs; pair += Team::kSize) {
    const unsigned at = pair & (half - 1), first = 2 * (pair - at), low = first + at;
    const unsigned high = partner == Partner::kMirrored ? first + 2 * half - 1 - at : low + half;
    if (high >= count) continue;
    const uint64_t a = keys[low], b = keys[high];
    if (b < a) keys[low] = b, keys[high] = a;
  }
  Team::wait();
}

// Sorts runs of 2 * half keys that merging has sorted to within `half`.
template <class Team>
__device__ void finish_runs(uint64_t* keys, unsigned count, unsigned half) {
  for (; half > 0; half /= 2) compare_halves<Team, Partner::kSame>(keys, count, half);
}

template <class Team>
__device__ void sort_kept(uint64_t* keys, unsigned count) {
  for (unsigned run = 1; run < count; run *= 2) {
    compare_halves<Team, Partner::kMirrored>(keys, count, run);
    finish_runs<Team>(keys, count, run / 2);
  }
}

// Brings keys to shared memory, has them sorted, stores the numbers of their splats and, if asked, the keys.
template <class Team, class Sort>
__device__ void in_shared_memory(uint64_t* keys, uint32_t* ids, unsigned count, bool keep_keys, uint64_t* kept,
                                 const Sort& sort) {
  for (unsigned i = Team::rank(); i < count; i += Team::kSize) kept[i] = keys[i];
  Team::wait();
  sort(kept, count);
  for (unsigned i = Team::rank(); i < count; i += Team::kSize) {
    ids[i] = uint32_t(kept[i]);
    if (keep_keys) keys[i] = kept[i];
  }
  Team::wait();
}

// By a block. A list of n keys beyond those kept takes log2(n / kept)^2 / 2 rounds through memory.
__device__ void sort_long(uint64_t* keys, uint32_t* ids, unsigned count, uint64_t* kept) {
  auto in_pieces = [&](auto sort) {
    for (unsigned first = 0; first < count; first += kKept)
      in_shared_memory<Block>(keys + first, ids + first, min(kKept, count - first), count > kKept, kept, sort);
  };
  in_pieces(sort_kept<Block>);
  for (unsigned run = kKept; run < count; run *= 2) {
    compare_halves<Block, Partner::kMirrored>(keys, count, run);
    for (unsigned half = run / 2; half >= kKept; half /= 2)
      compare_halves<Block, Partner::kSame>(keys, count, half);
    in_pieces([](uint64_t* piece, unsigned n) { finish_runs<Block>(piece, n, kKept / 2); });
  }
}

// The first `long_blocks` blocks sort long lists, the others a short one by each warp.
__global__ void __launch_bounds__(kThreads)
    sort_lists_kernel(const __grid_constant__ LensFrame frame, unsigned long_blocks) {
  __shared__ uint64_t kept[kKept];
  const FrameState& state = *frame.state;
  if (frame.overfull()) {
    if (blockIdx.x == 0) sort_long(frame.keys, frame.ids, state.drawn, kept);
    return;
  }
  const uint2* ranges = reinterpret_cast<const uint2*>(frame.ranges);
  if (blockIdx.x < long_blocks) {
    for (unsigned i = blockIdx.x; i < state.long_lists; i += long_blocks) {
      const uint2 range = ranges[frame.long_lists[i]];
      sort_long(frame.keys + range.x, frame.ids + range.x, range.y - range.x, kept);
    }
    return;
  }
  const unsigned warp = threadIdx.x / 32;
  const int64_t list = int64_t(blockIdx.x - long_blocks) * kWarps + warp;
  if (list >= frame.tiling().tiles()) return;
  const uint2 range = ranges[list];
  if (range.y - range.x <= kShortList)
    in_shared_memory<Warp>(frame.keys + range.x, frame.ids + range.x, range.y - range.x, false,
                           kept + warp * kShortList, sort_kept<Warp>);
}

}  // namespace

void frame_order(const LensFrame& frame, Stream stream) {
  if (frame.splats.count == 0) return;
  const unsigned long_blocks = resident_blocks(sort_lists_kernel, kThreads, 0);
  const unsigned blocks = long_blocks + unsigned(blocks_for(frame.most_tiles(), kWarps));
  sort_lists_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(frame, long_blocks);
  check_launch("order");
}

}  // namespace lfgs::cuda
