// Stage composite on the device for sub-pixels sorted by view, where each view is an ordinary camera. It reads the
// splats, the lists of every (view, tile) and the lists of sub-pixels, and writes those sub-pixels of the image.
//
// A block has the sub-pixels of one view in one tile. A group of its lanes has 32 of them, kEach a lane. They lie close
// together, since the lists run along the columns. So a group first lists the splats that may touch the box around its
// sub-pixels, and then blends only those. Several groups share a warp, each with its own intersections. A splat that is
// read serves kEach sub-pixels of a lane, and the box is no larger.
#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/sorted/sorted.h"

namespace lfgs::cuda {
namespace {

constexpr int kSubpixels = 256, kEach = 2;  // drawn at a time by a block, and by a lane
constexpr int kThreads = kSubpixels / kEach, kGroups = kSubpixels / kSubpixelBlock;
constexpr int kLanes = kSubpixelBlock / kEach;  // of a group
constexpr int kStaged = 256;                    // splats that a block keeps at a time
constexpr int kAtATime = 4;                     // splats that are blended between two looks at the limit
constexpr int kResident = 9;                    // blocks for which a Hopper multiprocessor has shared memory
constexpr float kNone = -1e9f;                  // log2 opacity of a splat that touches nothing
static_assert(32 % kLanes == 0 && kThreads % kLanes == 0);

// A splat as the sub-pixels of a tile read it.
struct Staged {
  // From the tile's corner (0, 0), in units in which the exponent of the weight is -(across^2 + down^2)
  float across_x, across_y, across_0;  // across = across_x x + across_y y + across_0
  float down_y, down_0;                // down = down_y y + down_0
  float log2_opacity;
  float colours[6];  // by channel; the rest fills up to 16 bytes

  __device__ float across(float x, float y) const { return fmaf(across_y, y, fmaf(across_x, x, across_0)); }
  __device__ float down(float y) const { return fmaf(down_y, y, down_0); }
  // log2 of opacity * weight at a sub-pixel.
  __device__ float power(float x, float y) const {
    const float a = across(x, y), d = down(y);
    return fmaf(-a, a, fmaf(-d, d, log2_opacity));
  }
};

// A batch of splats of a block. Behind the splats is one that touches nothing, in the colours of the background. Each
// group has the numbers of the splats that it blends.
struct alignas(16) Batch {
  Staged splats[kStaged + 1];
  ushort4 intersections[kGroups][kStaged / kAtATime];
};

// The box around the sub-pixels of a group: middle and half size.
struct Box {
  float x, y, half_x, half_y;

  // Whether the alpha of a splat may be above the opacity cut somewhere in the box; it errs on the wide side.
  __device__ bool meets(const Staged& s) const {
    const float down = fmaxf(fabsf(s.down(y)) - s.down_y * half_y, 0.f);
    const float exponent = s.log2_opacity - down * down + float(1e-3 - kLog2MinAlpha);
    const float reach = s.across_x * (half_x + 0.01f) + fabsf(s.across_y) * half_y;
    const float across = fmaxf(fabsf(s.across(x, y)) - reach, 0.f);
    return across * across <= exponent;
  }
};

// A sub-pixel of this thread; `some` is false where it has none.
struct Sample {
  float x = 0, y = 0;  // centre, from the tile's corner
  int channel = 0;
  bool some = false;

