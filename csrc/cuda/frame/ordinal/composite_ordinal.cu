// Composite of a light-field frame by tiles of lenses, for rigs of large disparity. Needs tensor cores (sm_80). Reads
// the frame's splats and sorted lists, writes the image.
//
// The t-th sub-pixels of neighbouring lenses see nearly the same part of the rig: an *ordinal* t covers 1 / P_e of it.
// A warp task is 4 lenses x 16 rows at one ordinal, 64 samples. x, y and v (the view, scaled) count from the centre of
// the task. The exponent of a splat at a sample is
//   A(y) - d(x, y, v)^2,   A = log2 o - tau (y - v0)^2,   d = S^(-1/2) (x - m(y, s)) to second order in v.
// Both A and d are inner products of *features* of the sample (1, x, y, v, x v ...) with *coefficients* of the splat:
// d has 16 of them and A has 8. They are in half precision, large coefficients as the sum of two halves; the tensor
// cores multiply them and add in float. Colours are inner products, too: each sample has features that are not zero
// only for its own channel. A splat's colour enters as the difference to that of the splat before.
// Where S varies too much within the ordinal for the polynomial, S^(-1/2) is evaluated sample by sample: such hits (a
// hit is a splat that may touch the task's samples) are *careful*.
//
// A block draws a tile of 16 lenses x 32 rows with 8 warps. The ordinals of a tile come in groups, each with a list of
// splats. Of each quad of lanes every lane takes one contiguous quarter of a task's hits; since over is associative,
// the quarters are joined once at the end.
#include <cuda_fp16.h>

#include "cuda/frame/ordinal/ordinal_task.cuh"

namespace lfgs::cuda {
namespace {

// Writes the colours of every splat at every ordinal into LensFrame::ordinal_colours and ordinal_slopes: parabolas
// through three places of what the ordinal sees, with nothing below zero there. They are made once for the whole frame,
// since several lists have the same splat. A thread makes kShare ordinals of one splat.
constexpr int kShare = 3, kColourThreads = 128;
__global__ void __launch_bounds__(kColourThreads) ordinal_colours_kernel(const __grid_constant__ LensFrame frame) {
#if __CUDA_ARCH__ >= 800
  if (frame.state->kernel != int(LensKernel::kOrdinal)) return;
  const Ordinals& ordinals = frame.optics.ordinals;
  const Splats<float>& splats = frame.splats;
  const int columns = ordinals.columns(), items = columns / kShare;
  const int64_t thread = int64_t(blockIdx.x) * kColourThreads + threadIdx.x, id = thread / items;
  if (id >= splats.count || splats.splats[id].reach_y < 0) return;
  const int first = int(thread % items) * kShare, order = splats.orders[id];
  const float4* powers = reinterpret_cast<const float4*>(splats.colours) + id * (splats.colour_order + 1);

  // The offsets at which the colour polynomial is evaluated
  constexpr int kAhead = 4;                       // loads under way at a time
  float s[kShare][3], values[kShare][3][3] = {};  // by ordinal; low, middle, high; values also by place
#pragma unroll
  for (int o = 0; o < kShare; ++o)
#pragma unroll
    for (int n = 0; n < 3; ++n) {
      const int ordinal = min(first + o, ordinals.count - 1);
      s[o][n] = fmaf(float(n - 1) * kParabolaPlace, ordinals.half[ordinal], ordinals.centre[ordinal]);
    }

  // Horner's rule, from the highest power of s down
  for (int high = order; high >= 0; high -= kAhead) {
    float4 c[kAhead];
#pragma unroll
    for (int k = 0; k < kAhead; ++k) c[k] = by_place(frame.optics, powers[max(high - k, 0)]);
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      if (high < k) break;
#pragma unroll
      for (int o = 0; o < kShare; ++o)
#pragma unroll
        for (int n = 0; n < 3; ++n) {
          float (&value)[3] = values[o][n];
          value[0] = fmaf(value[0], s[o][n], c[k].x), value[1] = fmaf(value[1], s[o][n], c[k].y);
          value[2] = fmaf(value[2], s[o][n], c[k].z);
        }
    }
  }

