// Composite of a light-field frame by tiles of pixels, for rigs of small disparity.
//
// A warp has 16 x 8 pixels, a lane two neighbours in each of two rows: 12 sub-pixels; 16 x 4 and one row for small
// Gaussians, of which a larger patch has many that touch only a part of it. Warps do not wait for each other.
// A warp culls its tile's list 32 splats at a time against its own pixels; of every 32 that stay each lane turns one
// into a polynomial about the patch's centre,
//   exponent = log2 o - (t (y - v0))^2 - d^2,   d = r(s) (x - m(y, s)),   r = S^(-1/2) about linear or quadratic in s,
// which all lanes then evaluate: no division, one exp2 a sample. Colours enter as differences, C += T (c_i - c_(i-1)),
// which saves an instruction. Splats for which that is too rough (nearly opaque, of a shape or colour that varies much
// over the rig) are evaluated as they are written, *carefully*.
#include "cuda/blend.cuh"
#include "cuda/check.h"
#include "cuda/composite_lens.cuh"
#include "cuda/lens_optics.cuh"
#include "cuda/lens_plan.cuh"
#include "cuda/strip.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kWarps = 4, kThreads = 32 * kWarps, kPatchWidth = 16;
constexpr int kUnitHeight = 8;  // rows that a warp takes at a time: one patch or two
constexpr int blocks_of(int lane_rows) { return lane_rows == 1 ? 7 : 5; }  // on a multiprocessor; more would spill
constexpr float kCarefulOpacity = -0.0291f;      // log2(0.98): what an opaque splat stops is less than 2/255
constexpr float kMostColourCurvature = 2.5e-4f;  // dropped s^2 of a colour: half of it is the error

template <bool Quadratic_, bool Harmonics_, int lane_rows_>
struct Config {
  static constexpr bool Quadratic = Quadratic_, Harmonics = Harmonics_;
  static constexpr int lane_rows = lane_rows_, patch_height = 4 * lane_rows;
  static constexpr LensKernel kernel =
      lane_rows == 1 ? (Quadratic ? LensKernel::kPixelQuadraticSmall : LensKernel::kPixelSmall)
                     : (Quadratic ? LensKernel::kPixelQuadratic : LensKernel::kPixel);
};

// What a warp keeps in shared memory.
template <bool Harmonics>
struct Staged {
  float4 fit[4][32];  // of 32 hits, see polynomial()
  float4 slope[Harmonics ? 32 : 1];
  uint32_t ids[64];   // hits that wait: fewer than 32, and those of one cull
};

// The polynomial of d and the rest of what a sample needs:
//   d = (f0.x + f1.y x + f0.y y) + s (f0.z + f1.z x + f0.w y) + s^2 (f1.x + [f3.y x + f3.z y]) + [s^3 f3.w],
//   exponent = f1.w - (f2.x + f2.y y)^2 - d^2;   colour (f2.z, f2.w, f3.x). [] only when quadratic.
template <class C>
__device__ void polynomial(const Splat<float>& s, float4 colour, float4 fit[4]) {
  auto root = [&](float v) { return fast_rsqrt(fmaf(v, fmaf(v, s.S2, s.S1), s.S0)); };
  float r0, r1, r2 = 0;
  // Through the zeros of Chebyshev's polynomials of the second kind, for the least mean error
  if (C::Quadratic) {  // 0, -+ sqrt(1/2)
    const float middle = root(0.f), right = root(0.70710678f), left = root(-0.70710678f);
    r0 = middle, r1 = (right - left) * 0.70710678f, r2 = right + left - 2 * middle;
  } else {  // -+ 1/2
    const float right = root(0.5f), left = root(-0.5f);
    r0 = 0.5f * (right + left), r1 = right - left;
  }
  const float E = fmaf(s.c0, s.v0, -s.u0), sweep = fmaf(-s.c1, s.v0, s.du);
  const float t = s.tau * fast_rsqrt(fmaxf(s.tau, 1e-37f));
  fit[0] = make_float4(r0 * E, -r0 * s.c0, fmaf(r1, E, -r0 * sweep), -fmaf(r1, s.c0, r0 * s.c1));
  fit[1] = make_float4(fmaf(r2, E, -r1 * sweep), r0, r1, s.log2_opacity);
  fit[2] = make_float4(-t * s.v0, t, colour.x, colour.y);
  fit[3] = make_float4(colour.z, r2, -fmaf(r2, s.c0, r1 * s.c1), -r2 * sweep);
}

