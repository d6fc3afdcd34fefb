// Stage composite on the device for sub-pixels sorted by view, where each view is an ordinary camera. It reads the
// splats, the lists of every (view, tile) and the lists of sub-pixels, and writes those sub-pixels of the image.
//
// A block has the sub-pixels of one view in one tile, a thread a sub-pixel at a time. The sub-pixels of a warp lie
// close together, since the lists run along the columns; so a warp first notes which splats may touch the box around
// them, and then blends only those.
#include "cuda/common/blend.cuh"
#include "cuda/common/check.h"
#include "cuda/sorted/sorted.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / 32;
constexpr int kAtATime = 4;  // splats that are blended between two looks at whether the warp's sub-pixels still open
static_assert(kThreads % kSubpixelBlock == 0 && kSubpixelBlock == 32);

// A splat as the sub-pixels of a tile read it.
struct Staged {
  float4 place;      // u0 and v0, from the tile's corner; c0, tau
  float2 size;       // log2 opacity, 1 / S
  float colours[6];  // by channel; the rest fills up to 16 bytes

  // log2 of opacity * weight at a sub-pixel.
  __device__ float power(float x, float y) const {
    const float dy = y - place.y, dx = x - place.x - place.z * dy;
    return size.x - place.w * dy * dy - dx * dx * size.y;
  }
};

// What a block keeps of a batch of splats: the splats, with one that touches nothing behind them, and for each warp the
// numbers of those that it blends, filled up to a multiple of kAtATime with the number of the last.
struct Batch {
  Staged splats[kThreads + 1];
  ushort4 hits[kWarps][kThreads / kAtATime];
};

// The box around the sub-pixels of a warp: middle and half size.
struct Box {
  float x, y, half_x, half_y;

  // Whether the alpha of a splat may be above the opacity cut somewhere in the box; it errs on the wide side.
  __device__ bool meets(const Staged& s) const {
    const float middle = y - s.place.y, nearest = fmaxf(fabsf(middle) - half_y, 0.f);
    const float exponent = s.size.x - s.place.w * nearest * nearest + float(1e-3 - kLog2MinAlpha);
    const float distance =
        fmaxf(fabsf(x - s.place.x - s.place.z * middle) - (half_x + fabsf(s.place.z) * half_y + 0.01f), 0.f);
    return exponent >= 0 && distance * distance * s.size.y <= exponent;
  }
};

// The sub-pixel of this thread; `some` is false on threads that have none.
struct Sample {
  float x = 0, y = 0;  // centre, from the tile's corner
  int channel = 0;
  int64_t place = 0;  // in the image
  bool some = false;

  __device__ Sample(const SubpixelTile& tile, uint16_t code, int64_t x0, int64_t y0, int64_t width_px) {
    if (code == kNoSubpixel) return;
    const Subpixel s = decode_subpixel(tile, code);
    x = s.column + 0.5f, y = s.row + 0.5f, channel = s.channel, some = true;
    place = ((y0 + s.row) * width_px + x0 + s.column) * 3 + s.channel;
  }

  // The box around the samples of the warp; where there are none, it meets no splat.
  __device__ Box box() const {
    const float far = 1e9f;
    float left = some ? x : far, right = some ? x : -far, top = some ? y : far, bottom = some ? y : -far;
    for (int step = 16; step > 0; step /= 2) {
      left = fminf(left, __shfl_xor_sync(~0u, left, step)), right = fmaxf(right, __shfl_xor_sync(~0u, right, step));
      top = fminf(top, __shfl_xor_sync(~0u, top, step)), bottom = fmaxf(bottom, __shfl_xor_sync(~0u, bottom, step));
    }
    return {(left + right) / 2, (top + bottom) / 2, (right - left) / 2, (bottom - top) / 2};
  }
};

// Reads a splat for the tile whose corner is at (x0, y0).
__device__ void stage(const SortedChunk& chunk, uint32_t id, float x0, float y0, Staged& out) {
  const float4* footprint = reinterpret_cast<const float4*>(chunk.footprints) + 2 * int64_t(id);
  const float4 place = __ldg(footprint), size = __ldg(footprint + 1);
  const float4 colour = __ldg(reinterpret_cast<const float4*>(chunk.colours) + id);
  out.place = make_float4(place.x - x0, place.y - y0, place.z, place.w);
  out.size = make_float2(size.x, size.y);
  out.colours[0] = colour.x, out.colours[1] = colour.y, out.colours[2] = colour.z;
}