  __device__ void read(const SubpixelTile& tile, uint16_t code) {
    some = code != kNoSubpixel;
    const Subpixel s = decode_subpixel(tile, some ? code : 0);
    x = s.column + 0.5f, y = s.row + 0.5f, channel = s.channel;
  }
};

// The box around the samples of this thread's group; where there are none, it meets no splat.
__device__ Box bounding_box(const Sample (&samples)[kEach]) {
  const float far = 1e9f;
  float left = far, right = -far, top = far, bottom = -far;
  for (const Sample& s : samples)
    if (s.some) left = fminf(left, s.x), right = fmaxf(right, s.x), top = fminf(top, s.y), bottom = fmaxf(bottom, s.y);
  for (int step = kLanes / 2; step > 0; step /= 2) {
    left = fminf(left, __shfl_xor_sync(~0u, left, step)), right = fmaxf(right, __shfl_xor_sync(~0u, right, step));
    top = fminf(top, __shfl_xor_sync(~0u, top, step)), bottom = fmaxf(bottom, __shfl_xor_sync(~0u, bottom, step));
  }
  return {(left + right) / 2, (top + bottom) / 2, (right - left) / 2, (bottom - top) / 2};
}

// Read a splat for the tile whose corner is at (x0, y0).
__device__ Staged staged(const SortedChunk& chunk, uint32_t id, float x0, float y0) {
  const float4* footprint = reinterpret_cast<const float4*>(chunk.footprints) + 2 * int64_t(id);
  const float4 place = __ldg(footprint), size = __ldg(footprint + 1);
  const float4 colour = __ldg(reinterpret_cast<const float4*>(chunk.colours) + id);
  const float u0 = place.x - x0, v0 = place.y - y0, c0 = place.z, down_y = fast_sqrt(place.w), across_x = size.y;
  return {across_x,     -across_x * c0, across_x * (c0 * v0 - u0),     down_y,
          -down_y * v0, size.x,         {colour.x, colour.y, colour.z}};
}

// Read `count` splats of a list, up to kStaged, and fill the last group of kLanes up with some that touch nothing. A
// thread reads several before it waits for them.
__device__ void stage(const SortedChunk& chunk, const uint32_t* ids, int count, float x0, float y0, Batch& batch) {
  constexpr int kTogether = 2;
  static_assert(kStaged % (kTogether * kThreads) == 0);
  for (int first = threadIdx.x; first - int(threadIdx.x) < count; first += kTogether * kThreads) {
    Staged mine[kTogether];
    LFGS_UNROLL for (int k = 0; k < kTogether; ++k) {
      const int at = first + k * kThreads;
      mine[k] = staged(chunk, __ldg(ids + min(at, count - 1)), x0, y0);
      if (at >= count) mine[k].log2_opacity = kNone;
    }
    LFGS_UNROLL for (int k = 0; k < kTogether; ++k) batch.splats[first + k * kThreads] = mine[k];
  }
}

// Write the numbers of the batch's splats that may touch the group's box, in order. Pad them with the splat that
// touches nothing, until all groups of the warp have as many. Return how many, a multiple of kAtATime.
__device__ int list_intersections(const Batch& batch, int count, const Box& box, uint16_t* intersections) {
  const int lane = threadIdx.x % kLanes, first_lane = threadIdx.x % 32 - lane;
  const unsigned group = (~0u >> (32 - kLanes)) << first_lane, before = ((1u << lane) - 1) << first_lane;
  int noted = 0;
  for (int first = 0; first < count; first += kLanes) {
    const bool touched = box.meets(batch.splats[first + lane]);
    const unsigned all = __ballot_sync(~0u, touched);
    if (touched) intersections[noted + __popc(all & before)] = uint16_t(first + lane);
    noted += __popc(all & group);
  }
  int most = noted;
  for (int step = kLanes; step < 32; step *= 2) most = max(most, __shfl_xor_sync(~0u, most, step));
  most = int(blocks_for(most, kAtATime)) * kAtATime;
  for (int k = noted + lane; k < most; k += kLanes) intersections[k] = kStaged;
  __syncwarp();
  return most;
}

// The light that a sub-pixel has taken, and where it goes on. It takes splats whose power is at least `least`. That is
// the opacity cut while the sample is open. Afterwards it takes none, since the next splat would leave less than the
// limit of transmittance. The light that is left goes to the background.
struct Light {
  static constexpr float kClosed = 1e30f;
  float value = 0, transmittance = 1, least = kClosed;

  __device__ bool open() const { return least < kClosed; }
  __device__ bool over_limit() const { return transmittance < float(kMinTransmittance); }

  // Blend a splat; as over() in blend.cuh, with fewer steps.
  __device__ void take(float power, float colour) {
    const float weight = fminf(fast_exp2(power), float(kMaxAlpha)) * transmittance, after = transmittance - weight;
    const bool seen = power >= least, full = after < float(kMinTransmittance);
    if (seen && !full) value += weight * colour, transmittance = after;
    if (seen && full) least = kClosed;
  }
  // The same where the limit is known not to be met.
  __device__ void take_freely(float power, float colour) {
    const float weight = fminf(fast_exp2(power), float(kMaxAlpha)) * transmittance;
    if (power >= least) value += weight * colour, transmittance -= weight;
  }
};

// The sub-pixels that a thread draws at a time.
struct Drawing {
  Sample samples[kEach];
  Light lights[kEach];

