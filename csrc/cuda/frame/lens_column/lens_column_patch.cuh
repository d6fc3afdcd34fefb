// A warp's patch in composite_lens_column.cu, 4 lenses x 16 rows. It has the positions of its samples, the splats that
// touch it, and the state of its samples. It reads the frame and the staged splats, and writes the warp's part of
// shared memory. cull() writes the queues of intersections, clear() the state of the samples, and finish() hands it out
// as colours.
//
// All 32 lanes of a warp call these functions together.
#pragma once

#include "cuda/frame/lens_column/lens_column_operands.cuh"
#include "cuda/frame/strip.cuh"

namespace lfgs::cuda {

#if __CUDA_ARCH__ >= 800
// The splat of number `id`, its depth replaced by where the arrays by lens column have its entry at lens column 0.
__device__ inline Splat<float> splat_with_entry(const DirectFrame& frame, uint32_t id) {
  const float4* parts = reinterpret_cast<const float4*>(frame.splats.splats) + 3 * int64_t(id);
  const float4 a = parts[0], b = parts[1];
  float4 c = parts[2];
  c.w = __uint_as_float(id * frame.optics.lens_columns.columns());
  return assembled(a, b, c);
}

// x + tan(slant) y of lens column -1/2, in the middle of a patch whose first lens is this one.
__device__ inline float sheared_x(const LensOptics& lens, int first_lens) {
  const float phase = fmaf(first_lens + 0.5f * (kWarpLenses - 1), lens.line_number, -lens.origin);
  return (phase - float(lens.lead)) / 3 + 0.5f * lens.slant_tan + 1.f / 6;
}

// The patches that a splat may touch, as bits. Bit kWarpsAcross t + a is patch a of a tile from the left, at lens
// column t of [first, last]. The row of patches, upper or lower, begins in row `row0`.
__device__ inline unsigned patches_touched(const LensOptics& lens, const Splat<float>& s, int first_lens, int row0,
                                           int first, int last) {
  const LensColumns& lens_columns = lens.lens_columns;
  const Strip rows(s, row0 + 0.5f, row0 + kWarpRows - 0.5f, lens.slant_tan);
  const float width = kWarpLenses * lens.line_number / 3;
  // Half the width of a patch between the outermost pixel centres
  const float half_x = (0.5f * (kWarpLenses - 1) * lens.line_number + 0.5f) / 3 + 1.f / 3 + 0.01f;
  float x = sheared_x(lens, first_lens) + (first + 0.5f) / 3;  // of the first patch, at each lens column
  unsigned touched = 0;
#pragma unroll
  for (int t = 0; t < kGroupColumns; ++t, x += 1.f / 3) {
    const int lens_column = min(first + t, last);  // what follows behind the last is cleared below
    const Span span = rows.at(s, lens_columns.centre[lens_column], lens_columns.half[lens_column]);
    // A square below zero makes the reach negative, and very large
    const float reach = fmaf(span.square, fast_rsqrt(fmaxf(span.square, 1e-30f)), span.spread + half_x);
#pragma unroll
    for (int a = 0; a < kWarpsAcross; ++a)
      touched |= fabsf(x - span.middle + a * width) <= reach ? 1u << (kWarpsAcross * t + a) : 0u;
  }
  return touched & ((2u << (kWarpsAcross * (last - first + 1) - 1)) - 1);
}
static_assert(kWarpsAcross * kGroupColumns <= 32);
#endif

#if __CUDA_ARCH__ >= 800
template <class Layout>
struct Patch {
  static constexpr int kLensColumns = Layout::kLensColumns;  // of a *pass*: those that are drawn at a time
  const DirectFrame& frame;
  Memory<Layout>& memory;
  WarpMemory<Layout>& own;
  int lane, row0, lens0;  // of the patch
  float middle_y;
  unsigned places;  // bit 8 p + s: this lane's sample s is of a lens that starts at place p

  __device__ Patch(const DirectFrame& frame_, Memory<Layout>& memory_, int tile_x, int tile_y)
      : frame(frame_), memory(memory_), own(memory_.warps[threadIdx.x / 32]), lane(threadIdx.x % 32) {
    const int warp = threadIdx.x / 32, across = warp % kWarpsAcross, down = warp / kWarpsAcross;
    const LensOptics& lens = frame.optics;

    row0 = tile_y * kTileRows + down * kWarpRows;
    lens0 = lens.lens_columns.first_lens + (tile_x * kWarpsAcross + across) * kWarpLenses;
    middle_y = row0 + 0.5f * kWarpRows;
    if (lane == 0) own.x_first = sheared_x(lens, lens0) - lens.slant_tan * middle_y;

    // Where the lens of each sample begins, a sample of each half of the patch to a lane
    for (int h = 0; h < kHalves; ++h) {
      const int row = row0 + lane / kWarpLenses + 8 * h, number = lens0 + lane % kWarpLenses;
      const int begin = lens_start(lens, row, number);
      const int start = lens.has_cells ? first_stripe(lens, row, number) - lens.lead : begin;
      own.start[h][lane] = start;
      own.lens_columns[h][lane] = make_uchar2(begin - start, lens_start(lens, row, number + 1) - start);
    }
    __syncwarp();

    // At which place of a pixel the lenses of this lane's samples begin
    places = 0;
    for (int s = 0; s < 2 * kFragments; ++s)  // sample s is in fragment s / 2, in row lane / 4 of it or 8 more
      places |= 1u << 8 * place_index(own.start[s / 4][s / 2 % 2 * 16 + s % 2 * 8 + lane / 4]) + s;
  }