// Colour as a straight line in s; false where that is too rough.
__device__ inline bool straight_colour(const Splats<float>& splats, uint32_t id, float4& colour, float4& slope) {
  const int order = splats.orders[id];
  const float4* powers = reinterpret_cast<const float4*>(splats.colours) + int64_t(id) * (splats.colour_order + 1);
  colour = powers[0], slope = order > 0 ? powers[1] : make_float4(0, 0, 0, 0);
  bool good = order <= 2;
  if (order == 2) {  // s^2 is 1/2 but for a Chebyshev polynomial of half its size
    const float4 c = powers[2];
    good = fmaxf(fabsf(c.x), fmaxf(fabsf(c.y), fabsf(c.z))) <= kMostColourCurvature;
    colour.x += 0.5f * c.x, colour.y += 0.5f * c.y, colour.z += 0.5f * c.z;
  }
  auto clamp = [&](float& c, float& d) {
    if (c + fabsf(d) <= 0) c = d = 0;
    good = good && c >= fabsf(d);  // a colour that ends within the rig has a bend
  };
  clamp(colour.x, slope.x), clamp(colour.y, slope.y), clamp(colour.z, slope.z);
  return good;
}

template <class C>
struct Samples {
  float x[2], y[C::lane_rows];  // about the patch's centre
  float s[C::lane_rows][2][3], colour[C::lane_rows][2][3], transmittance[C::lane_rows][2][3];
  float4 last, last_slope;  // colour of the last splat

  __device__ Samples(const LensFrame& frame, int left, int top, int lane_x, int lane_y)
      : last(make_float4(0, 0, 0, 0)), last_slope(last) {
    const LensOptics& lens = frame.optics;
#pragma unroll
    for (int r = 0; r < C::lane_rows; ++r) {
      const int row = top + lane_y + 4 * r;
      y[r] = lane_y + 4 * r + 0.5f - 0.5f * C::patch_height;
#pragma unroll
      for (int p = 0; p < 2; ++p) {
        const int column = left + lane_x + p;
        x[p] = lane_x + p + 0.5f - 0.5f * kPatchWidth;
        uint64_t phase = phase_at(lens, row, 3 * column);
#pragma unroll
        for (int k = 0; k < 3; ++k, phase += lens.phase_x) {
          s[r][p][k] = fmaf(lens.s_step, camera_of(lens, phase), lens.s_start);
          colour[r][p][k] = 0;
          transmittance[r][p][k] = row < lens.height_px && column < lens.width_px ? 1.f : 0.f;
        }
      }
    }
  }

  template <class Visit>
  __device__ void for_each(const Visit& visit) {
#pragma unroll
    for (int r = 0; r < C::lane_rows; ++r)
#pragma unroll
      for (int p = 0; p < 2; ++p)
#pragma unroll
        for (int k = 0; k < 3; ++k) visit(r, p, k);
  }

  __device__ bool opaque(float stop) {
    bool all = true;
    for_each([&](int r, int p, int k) { all = all && transmittance[r][p][k] < stop; });
    return all;
  }

  __device__ static float part(float4 c, int k) { return k == 0 ? c.x : k == 1 ? c.y : c.z; }