  // The parabolas, in v
#pragma unroll
  for (int o = 0; o < kShare; ++o) {
    const float half = ordinals.half[min(first + o, ordinals.count - 1)];
    // 1 / (2 v), where v is that of the last of the three offsets, with its sign
    const float inverse = half > 0 ? 0.5f * offset_unit(frame.optics) / (kParabolaPlace * half) : 0.5f;
    float middle[3];
    unsigned slope[3];
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      const float low = fmaxf(values[o][0][c], 0.f), high = fmaxf(values[o][2][c], 0.f);
      middle[c] = fmaxf(values[o][1][c], 0.f);
      const float bend = (high + low - 2 * middle[c]) * 2 * inverse * inverse;
      slope[c] = slope_and_bend((high - low) * inverse, bend);
    }
    const int64_t at = id * columns + first + o;
    reinterpret_cast<float4*>(frame.ordinal_colours)[at] =
        make_float4(middle[0], middle[1], middle[2], __uint_as_float(slope[0]));
    reinterpret_cast<uint2*>(frame.ordinal_slopes)[at] = make_uint2(slope[1], slope[2]);
  }
#endif
}

// With compensation: writes the share of opacity of every splat at every ordinal into
// LensFrame::ordinal_shares, as ShareFit has it. A thread makes one.
__global__ void __launch_bounds__(kColourThreads) ordinal_shares_kernel(const __grid_constant__ LensFrame frame) {
#if __CUDA_ARCH__ >= 800
  if (frame.state->kernel != int(LensKernel::kOrdinal)) return;
  const Ordinals& ordinals = frame.optics.ordinals;
  const int columns = ordinals.columns();
  const int64_t at = int64_t(blockIdx.x) * kColourThreads + threadIdx.x, id = at / columns;
  if (id >= frame.splats.count || frame.splats.splats[id].reach_y < 0) return;
  const float centre = ordinals.centre[min(int(at % columns), ordinals.count - 1)], unit = offset_unit(frame.optics);
  const OrdinalShape shape(frame.splats.splats[id], centre, unit);
  const ShareFit fit(OrdinalShare(frame.splats.compensations[id], shape, centre, unit), shape, ordinals);
  reinterpret_cast<float2*>(frame.ordinal_shares)[at] =
      make_float2(fit.level, __uint_as_float(halves(fit.slope, fit.bend)));
#endif
}

#if __CUDA_ARCH__ >= 800
// Copies splats of a list, and without harmonics their colours, into the block's shared memory. With harmonics or
// shares of opacity, the place of a splat's depth receives the index, in the arrays by ordinal, of its entry at ordinal
// `first`. There are no branches, so that several reads are under way at a time.
template <bool Harmonics, bool Compensated>
__device__ void stage(const LensFrame& frame, const uint32_t* ids, int count, int first, Memory<Harmonics>& memory) {
  constexpr int kParts = Harmonics ? 3 : 4;
  const unsigned columns = frame.optics.ordinals.columns();
  const float4* splats = reinterpret_cast<const float4*>(frame.splats.splats);
  const float4* colours = reinterpret_cast<const float4*>(frame.splats.colours);
  for (int j = threadIdx.x; j < count * kParts; j += kThreads) {
    const int i = j / kParts, k = j % kParts;
    const uint32_t id = ids[i];
    float4 part = k < 3 ? splats[3 * int64_t(id) + k] : colours[id];
    if ((Harmonics || Compensated) && k == 2) part.w = __uint_as_float(id * columns + first);
    if (!Harmonics && k == 3) part = by_place(frame.optics, part);
    *(k < 3 ? &memory.splat[k][i] : &memory.colour[Harmonics ? 0 : i]) = part;
  }
}