// Writes the numbers of the batch's splats that may touch the warp's box, in order; returns how many, with the fill.
__device__ int note_hits(const Batch& batch, int count, const Box& box, uint16_t* hits) {
  const int lane = threadIdx.x % 32;
  int noted = 0;
  for (int group = 0; group < count; group += 32) {
    const bool hit = group + lane < count && box.meets(batch.splats[group + lane]);
    const unsigned all = __ballot_sync(~0u, hit);
    if (hit) hits[noted + __popc(all & ((1u << lane) - 1))] = uint16_t(group + lane);
    noted += __popc(all);
  }
  const int fill = (kAtATime - noted % kAtATime) % kAtATime;
  if (lane < fill) hits[noted + lane] = kThreads;
  __syncwarp();
  return noted + fill;
}

// The light that a sub-pixel has taken, and where it goes on. It takes splats whose power is not below `least`: from
// the opacity cut on while it is open, then none, since the next splat would leave less than the limit of
// transmittance. What is left is for the background.
struct Light {
  static constexpr float kClosed = 1e30f;
  float value = 0, transmittance = 1, least;

  __device__ explicit Light(bool some) : least(some ? float(kLog2MinAlpha) : kClosed) {}
  __device__ bool open() const { return least < kClosed; }

  // Blends a splat; as over() in blend.cuh, with fewer steps.
  __device__ void take(float power, float colour) {
    const float weight = fminf(fast_exp2(power), float(kMaxAlpha)) * transmittance, after = transmittance - weight;
    const bool seen = power >= least, full = after < float(kMinTransmittance);
    if (seen && !full) value += weight * colour, transmittance = after;
    if (seen && full) least = kClosed;
  }
};

// Draws the sub-pixels of one (view, tile), a block each. Blocks that start together have the views of one tile, so
// that what they write, a byte here and there, meets in the cache. For every kThreads sub-pixels the block stages the
// tile's splats in batches, and each thread blends them into its own.
__global__ void __launch_bounds__(kThreads, 6)
    composite_sorted_kernel(const __grid_constant__ SortedChunk chunk, SubpixelLists lists, const float* background,
                            float* out, uint8_t* out8) {
  __shared__ alignas(16) Batch batch;
  const unsigned views = unsigned(chunk.image.count), tile = blockIdx.x / views;
  const int64_t list = int64_t(blockIdx.x % views) * chunk.tiles() + tile;
  const unsigned across = unsigned(lists.tile.across(chunk.image.width_px));
  const int64_t x0 = tile % across * lists.tile.width_px, y0 = tile / across * lists.tile.height_px();
  const uint2 range = reinterpret_cast<const uint2*>(chunk.ranges)[list];
  const int64_t last = lists.starts[list + 1];
  uint16_t* hits = reinterpret_cast<uint16_t*>(batch.hits[threadIdx.x / 32]);
  if (threadIdx.x == 0) batch.splats[kThreads] = {make_float4(0, 0, 0, 0), make_float2(-1e9f, 0), {}};

  // As many sub-pixels at a time as the block has threads. A tile has about so many of a view, so it takes one round on
  // average
  for (int64_t first = lists.starts[list]; first < last; first += kThreads) {
    const int64_t at = first + threadIdx.x;
    const Sample sample(lists.tile, at < last ? lists.codes[at] : kNoSubpixel, x0, y0, chunk.image.width_px);
    const Box box = sample.box();

    // Go over the list in batches, until no sample takes light any more
    Light light(sample.some);
    for (unsigned begin = range.x; begin < range.y; begin += kThreads) {
      if (__syncthreads_and(!light.open())) break;
      const int count = int(min(unsigned(kThreads), range.y - begin));
      if (int(threadIdx.x) < count)
        stage(chunk, chunk.ids[begin + threadIdx.x], float(x0), float(y0), batch.splats[threadIdx.x]);
      __syncthreads();

      const int noted = note_hits(batch, count, box, hits);
      for (int k = 0; k < noted && __any_sync(~0u, light.open()); k += kAtATime) {
        const ushort4 four = batch.hits[threadIdx.x / 32][k / kAtATime];
        for (const unsigned hit : {four.x, four.y, four.z, four.w}) {
          const Staged& splat = batch.splats[hit];
          light.take(splat.power(sample.x, sample.y), splat.colours[sample.channel]);
        }
      }
    }
    __syncthreads();  // before the splats are staged again for the next sub-pixels

    // Add what is left for the background, and store
    if (!sample.some) continue;
    const float colour = light.value + light.transmittance * background[sample.channel];
    if (out8)
      out8[sample.place] = stored(colour, out8);
    else
      out[sample.place] = stored(colour, out);
  }
}

}  // namespace

void composite_sorted(const SortedChunk& chunk, const SubpixelLists& lists, const float* background, float* out,
                      uint8_t* out8, Stream stream) {
  if (chunk.lists() == 0) return;
  composite_sorted_kernel<<<unsigned(chunk.lists()), kThreads, 0, cudaStream_t(stream)>>>(chunk, lists, background, out,
                                                                                          out8);
  check_launch("composite_sorted");
}

}  // namespace lfgs::cuda