  __device__ void add(const Staged<C::Harmonics>& staged, int i, float cut) {
    const float4 f0 = staged.fit[0][i], f1 = staged.fit[1][i], f2 = staged.fit[2][i];
    const float4 f3 = C::Quadratic ? staged.fit[3][i] : make_float4(staged.fit[3][i].x, 0, 0, 0);
    const float4 colour_now = make_float4(f2.z, f2.w, f3.x, 0);
    const float4 step = make_float4(f2.z - last.x, f2.w - last.y, f3.x - last.z, 0);
    float4 slope_step = make_float4(0, 0, 0, 0);
    if (C::Harmonics) {
      const float4 slope = staged.slope[i];
      slope_step = make_float4(slope.x - last_slope.x, slope.y - last_slope.y, slope.z - last_slope.z, 0);
      last_slope = slope;
    }
    last = colour_now;
#pragma unroll
    for (int r = 0; r < C::lane_rows; ++r) {
      const float t = fmaf(f2.y, y[r], f2.x), A = fmaf(-t, t, f1.w);
      const float p0 = fmaf(f0.y, y[r], f0.x), p1 = fmaf(f0.w, y[r], f0.z);
      const float p2 = C::Quadratic ? fmaf(f3.z, y[r], f1.x) : f1.x;
#pragma unroll
      for (int p = 0; p < 2; ++p) {
        const float c0 = fmaf(f1.y, x[p], p0), c1 = fmaf(f1.z, x[p], p1);
        const float c2 = C::Quadratic ? fmaf(f3.y, x[p], p2) : p2;
#pragma unroll
        for (int k = 0; k < 3; ++k) {
          const float v = s[r][p][k];
          float& T = transmittance[r][p][k];
          const float d = fmaf(v, fmaf(v, C::Quadratic ? fmaf(v, f3.w, c2) : c2, c1), c0), power = fmaf(-d, d, A);
          const float alpha = fast_exp2(power);
          const float change = C::Harmonics ? fmaf(v, part(slope_step, k), part(step, k)) : part(step, k);
          colour[r][p][k] = fmaf(T, change, colour[r][p][k]);
          if (power >= cut) T = fmaf(-alpha, T, T);
        }
      }
    }
  }

  // Closes the last colour, so that the next starts from nothing.
  __device__ void close() {
    for_each([&](int r, int p, int k) {
      const float end = C::Harmonics ? fmaf(s[r][p][k], part(last_slope, k), part(last, k)) : part(last, k);
      colour[r][p][k] = fmaf(-transmittance[r][p][k], end, colour[r][p][k]);
    });
    last = last_slope = make_float4(0, 0, 0, 0);
  }

  // Over the background.
  template <class Out>
  __device__ void store(const LensOptics& lens, int column, int row, float4 background, Out* out) {
#pragma unroll
    for (int r = 0; r < C::lane_rows; ++r) {
      float values[6];
#pragma unroll
      for (int p = 0; p < 2; ++p)
#pragma unroll
        for (int k = 0; k < 3; ++k) {
          float change = part(background, k) - part(last, k);
          if (C::Harmonics) change -= s[r][p][k] * part(last_slope, k);
          values[3 * p + k] = fmaf(transmittance[r][p][k], change, colour[r][p][k]);
        }
      store_pixels(lens, column, row + 4 * r, values, out);
    }
  }

  // As written: a division, the limit of alpha, the whole colour polynomial, the stop of what is opaque.
  __device__ void add_carefully(const LensFrame& frame, uint32_t id, float2 centre, float4 background) {
    close();
    const Splats<float>& splats = frame.splats;
    const Splat<float> splat = splat_about(splats, id, centre);
    const int order = C::Harmonics ? splats.orders[id] : 0;
    const float4* powers = reinterpret_cast<const float4*>(splats.colours) + int64_t(id) * (splats.colour_order + 1);
    const float4 highest = by_place(frame.optics, powers[order]);
    for_each([&](int r, int p, int k) {
      const float dy = y[r] - splat.v0, v = s[r][p][k];
      const float dx = x[p] - splat.u0 - splat.c0 * dy - v * fmaf(splat.c1, dy, splat.du);
      const float S = fmaf(v, fmaf(v, splat.S2, splat.S1), splat.S0);
      float& T = transmittance[r][p][k];
      const float power = splat.log2_opacity - splat.tau * dy * dy - __fdividef(dx * dx, S);
      const float alpha = fminf(fast_exp2(power), float(kMaxAlpha)), after = fmaf(-alpha, T, T);
      float c = part(highest, k);
      for (int q = order - 1; q >= 0; --q) c = fmaf(c, v, part(by_place(frame.optics, powers[q]), k));
      const bool hit = power >= frame.cut, stop = after < float(kMinTransmittance);
      // One that stops keeps its light for the background; an alpha of nothing leaves it as it is
      const float light = stop ? part(background, k) * T : fmaxf(c, 0.f) * (alpha * T);
      if (hit) colour[r][p][k] += light, T = stop ? 0 : after;
    });
  }
};