// Draws one tile, by all threads of the block. Bytes are collected in shared memory and then stored row by row; floats
// go straight to the image.
template <bool Harmonics, bool Compensated, class Out>
__device__ void draw_tile(const LensFrame& frame, const Lists& lists, unsigned tile, int row_bytes,
                          const float4& background, Out* out, Memory<Harmonics>& memory) {
  const LensOptics& lens = frame.optics;
  const Ordinals& ordinals = lens.ordinals;
  const int tile_x = tile % frame.ordinal.across, tile_y = tile / frame.ordinal.across, width = 3 * lens.width_px;
  const int first_lens = ordinals.first_lens + tile_x * kTileLenses;

  // Where the tile's rows begin and end; where none is on the panel there is nothing to draw
  bool shown = false;
  for (int r = threadIdx.x; r < kTileRows; r += kThreads) {
    const int row = tile_y * kTileRows + r;
    const int2 ends = make_int2(lens_start(lens, row, first_lens), lens_start(lens, row, first_lens + kTileLenses));
    memory.rows[r] = ends;
    shown = row < lens.height_px && ends.y > 0 && ends.x < width;
  }
  if (!__syncthreads_or(shown)) return;
  Task<Harmonics, Compensated> task(frame, memory, tile_x, tile_y);

  // `put` takes the colour of a finished sample: sub-pixel `at` of row r of the tile
  uint8_t* bytes = reinterpret_cast<uint8_t*>(&memory + 1);
  auto put = [&](int r, int at, float value) {
    if constexpr (sizeof(Out) == 1) {
      bytes[r * row_bytes + at] = stored(value, out);
    } else {
      const int row = tile_y * kTileRows + r, m = memory.rows[r].x + at;
      if (row >= lens.height_px || m < 0 || m >= width) return;
      out[int64_t(row) * width + in_image(lens, m)] = stored(value, out);
    }
  };

  // Group by group: walk the list in batches that fit shared memory, until all samples are opaque
  for (int group = 0; group < ordinals.groups; ++group) {
    const int first = group * ordinals.per_group, last = min(first + ordinals.per_group, ordinals.count) - 1;
    task.clear(first);
    const uint2 range = lists.range(int64_t(tile) * ordinals.groups + group);
    for (unsigned begin = range.x; begin < range.y; begin += kBatch<Harmonics>) {
      const int count = min(unsigned(kBatch<Harmonics>), range.y - begin);
      const bool opaque = task.all_opaque(last - first + 1);
      if (__syncthreads_and(opaque)) break;
      stage<Harmonics, Compensated>(frame, lists.ids + begin, count, first, memory);
      __syncthreads();
      if (opaque) continue;
      const int hits = task.cull(count, first, last);
#pragma unroll 1
      for (int ordinal = first; ordinal <= last; ++ordinal) {
        const int n = __shfl_sync(~0u, hits, ordinal - first);
        if (n == 0 || task.opaque(ordinal - first)) continue;
        task.draw(ordinal - first, n, ordinal);
      }
    }
    __syncwarp();
    task.finish(first, last, background, put);
  }

  // Store the bytes, a row a warp
  if constexpr (sizeof(Out) == 1) {
    __syncthreads();
    for (int r = threadIdx.x / 32; r < kTileRows; r += kWarps) {
      const int row = tile_y * kTileRows + r;
      if (row < lens.height_px) store_row(lens, row, memory.rows[r], bytes + r * row_bytes, out);
    }
  }
}
#endif

// Draws the frame, if it has chosen this kernel. There are as many blocks as the device holds at a time; each draws one
// tile after another until none is left, and a thread has the parts described at Task.
template <bool Harmonics, bool Compensated, class Out>
__global__ void __launch_bounds__(kThreads, 2)
    composite_ordinal_kernel(const __grid_constant__ LensFrame frame, int row_bytes, const float* background,
                             Out* out) {
#if __CUDA_ARCH__ >= 800
  if (frame.state->kernel != int(LensKernel::kOrdinal)) return;
  extern __shared__ __align__(16) char shared[];
  Memory<Harmonics>& memory = *reinterpret_cast<Memory<Harmonics>*>(shared);
  const float4 behind = by_place(frame.optics, make_float4(background[0], background[1], background[2], 0));
  const Lists lists(frame);
  const unsigned tiles = tiles_to_draw(frame, frame.ordinal);
  WorkQueue work(frame, LensKernel::kOrdinal);
  if (!Harmonics && threadIdx.x == 0) memory.colour[Harmonics ? 0 : kBatch<Harmonics>] = make_float4(0, 0, 0, 0);
  for (unsigned tile = blockIdx.x; tile < tiles; tile = memory.next_tile) {
    if (threadIdx.x == 0) work.claim(gridDim.x);
    draw_tile<Harmonics, Compensated>(frame, lists, tile_to_draw(frame, tile), row_bytes, behind, out, memory);
    __syncthreads();
    if (threadIdx.x == 0) memory.next_tile = work.claimed;
    __syncthreads();
  }
#endif
}