  // Staged splat i; in the place of its depth is a number, see splat_with_entry().
  __device__ Splat<float> staged(int i) const {
    if constexpr (Layout::kCompact) return splat_with_entry(frame, memory.id[i]);
    return assembled(memory.splat[0][i], memory.splat[1][i], memory.splat[2][i]);
  }

  // Which of the `count` staged splats may touch the patch at the t-th lens column of the group. Fill the queue, which
  // keeps the splats in their order, and returns how many there are.
  __device__ int cull(int t, int count) {
    const int warp = threadIdx.x / 32;
    const int own_lane = forgotten(lane);  // so that draw(), between two culls, keeps no registers for what follows
    const unsigned mine = 1u << (kWarpsAcross * t + warp % kWarpsAcross), before = (1u << own_lane) - 1;
    const uint32_t* touched = memory.touched[warp / kWarpsAcross];
    int n = 0;
#pragma unroll 1
    for (int i = own_lane; i - own_lane < count; i += 32 * kAhead) {
      unsigned at[kAhead];  // all are read before the first is queued, so that the reads overlap
#pragma unroll
      for (int k = 0; k < kAhead; ++k) at[k] = touched[i + 32 * k];
#pragma unroll
      for (int k = 0; k < kAhead; ++k) {
        const unsigned intersections = __ballot_sync(~0u, at[k] & mine);
        if (at[k] & mine) own.queue[n + __popc(intersections & before)] = uint16_t(i + 32 * k);
        n += __popc(intersections);
      }
    }
    __syncwarp();
    return n;
  }

  // The staged splat at place k of the queue.
  __device__ int queued(int k) const { return own.queue[k]; }

  // Where sample i of the two that this lane keeps (see Task::join) stands: its half of the patch, its number there.
  __device__ int2 place_of_kept(int i) const {
    const int quad = lane % 4, sample = quad % 2 * kFragments + quad / 2 * kHalves + i, fragment = sample / 2;
    return make_int2(fragment / 2, fragment % 2 * 16 + sample % 2 * 8 + lane / 4);
  }

  // Begin a pass: nothing is drawn yet. Samples that are not on the panel, or not of the lens, count as opaque, so
  // that nobody works on them.
  __device__ void clear(int first) {
    const LensOptics& lens = frame.optics;
#pragma unroll
    for (int i = 0; i < kHalves; ++i) {
      const int2 place = place_of_kept(i);
      const int row = row0 + place.y / kWarpLenses + 8 * place.x, start = own.start[place.x][place.y];
      const uchar2 lens_columns = own.lens_columns[place.x][place.y];
      const int begin = max(start + lens_columns.x, 0);
      const int end = row < lens.height_px ? min(start + lens_columns.y, 3 * lens.width_px) : 0;
#pragma unroll
      for (int t = 0; t < kLensColumns; ++t) {
        const int m = start + first + t;
        own.state[t * kHalves + i][lane] = make_float2(0, m >= begin && m < end ? 1.f : 0.f);
      }
    }
    __syncwarp();
  }

  // Whether all samples of the patch are done: at lens column t of the pass; at all of the first lens_columns.
  __device__ bool opaque(int t) const {
    bool all = true;
#pragma unroll
    for (int i = 0; i < kHalves; ++i) all = all & (own.state[t * kHalves + i][lane].y < frame.stop);
    return __all_sync(~0u, all);
  }
  __device__ bool all_opaque(int lens_columns) const {
    bool all = true;
    for (int t = 0; t < lens_columns; ++t) all = all && opaque(t);
    return all;
  }

  // A finished sample: its row in the tile, its sub-pixel in that row of the panel and the place of that in its pixel.
  struct Finished {
    int row, m, place;
  };

  // Hand every finished sample of lens columns first .. last that is on the panel to put(Finished, value).
  template <class Put>
  __device__ void finish(int first, int last, const float4& background, const Put& put) {
    const LensOptics& lens = frame.optics;
    const int down = threadIdx.x / 32 / kWarpsAcross;
#pragma unroll
    for (int i = 0; i < kHalves; ++i) {
      const int2 kept = place_of_kept(i);
      const int row = kept.y / kWarpLenses + 8 * kept.x, start = own.start[kept.x][kept.y];
      if (row0 + row >= lens.height_px) continue;
      const uchar2 lens_columns = own.lens_columns[kept.x][kept.y];
      const int begin = max(start + max(int(lens_columns.x), first), 0);
      const int end = min(start + min(int(lens_columns.y), last + 1), 3 * lens.width_px);
      int place = place_index(start + first);
#pragma unroll
      for (int t = 0; t < kLensColumns; ++t, place = place == 2 ? 0 : place + 1) {
        const int m = start + first + t;
        if (m < begin || m >= end) continue;
        const float2 state = own.state[t * kHalves + i][lane];
        const float behind = place == 0 ? background.x : place == 1 ? background.y : background.z;
        put(Finished{down * kWarpRows + row, m, place}, ended(fmaf(state.y, behind, state.x), state.y, behind));
      }
    }
  }
};
#endif

}  // namespace lfgs::cuda