// Makes the polynomials of the first `count` <= 32 waiting hits; returns which are to be evaluated carefully.
template <class C>
__device__ unsigned specialise(const LensFrame& frame, int count, float2 centre, bool exact,
                               Staged<C::Harmonics>& staged) {
  const int lane = threadIdx.x % 32;
  bool careful = false;
  if (lane < count) {
    const uint32_t id = staged.ids[lane];
    const Splat<float> splat = splat_about(frame.splats, id, centre);
    const ShapeError error(splat);
    careful = splat.log2_opacity >= kCarefulOpacity || exact ||
              (C::Quadratic ? error.quadratic : error.linear) > kMostShapeError;
    float4 colour, slope, fit[4];
    if (C::Harmonics) {
      careful = !straight_colour(frame.splats, id, colour, slope) || careful;
      staged.slope[C::Harmonics ? lane : 0] = by_place(frame.optics, slope);
    } else {
      colour = reinterpret_cast<const float4*>(frame.splats.colours)[id];
    }
    polynomial<C>(splat, by_place(frame.optics, colour), fit);
#pragma unroll
    for (int k = 0; k < 4; ++k) staged.fit[k][lane] = fit[k];
  }
  return __ballot_sync(~0u, careful);
}

template <class C, class Out>
__device__ void draw_patch(const LensFrame& frame, const Lists& lists, uint2 range, bool exact, int left, int top,
                           float4 background, Out* out, Staged<C::Harmonics>& staged) {
  const int lane = threadIdx.x % 32, lane_x = 2 * (lane % 8), lane_y = lane / 8;
  const float2 centre = make_float2(left + 0.5f * kPatchWidth, top + 0.5f * C::patch_height);
  const float half_height = 0.5f * C::patch_height - 0.5f;
  Samples<C> samples(frame, left, top, lane_x, lane_y);

  int waiting = 0;
  for (unsigned begin = range.x; begin < range.y; begin += 32) {
    // Those of the next 32 that may touch the patch wait
    const bool inside = begin + lane < range.y;
    const uint32_t id = lists.ids[inside ? begin + lane : begin];
    const Splat<float> splat = splat_about(frame.splats, id, centre);
    const Strip strip(splat, -half_height, half_height);
    const bool hit = inside & strip.whole_rig(splat).touches(0.f, 0.5f * kPatchWidth - 0.5f);
    const unsigned hits = __ballot_sync(~0u, hit);
    if (hit) staged.ids[waiting + __popc(hits & ((1u << lane) - 1))] = id;
    waiting += __popc(hits);
    __syncwarp();
    const bool end = begin + 32 >= range.y;
    if (waiting < 32 && !(end && waiting > 0)) continue;

    // 32 of them, or at the end what there is; a second round when both the end and more than 32 have come
    do {
      const int count = min(waiting, 32);
      const unsigned careful = specialise<C>(frame, count, centre, exact, staged);
      __syncwarp();
      unsigned marks = careful;
      for (int h = 0;;) {
        const int next = marks ? __ffs(marks) - 1 : count;
#pragma unroll 1
        for (; h + 1 < next; h += 2) samples.add(staged, h, frame.cut), samples.add(staged, h + 1, frame.cut);
        if (h < next) samples.add(staged, h, frame.cut);
        if (next == count) break;
        samples.add_carefully(frame, staged.ids[next], centre, background);
        marks &= marks - 1, h = next + 1;
      }
      waiting -= count;
      const uint32_t left_over = staged.ids[32 + lane];
      __syncwarp();
      staged.ids[lane] = left_over;
      __syncwarp();
    } while (end && waiting > 0);
    if (__all_sync(~0u, samples.opaque(frame.stop))) break;
  }
  samples.store(frame.optics, left + lane_x, top + lane_y, background, out);
}

