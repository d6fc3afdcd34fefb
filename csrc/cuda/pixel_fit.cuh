// Gaussians as composite_pixel.cu evaluates them: polynomials about the centre of a warp's patch, made 32 at a time.
#pragma once

#include "cuda/composite_lens.cuh"
#include "cuda/lens_optics.cuh"
#include "cuda/lens_plan.cuh"

namespace lfgs::cuda {

constexpr int kPatchWidth = 16;
constexpr float kCarefulOpacity = -0.0291f;      // log2(0.98): what an opaque splat stops is less than 2/255
constexpr float kMostColourCurvature = 2.5e-4f;  // dropped s^2 of a colour: half of it is the error

// How a patch is drawn. Quadratic: splats of which a straight line is too rough have a parabola for r.
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
  float4 fit[4][32];                  // of 32 hits, see polynomial()
  float4 slope[Harmonics ? 32 : 1];   // of colours in s, as steps
  float4 colour, colour_slope;        // of the last hit so far; of a careful one nothing
  uint32_t ids[64];                   // hits that wait: fewer than 32, and those of one cull
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
__device__ inline void polynomial(const Splat<float>& s, float3 r, float4 step, float4 fit[4]) {
  const float E = fmaf(s.c0, s.v0, -s.u0), sweep = fmaf(-s.c1, s.v0, s.du);
  const float t = s.tau * fast_rsqrt(fmaxf(s.tau, 1e-37f));
  fit[0] = make_float4(r.x * E, -r.x * s.c0, fmaf(r.y, E, -r.x * sweep), -fmaf(r.y, s.c0, r.x * s.c1));
  fit[1] = make_float4(fmaf(r.z, E, -r.y * sweep), r.x, r.y, s.log2_opacity);
  fit[2] = make_float4(-t * s.v0, t, step.x, step.y);
  fit[3] = make_float4(step.z, r.z, -fmaf(r.z, s.c0, r.y * s.c1), -r.z * sweep);
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

// Makes the polynomials of the first `count` <= 32 waiting hits. A careful hit's step closes the colour before it.
template <class C>
__device__ Marks specialise(const LensFrame& frame, int count, float2 centre,
                            Staged<C::Harmonics>& staged) {
  const int lane = threadIdx.x % 32;
  bool careful = false, curved = false;
  const uint32_t id = staged.ids[lane < count ? lane : 0];
  const Splat<float> splat = splat_about(frame.splats, id, centre);
  const ShapeError error(splat);
  curved = C::Quadratic && error.linear > frame.state->straight;
  careful = splat.log2_opacity >= kCarefulOpacity || frame.state->exact ||
            (curved ? error.quadratic : error.linear) > kMostShapeError;
  float4 colour, slope = make_float4(0, 0, 0, 0), fit[4];
  if (C::Harmonics)
    careful = !straight_colour(frame.splats, id, colour, slope) || careful;
  else
    colour = reinterpret_cast<const float4*>(frame.splats.colours)[id];
  if (careful) colour = slope = make_float4(0, 0, 0, 0);
  polynomial(splat, root_fit(splat, curved), steps(by_place(frame.optics, colour), count, staged.colour), fit);
  if (C::Harmonics) {
    const float4 step = steps(by_place(frame.optics, slope), count, staged.colour_slope);
    staged.slope[C::Harmonics ? lane : 0] = step;
  }
#pragma unroll
  for (int k = 0; k < 4; ++k) staged.fit[k][lane] = fit[k];
  const bool inside = lane < count;
  return {__ballot_sync(~0u, inside && careful), __ballot_sync(~0u, inside && curved && !careful)};
}

}  // namespace lfgs::cuda
