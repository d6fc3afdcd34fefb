// Gaussians as composite_pixel.cu evaluates them: polynomials about the centre of a warp's patch, made 32 at a time.
#pragma once

#include "cuda/composite_lens.cuh"
#include "cuda/halves.cuh"
#include "cuda/lens_optics.cuh"
#include "cuda/lens_plan.cuh"

namespace lfgs::cuda {

constexpr int kPatchWidth = 16;
constexpr float kMostHalfSweep = 16;             // change of d over half the rig: halves below have steps of 2^-7
constexpr float kMostHalfColour = 2;             // sums of brighter ones have too few digits
constexpr float kMostColourCurvature = 2.5e-4f;  // dropped s^2 of a colour: half of it is the error

// How samples are evaluated: with a straight line for r = S^(-1/2); with a parabola for splats of which that is too
// rough; with a straight line in half precision.
enum class Evaluation { kLinear, kQuadratic, kHalf };

template <Evaluation evaluation, bool Harmonics_, int lane_rows_>
struct Config {
  static constexpr bool Quadratic = evaluation == Evaluation::kQuadratic, Half = evaluation == Evaluation::kHalf;
  static constexpr bool Harmonics = Harmonics_;
  static constexpr int lane_rows = lane_rows_, patch_height = 4 * lane_rows;
  static constexpr LensKernel kernel =
      lane_rows == 1 ? (Quadratic ? LensKernel::kPixelQuadraticSmall : LensKernel::kPixelSmall)
                     : (Quadratic ? LensKernel::kPixelQuadratic : LensKernel::kPixel);
};

// What a warp keeps in shared memory.
template <bool Harmonics>
struct Staged {
  float4 fit[4][32];                 // of 32 hits, see shape_polynomial() and put_halves()
  float4 slope[Harmonics ? 32 : 1];  // of colours in s, as steps
  float4 colour, colour_slope;       // of the last hit so far; of a careful one nothing
  uint32_t ids[64];                  // hits that wait: fewer than 32, and those of one cull
};

// Of up to 32 hits those that are evaluated as they are written, and those with a parabola.
struct Marks {
  unsigned careful, curved;
};

// r = S^(-1/2) as r0 + r1 s + r2 s^2, through the zeros of Chebyshev's polynomials of the second kind, for the least
// mean error.
__device__ inline float3 root_fit(const Splat<float>& s, bool curved) {
  auto root = [&](float v) { return fast_rsqrt(fmaf(v, fmaf(v, s.S2, s.S1), s.S0)); };
  const float node = curved ? 0.70710678f : 0.5f, right = root(node), left = root(-node);  // and 0, when curved
  const float middle = curved ? root(0.f) : 0.5f * (right + left);
  return make_float3(middle, (right - left) * (curved ? 0.70710678f : 1.f), right + left - 2 * middle);
}

// The polynomial of d and the rest of what a sample needs:
//   d = (f0.x + f1.y x + f0.y y) + s (f0.z + f1.z x + f0.w y) + s^2 (f1.x + [f3.y x + f3.z y]) + [s^3 f3.w],
//   exponent = f1.w - (f2.x + f2.y y)^2 - d^2;   step of the colour (f2.z, f2.w, f3.x). [] only when curved.
__device__ inline void shape_polynomial(const Splat<float>& s, float3 r, float4 fit[4]) {
  const float E = fmaf(s.c0, s.v0, -s.u0), sweep = fmaf(-s.c1, s.v0, s.du);
  const float t = s.tau * fast_rsqrt(fmaxf(s.tau, 1e-37f));
  fit[0] = make_float4(r.x * E, -r.x * s.c0, fmaf(r.y, E, -r.x * sweep), -fmaf(r.y, s.c0, r.x * s.c1));
  fit[1] = make_float4(fmaf(r.z, E, -r.y * sweep), r.x, r.y, s.log2_opacity);
  fit[2] = make_float4(-t * s.v0, t, 0, 0);
  fit[3] = make_float4(0, r.z, -fmaf(r.z, s.c0, r.y * s.c1), -r.z * sweep);
}

// Power of 2 times the step of s from view to view: middles of views are whole numbers of halves of it.
__device__ inline float half_unit(const LensOptics& lens) {
  return lens.s_step != 0 ? lens.s_step * exp2f(ceilf(log2f(0.5f * float(lens.views)))) : 1.f;
}

// Puts a fit as shape_polynomial() makes it, with its step, into halves: with v = s / unit,
//   d = (f0.x + f0.y x + f0.z y) + v (h0 + h1 x + h2 y) + v^2 h3,   exponent = f0.w - (f1.x + f1.y y)^2 - d^2;
// f1.z holds h0 and h1, f1.w h2 and h3, f2 the three steps of the colour and of its slope.
__device__ inline void put_halves(float4 fit[4], float4 slope, float unit) {
  const float4 f0 = fit[0], f1 = fit[1];
  fit[0] = make_float4(f0.x, f1.y, f0.y, f1.w);
  fit[1] = make_float4(fit[2].x, fit[2].y, packed(unit * f0.z, unit * f1.z), packed(unit * f0.w, unit * unit * f1.x));
  fit[2] = make_float4(packed(fit[2].z, fit[2].w), packed(fit[3].x, unit * slope.x),
                       packed(unit * slope.y, unit * slope.z), 0);
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

// Every lane's colour as a step from that of the lane before, the first one's from `last`, which becomes that of lane
// count - 1. By all lanes of a warp.
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

__device__ inline float largest(float4 c) { return fmaxf(fabsf(c.x), fmaxf(fabsf(c.y), fabsf(c.z))); }

// Whether half precision is too rough for a splat: d changes by more over the rig than it has digits, somewhere in the
// patch; or its colour is too bright, or no number.
template <class C>
__device__ bool too_rough_in_half(const float4 fit[2], float4 colour, float4 slope) {
  const float sweep = fabsf(fit[0].z) + 0.5f * kPatchWidth * fabsf(fit[1].z) + 0.5f * C::patch_height * fabsf(fit[0].w);
  return !(sweep <= kMostHalfSweep) || !(largest(colour) + largest(slope) <= kMostHalfColour);
}

// Makes the polynomials of the first `count` <= 32 waiting hits. A careful hit's step closes the colour before it.
template <class C>
__device__ Marks specialise(const LensFrame& frame, int count, float2 centre, Staged<C::Harmonics>& staged) {
  const int lane = threadIdx.x % 32;
  const bool inside = lane < count;
  const uint32_t id = staged.ids[inside ? lane : 0];
  const Splat<float> splat = splat_about(frame.splats, id, centre);
  const ShapeError error(splat);
  const bool curved = C::Quadratic && error.linear > frame.state->straight;
  bool careful = splat.log2_opacity >= kCarefulOpacity ||
                 (curved ? error.quadratic : error.linear) > frame.state->careful;
  float4 colour, slope = make_float4(0, 0, 0, 0), fit[4];
  if (C::Harmonics)
    careful = !straight_colour(frame.splats, id, colour, slope) || careful;
  else
    colour = reinterpret_cast<const float4*>(frame.splats.colours)[id];
  shape_polynomial(splat, root_fit(splat, curved), fit);
  if (C::Half) careful = careful || too_rough_in_half<C>(fit, colour, slope);
  if (careful) colour = slope = make_float4(0, 0, 0, 0);
  const float4 step = steps(by_place(frame.optics, colour), count, staged.colour);
  fit[2].z = step.x, fit[2].w = step.y, fit[3].x = step.z;
  if (C::Harmonics) slope = steps(by_place(frame.optics, slope), count, staged.colour_slope);
  if (C::Half)
    put_halves(fit, slope, half_unit(frame.optics));
  else if (C::Harmonics)
    staged.slope[C::Harmonics ? lane : 0] = slope;
#pragma unroll
  for (int k = 0; k < (C::Half ? 3 : 4); ++k) staged.fit[k][lane] = fit[k];
  return {__ballot_sync(~0u, inside && careful), __ballot_sync(~0u, inside && curved && !careful)};
}

}  // namespace lfgs::cuda