template <class C, class Out>
__device__ void draw_patches(const LensFrame& frame, const float* background, Out* out,
                             Staged<C::Harmonics> (&staged)[kWarps]) {
  constexpr unsigned kAcross = kPixelTileWidth / kPatchWidth, kDown = kPixelTileHeight / kUnitHeight;
  const float4 behind = by_place(frame.optics, make_float4(background[0], background[1], background[2], 0));
  const Lists lists(frame);
  const bool exact = frame.state->exact;
  const unsigned units = tiles_to_draw(frame, frame.pixel) * kAcross * kDown, across = unsigned(frame.pixel.across);
  WorkQueue work(frame, C::kernel);
  for (unsigned unit = blockIdx.x * kWarps + threadIdx.x / 32; unit < units;
       unit = __shfl_sync(~0u, work.claimed, 0)) {
    if (threadIdx.x % 32 == 0) work.claim(gridDim.x * kWarps);
    const unsigned tile = tile_to_draw(frame, unit / (kAcross * kDown)), part = unit % (kAcross * kDown);
    const int left = int(tile % across * kAcross + part % kAcross) * kPatchWidth;
    const int top = int(tile / across * kDown + part / kAcross) * kUnitHeight;
    if (left >= frame.optics.width_px) continue;
#pragma unroll 1
    for (int k = 0; k < kUnitHeight / C::patch_height; ++k) {
      const int y = top + k * C::patch_height;
      if (y < frame.optics.height_px)
        draw_patch<C>(frame, lists, lists.range(tile), exact, left, y, behind, out, staged[threadIdx.x / 32]);
    }
  }
}

// One kernel for both polynomials: a launch that finds nothing to do takes its time, too.
template <int lane_rows, bool Harmonics, class Out>
__global__ void __launch_bounds__(kThreads, blocks_of(lane_rows))
    composite_pixel_kernel(const __grid_constant__ LensFrame frame, const float* background, Out* out) {
  using Linear = Config<false, Harmonics, lane_rows>;
  using Quadratic = Config<true, Harmonics, lane_rows>;
  __shared__ Staged<Harmonics> staged[kWarps];
  if (frame.state->kernel == int(Linear::kernel))
    draw_patches<Linear>(frame, background, out, staged);
  else if (frame.state->kernel == int(Quadratic::kernel))
    draw_patches<Quadratic>(frame, background, out, staged);
}

template <int lane_rows, bool Harmonics, class Out>
void launch(const LensFrame& frame, const float* background, Out* out, cudaStream_t stream) {
  const auto kernel = composite_pixel_kernel<lane_rows, Harmonics, Out>;
  kernel<<<resident_blocks(kernel, kThreads, 0), kThreads, 0, stream>>>(frame, background, out);
  check_launch("composite_pixel");
}

template <bool Harmonics, class Out>
void launch_all(const LensFrame& frame, const float* background, Out* out, cudaStream_t stream) {
  launch<1, Harmonics>(frame, background, out, stream);
  launch<2, Harmonics>(frame, background, out, stream);
}

}  // namespace

void composite_pixel(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream) {
  auto draw = [&](auto* image) {
    if (frame.splats.orders)
      launch_all<true>(frame, background, image, cudaStream_t(stream));
    else
      launch_all<false>(frame, background, image, cudaStream_t(stream));
  };
  out8 ? draw(out8) : draw(out);
}

}  // namespace lfgs::cuda
