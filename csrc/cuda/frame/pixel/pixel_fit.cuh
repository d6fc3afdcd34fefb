// How composite_pixel.cu turns splats into polynomials about the centre of a warp's patch, 32 at a time. specialise()
// is what the kernel calls: it reads the splats of the waiting intersections, and writes the polynomials into the
// warp's part of shared memory.
#pragma once

#include <type_traits>

#include "cuda/stages/projection.cuh"
#include "cuda/frame/composite_frame.cuh"
#include "cuda/common/halves.cuh"
#include "cuda/frame/lens_optics.cuh"
#include "cuda/frame/kernel_cost.cuh"

namespace lfgs::cuda {

constexpr int kPatchWidth = 16;
constexpr float kFaint = -3;          // log2 of an opacity that is little more than the cuts
constexpr float kMostHalfSweep = 24;  // the most that d may change over half the rig: such halves have steps of 2^-6
constexpr float kMostHalfColour = 2;  // sums of brighter colours have too few digits in half precision
constexpr float kStraightColour = 2.5e-4f;  // coefficient of s^2 that is left out; on average a quarter is the error
constexpr float kSmallEdge = 3e-3f;         // slope with which a colour may reach zero: it errs by at most a quarter

// How samples are evaluated: r = S^(-1/2) is a straight line, or a parabola where a line is too coarse. kHalf is the
// line in half precision.
enum class Evaluation { kLinear, kQuadratic, kHalf };

// The options that a kernel is compiled for. Compensated: splats have compensations. Cells: the panel may have cells,
// which take registers that other panels do not have to spare.
template <Evaluation evaluation, bool Harmonics_, int lane_rows_, bool Cells_, bool Compensated_ = false>
struct Config {
  static constexpr bool Quadratic = evaluation == Evaluation::kQuadratic, Half = evaluation == Evaluation::kHalf;
  static constexpr bool Compensated = Compensated_, Cells = Cells_;
  static constexpr bool Harmonics = Harmonics_, Bends = Harmonics && Quadratic;  // colours may be parabolas
  static constexpr int lane_rows = lane_rows_, patch_height = 4 * lane_rows;
  // Whether slopes of colours are stored and read with the rest of an intersection's fit. That is quicker in small
  // patches and slower in large ones.
  static constexpr bool SlopesInFit = Harmonics && !Quadratic && lane_rows == 1;
  static constexpr FrameKernel kernel = lane_rows == 1
                                            ? (Quadratic ? FrameKernel::kPixelQuadraticSmall : FrameKernel::kPixelSmall)
                                            : (Quadratic ? FrameKernel::kPixelQuadratic : FrameKernel::kPixel);
};

// A colour as value + slope s + bend s^2; without harmonics there is only the value.
struct ColourFit {
  float4 value, slope, bend;
};

// The shared memory of a warp.
template <bool Harmonics>
struct Staged {
  float4 fit[4][32];  // of 32 intersections, see shape_polynomial() and put_halves()
  float4 slope[Harmonics ? 32 : 1], bend[Harmonics ? 32 : 1];  // steps of the colours in s and s^2; see SlopesInFit
  ColourFit colour;  // of the last intersection so far; zero if that was exact
  uint32_t ids[64];  // the intersections that wait: fewer than 32, plus the intersections of one cull
};

// With compensation also its slope and bend, see compensation_fit(); its value is in the fit.
template <bool Harmonics>
struct CompensatedStaged : Staged<Harmonics> {
  float2 compensation[32];
};
template <class C>
using StagedOf = std::conditional_t<C::Compensated, CompensatedStaged<C::Harmonics>, Staged<C::Harmonics>>;

// Bits of up to 32 intersections: those that need the exact formulas; and those of the others that are special. A
// special one has a parabola for r or for the step of the colour, or is cut in half precision.
struct Marks {
  unsigned needs_exact, special;
};

// r = S^(-1/2) as x + y s + z s^2, by interpolation: see kLinePlace.
__device__ inline float3 root_fit(const Splat<float>& s, bool curved) {
  auto root = [&](float v) { return fast_rsqrt(fmaf(v, fmaf(v, s.S2, s.S1), s.S0)); };
  const float node = curved ? kParabolaPlace : kLinePlace, right = root(node), left = root(-node);
  const float middle = curved ? root(0.f) : 0.5f * (right + left);
  return make_float3(middle, (right - left) * (curved ? kParabolaPlace : 1.f), right + left - 2 * middle);
}

// Log2 of the compensation of a splat, as x + y s + z s^2, by interpolation: see kLinePlace. x is NaN where that is too
// coarse at the ends of the rig, where it errs most.
__device__ inline float3 compensation_fit(const Compensation<float>& c, const Splat<float>& s) {
  constexpr float kMostError = 2e-4f;  // alpha is off by less than 0.04/255, on average by a tenth of that
  auto log2_at = [&](float v) { return log2_compensation(c, v, fmaf(v, fmaf(v, s.S2, s.S1), s.S0)); };
  const float middle = log2_at(0.f), left = log2_at(-kParabolaPlace), right = log2_at(kParabolaPlace);
  const float slope = (right - left) * kParabolaPlace, bend = right + left - 2 * middle;
  auto error = [&](float v) { return fabsf(log2_at(v) - fmaf(v, fmaf(v, bend, slope), middle)); };
  return make_float3(error(-1.f) <= kMostError && error(1.f) <= kMostError ? middle : NAN, slope, bend);
}

// Write the polynomial of d and the other terms of a sample into the vectors f0 to f3 of a fit.
//   d = (f0.x + f1.y x + f0.y y) + s (f0.z + f1.z x + f0.w y) + s^2 (f1.x + [f3.y x + f3.z y]) + [s^3 f3.w],
//   exponent = f1.w - (f2.x + f2.y y)^2 - d^2.
// The terms in [] are there only when r is curved. The step of the colour is in (f2.z, f2.w, f3.x). Kernels without
// curved r may have the step of the colour's slope in (f3.y, f3.z, f3.w).
__device__ inline void shape_polynomial(const Splat<float>& s, float3 r, float4 fit[4]) {
  const float E = fmaf(s.c0, s.v0, -s.u0), sweep = fmaf(-s.c1, s.v0, s.du);
  const float t = s.tau * fast_rsqrt(fmaxf(s.tau, 1e-37f));
  fit[0] = make_float4(r.x * E, -r.x * s.c0, fmaf(r.y, E, -r.x * sweep), -fmaf(r.y, s.c0, r.x * s.c1));
  fit[1] = make_float4(fmaf(r.z, E, -r.y * sweep), r.x, r.y, s.log2_opacity);
  fit[2] = make_float4(-t * s.v0, t, 0, 0);
  fit[3] = make_float4(0, r.z, -fmaf(r.z, s.c0, r.y * s.c1), -r.z * sweep);
}

// The unit of s in half precision: the step from view to view times a power of 2. The middles of views are whole
// numbers of half steps, so they are exact in this unit.
__device__ inline float half_unit(const LensOptics& lens) {
  return lens.s_step != 0 ? lens.s_step * exp2f(ceilf(log2f(0.5f * float(lens.views)))) : 1.f;
}

// Turn a fit of shape_polynomial(), with the steps of its colour, into the form for half precision. v is s / unit.
//   d = (f0.x + f0.y x + f0.z y) + v (h0 + h1 x + h2 y) + v^2 h3,   exponent = f0.w - (f1.x + f1.y y)^2 - d^2.
// f1.z holds h0 and h1, f1.w holds h2 and h3. f2 holds the three steps of the colour and of its slope, as halves.
__device__ inline void put_halves(float4 fit[4], float4 slope, float unit) {
  const float4 f0 = fit[0], f1 = fit[1];
  fit[0] = make_float4(f0.x, f1.y, f0.y, fminf(f1.w, float(kLog2MaxAlpha)));
  fit[1] = make_float4(fit[2].x, fit[2].y, packed(unit * f0.z, unit * f1.z), packed(unit * f0.w, unit * unit * f1.x));
  fit[2] = make_float4(packed(fit[2].z, fit[2].w), packed(fit[3].x, unit * slope.x),
                       packed(unit * slope.y, unit * slope.z), 0);
}

__device__ inline float largest(float4 c) { return fmaxf(fabsf(c.x), fmaxf(fabsf(c.y), fabsf(c.z))); }

// Fits the colour polynomial of a splat by a line over s, or by a parabola where the kernel can and must; see
// kLinePlace. Return false where that is too coarse.
template <bool Bends>
__device__ bool fit_colour(const DirectFrame& frame, uint32_t id, ColourFit& fit) {
  constexpr float kMostOrder = 4;
  const Splats<float>& splats = frame.splats;
  const float4* powers = reinterpret_cast<const float4*>(splats.colours) + int64_t(id) * (splats.colour_order + 1);
  const float4 none = make_float4(0, 0, 0, 0), c0 = powers[0], c1 = powers[1], c2 = powers[2];

  // Powers beyond the order are stored as zero up to the second, and are not there from the third on
  const float order = c0.w;
  const float4 c3 = order >= 3 ? powers[3] : none, c4 = order >= 4 ? powers[4] : none;

  // Whether it needs a bend, and whether the terms left out then are small enough
  const float most = fmaxf(kStraightColour, frame.left_out), beyond = largest(c3) + largest(c4);
  const bool bent = largest(c2) + beyond > most;
  bool good = (!bent || (Bends && beyond <= most)) && order <= kMostOrder;

  // The fit of each channel: what interpolation through -+ sqrt(square), and 0 if bent, makes of the powers
  const float square = bent ? 0.5f : kLinePlace * kLinePlace;
  auto channel = [&](float p0, float p1, float p2, float p3, float p4, float& value, float& slope, float& bend) {
    const float even = fmaf(square, p4, p2);
    value = bent ? p0 : fmaf(square, even, p0), slope = fmaf(square, p3, p1), bend = bent ? even : 0.f;
    if (value + fabsf(slope) + fmaxf(bend, 0.f) <= 0) value = slope = bend = 0;
    if (value + fminf(bend, 0.f) >= fabsf(slope)) return;
    // The colour reaches zero within the rig, where it has an edge. If that is small, the line goes through what shows
    // at -+ kLinePlace, where nothing is below zero
    good = good && !bent && fabsf(slope) <= kSmallEdge;
    const float high = fmaxf(fmaf(kLinePlace, slope, value), 0.f), low = fmaxf(fmaf(-kLinePlace, slope, value), 0.f);
    value = 0.5f * (high + low), slope = (0.5f / kLinePlace) * (high - low);
  };
  channel(c0.x, c1.x, c2.x, c3.x, c4.x, fit.value.x, fit.slope.x, fit.bend.x);
  channel(c0.y, c1.y, c2.y, c3.y, c4.y, fit.value.y, fit.slope.y, fit.bend.y);
  channel(c0.z, c1.z, c2.z, c3.z, c4.z, fit.value.z, fit.slope.z, fit.bend.z);
  return good;
}

// Turn every lane's colour into the step from the colour of the lane before. The first lane's step is from `last`,
// which then becomes the colour of lane count - 1. By all lanes of a warp.
__device__ inline float4 steps(float4 colour, int count, float4& last) {
  const int lane = threadIdx.x % 32;
  const float4 first = last;
  auto before = [&](float c, float of_first) {
    const float c_before = __shfl_up_sync(~0u, c, 1);
    return lane == 0 ? of_first : c_before;
  };
  const float4 step = make_float4(colour.x - before(colour.x, first.x), colour.y - before(colour.y, first.y),
                                  colour.z - before(colour.z, first.z), 0);
  __syncwarp();
  if (lane == count - 1) last = colour;
  return step;
}

// Whether half precision is too coarse for a splat. It is where d changes more over the rig than the digits allow, or
// where the colour is too large or NaN.
template <class C>
__device__ bool too_coarse_in_half(const float4 fit[2], const ColourFit& colour) {
  const float sweep = fabsf(fit[0].z) + 0.5f * kPatchWidth * fabsf(fit[1].z) + 0.5f * C::patch_height * fabsf(fit[0].w);
  return !(sweep <= kMostHalfSweep) || !(largest(colour.value) + largest(colour.slope) <= kMostHalfColour);
}

// Make the polynomials of the first `count` <= 32 waiting intersections, one a lane. Exact intersections have the
// colour zero, so that their step takes the colour of the intersection before off again.
template <class C>
__device__ Marks specialise(const DirectFrame& frame, int count, float2 centre, StagedOf<C>& staged) {
  const int lane = threadIdx.x % 32;
  const bool inside = lane < count;

  // Whether the line, or the parabola if the kernel has it, is good enough for the shape
  const uint32_t id = staged.ids[inside ? lane : 0];
  Splat<float> splat = whole_splat_about(frame.splats, id, centre);
  const ShapeError error(splat);
  const bool curved = C::Quadratic && error.linear > frame.state->choice.straight;
  bool needs_exact = (!C::Half && splat.log2_opacity >= kExactOpacity) ||
                     (curved ? error.quadratic : error.linear) > frame.state->choice.needs_exact;
  if constexpr (C::Compensated) {
    const float3 compensation = compensation_fit(frame.splats.compensations[id], splat);
    needs_exact = needs_exact || !(compensation.x <= 0.5f);
    splat.log2_opacity += compensation.x, staged.compensation[lane] = make_float2(compensation.y, compensation.z);
  }

  // The fits of colour and shape
  ColourFit colour = {};
  float4 fit[4];
  if (C::Harmonics)
    needs_exact = !fit_colour<C::Bends>(frame, id, colour) || needs_exact;
  else
    colour.value = reinterpret_cast<const float4*>(frame.splats.colours)[id];
  shape_polynomial(splat, root_fit(splat, curved), fit);
  if (C::Half) needs_exact = needs_exact || too_coarse_in_half<C>(fit, colour);

  // Colours become steps, and find their places in the fit
  if (needs_exact) colour = {};
  auto to_step = [&](float4 part, float4& last) { return steps(by_place<C::Cells>(frame.optics, part), count, last); };
  const float4 step = to_step(colour.value, staged.colour.value);
  fit[2].z = step.x, fit[2].w = step.y, fit[3].x = step.z;
  float4 slope = colour.slope, bend = colour.bend;
  if constexpr (C::Harmonics) slope = to_step(slope, staged.colour.slope);
  if constexpr (C::Harmonics && !C::SlopesInFit) staged.slope[lane] = slope;
  if constexpr (C::Bends) staged.bend[lane] = bend = to_step(bend, staged.colour.bend);
  if constexpr (C::SlopesInFit) fit[3] = make_float4(step.z, slope.x, slope.y, slope.z);
  if (C::Half) put_halves(fit, slope, half_unit(frame.optics));

  // Store it, and mark the intersections that need more than the usual
#pragma unroll
  for (int k = 0; k < (C::Half ? 3 : 4); ++k) staged.fit[k][lane] = fit[k];
  const bool parabola = curved || (C::Bends && largest(bend) > 0);
  const bool is_cut = C::Half && (splat.log2_opacity < kFaint || frame.cut <= frame.sample_cut);
  return {__ballot_sync(~0u, inside && needs_exact),
          __ballot_sync(~0u, inside && (parabola || is_cut) && !needs_exact)};
}

}  // namespace lfgs::cuda
