// Composite of a light-field frame by tiles of pixels, for rigs of small disparity. Read the frame's splats and sorted
// lists, write the image.
//
// A warp draws a patch of 16 x 8 pixels, in which a lane has two neighbours in each of two rows: 12 sub-pixels. For
// small Gaussians a patch has 16 x 4 pixels and a lane one row, since many touch only a part of a larger patch. Warps
// do not wait for each other. A warp culls the list of its tile, 32 splats at a time, against its own pixels. An
// intersection is a splat that may touch the patch. Of every 32 intersections each lane turns one into a polynomial
// about the patch's centre. r is about linear or quadratic in s.
//   exponent = log2 o - (t (y - v0))^2 - d^2,   d = r(s) (x - m(y, s)),   r = S^(-1/2).
// All lanes then evaluate it, with no division and one exp2 a sample. In a frame that needs the quadratic r, splats for
// which the linear r is enough still have that. Colours enter as differences, C += T (c_i - c_(i-1)), which saves an
// instruction. Some splats need the exact formulas: they are nearly opaque, or their shape or colour varies much over
// the rig. Where half precision will do, samples are pairs of halves.
#include <type_traits>

#include "cuda/common/launch.h"
#include "cuda/frame/composite_frame.cuh"
#include "cuda/frame/kernel_cost.cuh"
#include "cuda/frame/pixel/pixel_fit.cuh"
#include "cuda/frame/pixel/pixel_half.cuh"
#include "cuda/frame/pixel/pixel_samples.cuh"
#include "cuda/frame/strip.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kWarps = 4, kThreads = 32 * kWarps;
constexpr int kUnitHeight = 8;  // rows that are handed out to a warp at a time: one patch or two
template <class C>
using Samples = std::conditional_t<C::Half, HalfSamples<C>, FloatSamples<C>>;
// Blocks on a multiprocessor: with more, registers would spill.
constexpr int blocks_per_multiprocessor(int lane_rows, bool harmonics) {
  return lane_rows == 1 ? 7 : harmonics ? 4 : 5;
}

// Add the intersections [h, end), of which none is exact, in runs that are all special or all not. A choice at every
// intersection would move registers.
template <class C>
__device__ void add_run(const StagedOf<C>& staged, int h, int end, unsigned special, float cut, Samples<C>& samples) {
  constexpr bool kSpecial = C::Quadratic || C::Half;
  while (h < end) {
#pragma unroll 1
    for (; h < end && !(kSpecial && special >> h & 1); ++h) samples.template add<false>(staged, h, cut);
    if (h >= end) break;
    if constexpr (kSpecial) {
#pragma unroll 1
      do samples.template add<true>(staged, h, cut);
      while (special >> h++ & 2);  // looks at bit h + 1, then moves on to it
    }
  }
}

// Add the first `count` <= 32 waiting intersections to the samples of the patch: runs of polynomials, and between them
// the exact intersections one by one.
template <class C>
__device__ void add_intersections(const DirectFrame& frame, int count, float2 centre, float4 background,
                                  Samples<C>& samples, StagedOf<C>& staged) {
  const Marks marks = specialise<C>(frame, count, centre, staged);
  __syncwarp();
  unsigned needs_exact = marks.needs_exact;
  for (int h = 0;; ++h) {
    const int next = needs_exact ? __ffs(needs_exact) - 1 : count;
    add_run<C>(staged, h, next, marks.special, frame.sample_cut, samples);
    if (next == count) break;
    h = next, needs_exact &= needs_exact - 1;
    samples.close(staged, h);
    samples.add_exactly(ExactIntersection<C>(frame, staged.ids[h], centre, background));
  }
  samples.flush();
}

// Draw one patch, by all lanes of a warp: cull the list `range`, add the intersections 32 at a time, and stores the
// pixels.
template <class C, class Out>
__device__ void draw_patch(const DirectFrame& frame, const Lists& lists, uint2 range, int left, int top,
                           float4 background, Out* out, StagedOf<C>& staged) {
  const int lane = threadIdx.x % 32;
  const float2 centre = make_float2(left + 0.5f * kPatchWidth, top + 0.5f * C::patch_height);
  const float half_height = 0.5f * C::patch_height - 0.5f;
  Samples<C> samples(frame, left, top);
  __syncwarp();
  if (lane == 0) staged.colour = {};
  __syncwarp();

  int waiting = 0;
  for (unsigned begin = range.x; begin < range.y; begin += 32) {
    // Of the next 32 splats, those that may touch the patch join the intersections that wait
    const bool inside = begin + lane < range.y;
    const uint32_t id = lists.ids[inside ? begin + lane : begin];
    const Splat<float> splat = splat_about(frame.splats, id, centre);
    const Strip strip(splat, -half_height, half_height);
    const bool touched = inside & strip.whole_rig(splat).touches(0.f, 0.5f * kPatchWidth - 0.5f);
    const unsigned intersections = __ballot_sync(~0u, touched);
    if (touched) staged.ids[waiting + __popc(intersections & ((1u << lane) - 1))] = id;
    waiting += __popc(intersections);
    __syncwarp();
    const bool end = begin + 32 >= range.y;
    if (waiting < 32 && !(end && waiting > 0)) continue;

    // Add 32 of them, or at the end of the list what there is; there it takes two rounds if more than 32 wait
    do {
      const int count = min(waiting, 32);
      add_intersections<C>(frame, count, centre, background, samples, staged);
      waiting -= count;
      const uint32_t left_over = staged.ids[32 + lane];
      __syncwarp();
      staged.ids[lane] = left_over;
      __syncwarp();
    } while (end && waiting > 0);
    if (__all_sync(~0u, samples.opaque(frame.stop))) break;
  }
  samples.store(frame.optics, staged, background, out);
}

