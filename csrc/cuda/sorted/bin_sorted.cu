// Stage count, fill and order of `sorted` on the device: list, for every (view, tile), the splats that may touch the
// tile, nearest first. They read the projected splats, and write SortedChunk::ranges and ids.
#include <algorithm>

#include "cuda/common/launch.h"
#include "cuda/common/splat_lists.cuh"
#include "cuda/sorted/footprint_io.cuh"
#include "cuda/sorted/sorted.h"
#include "cuda/stages/tile_rows.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kManyRows = 8;  // of tiles: a splat that may touch more is shared by the lanes of a warp

// The two passes over the intersections. kCount counts them, in the place of the ends of the lists, and kFill fills the
// lists.
enum class Pass { kCount, kFill };

// Add a splat to one list.
__device__ void add(const SortedChunk& chunk, Pass pass, unsigned list, uint32_t id) {
  const unsigned place = atomicAdd(&reinterpret_cast<uint2*>(chunk.ranges)[list].y, 1u);
  if (pass == Pass::kFill) chunk.ids[place] = id;
}

// Add the splats of a warp's lanes to a list each, lanes with `some` only. Splats that are neighbours mostly go to the
// same list, for which one lane asks then.
__device__ void add_together(const SortedChunk& chunk, Pass pass, bool some, unsigned list, uint32_t id) {
  const unsigned lane = threadIdx.x % 32, none = ~0u;
  const unsigned peers = __match_any_sync(~0u, some ? list : none);
  const int leader = __ffs(int(peers)) - 1;
  unsigned place = 0;
  if (some && int(lane) == leader)
    place = atomicAdd(&reinterpret_cast<uint2*>(chunk.ranges)[list].y, unsigned(__popc(peers)));
  if (pass == Pass::kCount) return;
  place = __shfl_sync(~0u, place, leader) + __popc(peers & ((1u << lane) - 1));
  if (some) chunk.ids[place] = id;
}

// Go through the intersections. A thread has a splat at a time, and adds its tiles one after the other. A warp shares
// the work for a large splat, a row of tiles a lane. One kernel does both passes, so that they find the same tiles to
// the last bit.
__global__ void __launch_bounds__(kThreads) intersections_kernel(const __grid_constant__ SortedChunk chunk, Pass pass) {
  const int lane = threadIdx.x % 32;
  const int64_t splats = chunk.image.count * chunk.count, step = int64_t(gridDim.x) * kThreads;
  const unsigned tiles = unsigned(chunk.tiles()), per_view = unsigned(chunk.count);
  unsigned drawn = 0;
  for (int64_t first = int64_t(blockIdx.x) * kThreads + threadIdx.x - lane; first < splats; first += step) {
    const uint32_t id = uint32_t(first) + lane;
    Splat<float> splat{};
    splat.reach_y = kNotSeen;
    if (id < splats) splat = read_footprint(chunk.footprints, id);
    const TileRows rows(splat, chunk.image);
    const bool large = rows.last - rows.first >= kManyRows;
    drawn += splat.reach_y >= 0;

    unsigned list = 0;  // of which `left` in a row are still to be added to
    int row = large ? rows.last + 1 : rows.first, left = 0;
    const unsigned first_list = id / per_view * tiles;
    for (;;) {
      while (left == 0 && row <= rows.last) {
        int tile = 0;
        left = rows.tiles_in(row++, tile), list = first_list + tile;
      }
      if (!__any_sync(~0u, left > 0)) break;
      add_together(chunk, pass, left > 0, list, id);
      if (left > 0) --left, ++list;
    }

    for (unsigned todo = __ballot_sync(~0u, large); todo; todo &= todo - 1) {
      const uint32_t shared_id = uint32_t(first) + __ffs(int(todo)) - 1;
      const Splat<float> shared = read_footprint(chunk.footprints, shared_id);
      const TileRows all(shared, chunk.image);
      for (int mine = all.first + lane; mine <= all.last; mine += 32) {
        int tile = 0;
        const int count = all.tiles_in(mine, tile);
        for (int k = 0; k < count; ++k) add(chunk, pass, shared_id / per_view * tiles + tile + k, shared_id);
      }
    }
  }
  const unsigned of_warp = pass == Pass::kCount ? sum_to_lane(drawn) : 0;
  if (lane == 31 && of_warp) atomicAdd(&chunk.state->drawn, of_warp);
}

// A thread has a list.
__global__ void __launch_bounds__(kThreads) place_lists_kernel(const __grid_constant__ SortedChunk chunk) {
  SortedState& state = *chunk.state;
  place_lists(chunk.lists(), reinterpret_cast<uint2*>(chunk.ranges), state.intersections, state.long_lists,
              chunk.long_lists);
}

__global__ void __launch_bounds__(sorting::kThreads, 4) sort_lists_kernel(const __grid_constant__ SortedChunk chunk) {
  __shared__ uint64_t keys[sorting::kKept];
  __shared__ unsigned buckets[sorting::kKept], warps[2 * sorting::kWarps];
  const uint2* ranges = reinterpret_cast<const uint2*>(chunk.ranges);
  sorting::sort_lists({chunk.lists(), ranges, chunk.ids, chunk.depths, chunk.long_lists, chunk.state->long_lists},
                      {keys, buckets, warps});
}

// Blocks for items that each of the device's resident blocks takes in turn.
template <class Kernel>
unsigned blocks_in_turn(Kernel kernel, int threads, int64_t items, int64_t per_block) {
  return unsigned(std::min<int64_t>(resident_blocks(kernel, threads, 0), blocks_for(items, per_block)));
}

void visit_intersections(const SortedChunk& chunk, Pass pass, Stream stream) {
  const unsigned blocks = blocks_in_turn(intersections_kernel, kThreads, chunk.splats(), kThreads);
  intersections_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(chunk, pass);
  check_launch("bin_sorted: intersections");
}

}  // namespace

void count_sorted(const SortedChunk& chunk, Stream stream) {
  check(cudaMemsetAsync(chunk.state, 0, chunk.cleared_bytes, cudaStream_t(stream)), "bin_sorted: clear");
  if (chunk.splats() == 0) return;
  visit_intersections(chunk, Pass::kCount, stream);
  const unsigned blocks = unsigned(blocks_for(chunk.lists(), kThreads));
  place_lists_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(chunk);
  check_launch("bin_sorted: place");
}

void fill_sorted(const SortedChunk& chunk, Stream stream) {
  if (chunk.splats() > 0) visit_intersections(chunk, Pass::kFill, stream);
}

void order_sorted(const SortedChunk& chunk, Stream stream) {
  if (chunk.splats() == 0) return;
  const unsigned blocks = blocks_in_turn(sort_lists_kernel, sorting::kThreads, chunk.lists(), sorting::kWarps);
  sort_lists_kernel<<<blocks, sorting::kThreads, 0, cudaStream_t(stream)>>>(chunk);
  check_launch("bin_sorted: order");
}

}  // namespace lfgs::cuda