// Launches the kernels that make colours and shares by ordinal, where the scene needs them, and the one that draws.
template <bool Harmonics, bool Compensated, class Out>
void launch(const LensFrame& frame, const float* background, Out* out, cudaStream_t stream) {
  if (Harmonics && frame.splats.count) {
    const int64_t items = frame.splats.count * (frame.optics.ordinals.columns() / kShare);
    ordinal_colours_kernel<<<unsigned(blocks_for(items, kColourThreads)), kColourThreads, 0, stream>>>(frame);
    check_launch("composite_ordinal: colours");
  }
  if (Compensated && frame.splats.count) {
    const int64_t items = frame.splats.count * frame.optics.ordinals.columns();
    ordinal_shares_kernel<<<unsigned(blocks_for(items, kColourThreads)), kColourThreads, 0, stream>>>(frame);
    check_launch("composite_ordinal: shares");
  }
  const auto kernel = composite_ordinal_kernel<Harmonics, Compensated, Out>;
  const int row = lens_row_bytes(frame.optics.line_number);
  const size_t bytes = sizeof(Memory<Harmonics>) + kTileRows * row;
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(bytes)),
        "composite_ordinal: shared memory");
  kernel<<<resident_blocks(kernel, kThreads, bytes), kThreads, bytes, stream>>>(frame, row, background, out);
  check_launch("composite_ordinal");
}

}  // namespace

// Asks what the kernels were compiled for, since a device may run PTX made for an older one without tensor cores. A
// tile takes 107 to 121 KB of shared memory with harmonics, so devices of 99 KB (sm_86, sm_89, sm_120) draw all frames
// by pixels.
bool can_composite_ordinal(const Lens& lens) {
  int device = 0, shared = 0;
  cudaFuncAttributes built{};
  check(cudaGetDevice(&device), "composite_ordinal: device");
  check(cudaFuncGetAttributes(&built, ordinal_colours_kernel), "composite_ordinal: architecture");
  check(cudaDeviceGetAttribute(&shared, cudaDevAttrMaxSharedMemoryPerBlockOptin, device),
        "composite_ordinal: shared memory");
  const double number = lens.line_number, views_each = double(lens.views) / number;
  const size_t bytes = sizeof(Memory<true>) + kTileRows * lens_row_bytes(float(number));
  const bool fits = built.ptxVersion >= 80 && bytes <= size_t(shared);
  if (!lens.has_cells)
    return fits && number >= kMinLineNumber && number <= kMaxLineNumber && views_each <= kMostViewsEach;
  // With cells there are two more ordinals, and each sees more views; and what lies at a place must be of one channel
  return fits && number >= kMinCellLineNumber && number <= kMaxLineNumber - 2 && lens.stands_in_order() &&
         lens.has_one_order() && (1 + 2 * lens.most_beyond()) * views_each <= kMostViewsEach;
}

void composite_ordinal(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream) {
  if (!frame.has_ordinal) return;
  auto draw_as = [&](auto compensated, auto* image) {
    if (frame.splats.orders)
      launch<true, compensated>(frame, background, image, cudaStream_t(stream));
    else
      launch<false, compensated>(frame, background, image, cudaStream_t(stream));
  };
  auto draw = [&](auto* image) {
    frame.rig.compensated() ? draw_as(std::true_type(), image) : draw_as(std::false_type(), image);
  };
  out8 ? draw(out8) : draw(out);
}

}  // namespace lfgs::cuda