// Draw patches until none is left. Each warp takes a piece of a tile at a time, of kUnitHeight rows.
template <class C, class Out>
__device__ void draw_patches(const DirectFrame& frame, const float* background, Out* out,
                             StagedOf<C> (&staged)[kWarps]) {
  constexpr unsigned kAcross = kPixelTileWidth / kPatchWidth, kDown = kPixelTileHeight / kUnitHeight;
  const float4 behind = by_place<C::Cells>(frame.optics, make_float4(background[0], background[1], background[2], 0));
  const Lists lists(frame);
  const unsigned units = tiles_to_draw(frame, frame.pixel) * kAcross * kDown, across = unsigned(frame.pixel.across);
  WorkQueue work(frame, C::kernel);
  for (unsigned unit = blockIdx.x * kWarps + threadIdx.x / 32; unit < units; unit = __shfl_sync(~0u, work.claimed, 0)) {
    if (threadIdx.x % 32 == 0) work.claim(gridDim.x * kWarps);
    const unsigned tile = tile_to_draw(frame, unit / (kAcross * kDown)), part = unit % (kAcross * kDown);
    const int left = int(tile % across * kAcross + part % kAcross) * kPatchWidth;
    const int top = int(tile / across * kDown + part / kAcross) * kUnitHeight;
    if (left >= frame.optics.width_px) continue;
#pragma unroll 1
    for (int k = 0; k < kUnitHeight / C::patch_height; ++k) {
      const int y = top + k * C::patch_height;
      if (y < frame.optics.height_px)
        draw_patch<C>(frame, lists, lists.range(tile), left, y, behind, out, staged[threadIdx.x / 32]);
    }
  }
}

// Draw the frame if it has chosen straight lines or parabolas at this size of patches; otherwise do nothing. It is
// one kernel for both, since a launch that finds nothing to do takes time, too. There are as many blocks as the device
// holds at a time, and their warps work independently.
template <Evaluation straight, int lane_rows, bool Harmonics, bool Cells, class Out>
__global__ void __launch_bounds__(kThreads, blocks_per_multiprocessor(lane_rows, Harmonics))
    composite_pixel_kernel(const __grid_constant__ DirectFrame frame, const float* background, Out* out) {
  using Straight = Config<straight, Harmonics, lane_rows, Cells>;
  using Quadratic = Config<Evaluation::kQuadratic, Harmonics, lane_rows, Cells>;
  __shared__ Staged<Harmonics> staged[kWarps];
  if (frame.state->choice.kernel == int(Straight::kernel))
    draw_patches<Straight>(frame, background, out, staged);
  else if (frame.state->choice.kernel == int(Quadratic::kernel))
    draw_patches<Quadratic>(frame, background, out, staged);
}

// The same for compensated splats, which are always drawn with parabolas.
template <int lane_rows, bool Harmonics, class Out>
__global__ void __launch_bounds__(kThreads, blocks_per_multiprocessor(lane_rows, Harmonics))
    composite_compensated_kernel(const __grid_constant__ DirectFrame frame, const float* background, Out* out) {
  using Compensated = Config<Evaluation::kQuadratic, Harmonics, lane_rows, true, true>;
  __shared__ StagedOf<Compensated> staged[kWarps];
  if (frame.state->choice.kernel == int(Compensated::kernel)) draw_patches<Compensated>(frame, background, out, staged);
}

template <Evaluation straight, int lane_rows, bool Harmonics, class Out>
void launch(const DirectFrame& frame, const float* background, Out* out, cudaStream_t stream) {
  auto kernel = composite_pixel_kernel<straight, lane_rows, Harmonics, false, Out>;
  if (frame.optics.has_cells) kernel = composite_pixel_kernel<straight, lane_rows, Harmonics, true, Out>;
  if (frame.rig.compensated()) kernel = composite_compensated_kernel<lane_rows, Harmonics, Out>;
  kernel<<<resident_blocks(kernel, kThreads, 0), kThreads, 0, stream>>>(frame, background, out);
  check_launch("composite_pixel");
}

// Launch the kernels for both sizes of patches: which of them draws is decided on the device.
template <Evaluation straight, class Out>
void launch_all(const DirectFrame& frame, const float* background, Out* out, cudaStream_t stream) {
  if (frame.splats.orders) {
    launch<straight, 1, true>(frame, background, out, stream);
    launch<straight, 2, true>(frame, background, out, stream);
  } else {
    launch<straight, 1, false>(frame, background, out, stream);
    launch<straight, 2, false>(frame, background, out, stream);
  }
}

}  // namespace

void composite_pixel(const DirectFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream) {
  auto draw = [&](auto* image) {
    if (frame.in_half)
      launch_all<Evaluation::kHalf>(frame, background, image, cudaStream_t(stream));
    else
      launch_all<Evaluation::kLinear>(frame, background, image, cudaStream_t(stream));
  };
  out8 ? draw(out8) : draw(out);
}

}  // namespace lfgs::cuda