  __device__ bool any(bool (Light::*is)() const) const {
    bool found = false;
    for (const Light& light : lights) found |= (light.*is)();
    return found;
  }
  __device__ void blend(const Batch& batch, const ushort4& intersections, void (Light::*take)(float, float)) {
    const unsigned numbers[kAtATime] = {intersections.x, intersections.y, intersections.z, intersections.w};
    LFGS_UNROLL for (const unsigned intersection : numbers) {
      const Staged& splat = batch.splats[intersection];
      LFGS_UNROLL for (int k = 0; k < kEach; ++k) {
        const Sample& at = samples[k];
        (lights[k].*take)(splat.power(at.x, at.y), splat.colours[at.channel]);
      }
    }
  }
  // Blend splats as if no sample came to the limit, which saves a third of the steps. Transmittances only fall, so one
  // test after the last splat is enough; if it fails, blend all again with the limit. Return false when no sample of
  // the warp is open any more.
  __device__ bool blend(const Batch& batch, const ushort4& intersections) {
    Drawing before = *this;
    blend(batch, intersections, &Light::take_freely);
    if (!__any_sync(~0u, any(&Light::over_limit))) return true;
    *this = before;
    __syncwarp();  // so that splats are read again: kept, they would take registers all the time
    blend(batch, intersections, &Light::take);
    return __any_sync(~0u, any(&Light::open));
  }
};

// Draw the sub-pixels of one (view, tile), a block each. Blocks that start together have the views of one tile, so
// that what they write, a byte here and there, meets in the cache. For every kSubpixels of them the block stages the
// tile's splats in batches, and each thread blends them into its own. tiles: of a view, `across` of them in a row.
__global__ void __launch_bounds__(kThreads, kResident)
    composite_sorted_kernel(const __grid_constant__ SortedChunk chunk, SubpixelLists lists, unsigned tiles,
                            unsigned across, const float* background, float* out, uint8_t* out8) {
  __shared__ Batch batch;
  const unsigned views = unsigned(chunk.image.count), tile = blockIdx.x / views, row = tile / across;
  const int64_t list = int64_t(blockIdx.x - tile * views) * tiles + tile;
  const int64_t x0 = int64_t(tile - row * across) * lists.tile.width_px, y0 = int64_t(row) * lists.tile.height_px();
  const uint2 range = reinterpret_cast<const uint2*>(chunk.ranges)[list];
  const int64_t last = lists.starts[list + 1];
  const int group = threadIdx.x / kLanes;
  if (threadIdx.x == 0) batch.splats[kStaged] = {0, 0, 0, 0, 0, kNone, {background[0], background[1], background[2]}};

  // A tile has about as many sub-pixels of a view as the block draws at a time, so it takes one round on average
  for (int64_t first = lists.starts[list]; first < last; first += kSubpixels) {
    Drawing mine;
    for (int k = 0; k < kEach; ++k) {
      const int64_t at = first + group * kSubpixelBlock + k * kLanes + threadIdx.x % kLanes;
      mine.samples[k].read(lists.tile, at < last ? lists.codes[at] : kNoSubpixel);
      if (mine.samples[k].some) mine.lights[k].least = float(kLog2MinAlpha);
    }
    const Box box = bounding_box(mine.samples);

    // Go over the list in batches, until no sample takes light any more
    for (unsigned begin = range.x; begin < range.y; begin += kStaged) {
      if (__syncthreads_and(!mine.any(&Light::open))) break;
      const int count = int(min(unsigned(kStaged), range.y - begin));
      stage(chunk, chunk.ids + begin, count, float(x0), float(y0), batch);
      __syncthreads();

      const int noted = list_intersections(batch, count, box, reinterpret_cast<uint16_t*>(batch.intersections[group]));
      for (int k = 0; k < noted; k += kAtATime)
        if (!mine.blend(batch, batch.intersections[group][k / kAtATime])) break;
    }
    __syncthreads();  // before the splats are staged again for the next sub-pixels

    // Add the background by the light that is left, and store
    for (int k = 0; k < kEach; ++k) {
      const Sample& s = mine.samples[k];
      if (!s.some) continue;
      const float colour =
          mine.lights[k].value + mine.lights[k].transmittance * batch.splats[kStaged].colours[s.channel];
      const int64_t place = ((y0 + int(s.y)) * chunk.image.width_px + x0 + int(s.x)) * 3 + s.channel;
      if (out8)
        out8[place] = stored(colour, out8);
      else
        out[place] = stored(colour, out);
    }
  }
}

}  // namespace

void composite_sorted(const SortedChunk& chunk, const SubpixelLists& lists, const float* background, float* out,
                      uint8_t* out8, Stream stream) {
  if (chunk.lists() == 0) return;
  composite_sorted_kernel<<<unsigned(chunk.lists()), kThreads, 0, cudaStream_t(stream)>>>(
      chunk, lists, unsigned(chunk.tiles()), unsigned(lists.tile.across(chunk.image.width_px)), background, out, out8);
  check_launch("composite_sorted");
}

}  // namespace lfgs::cuda
