// A hit in composite_pixel.cu as a lane adds it to its samples: the polynomials that specialise() made, or for careful
// hits the splat itself.
#pragma once

#include "cuda/common/compensated.cuh"
#include "cuda/frame/composite_frame.cuh"
#include "cuda/frame/pixel/pixel_fit.cuh"

namespace lfgs::cuda {

// The part of a colour at place k.
__device__ inline float part(float4 c, int k) { return k == 0 ? c.x : k == 1 ? c.y : c.z; }

// The step from the colour of the hit before to that of hit i.
template <class C>
struct ColourStep {
  float4 value, slope, bend;

  __device__ ColourStep(const Staged<C::Harmonics>& staged, int i)
      : value(make_float4(staged.fit[2][i].z, staged.fit[2][i].w, staged.fit[3][i].x, 0)),
        slope(C::SlopesInFit ? shifted(staged.fit[3][i])
              : C::Harmonics ? staged.slope[i]
                             : value),
        bend(C::Harmonics ? staged.bend[i] : value) {}
  __device__ static float4 shifted(float4 f) { return make_float4(f.y, f.z, f.w, 0); }
  // At place k, seen from s. Bent: whether it may be a parabola.
  template <bool Bent>
  __device__ float at(int k, float s) const {
    const float line = C::Bends && Bent ? fmaf(s, part(bend, k), part(slope, k)) : part(slope, k);
    return C::Harmonics ? fmaf(s, line, part(value, k)) : part(value, k);
  }
};

// The polynomials of hit i in s at a lane's first pixel, x and y from the centre of the patch; see shape_polynomial().
// Parabola: whether it is special.
template <class C, bool Parabola>
struct HitFit {
  static constexpr bool Curved = C::Quadratic && Parabola;
  float4 f0, f1, f2, f3;
  ColourStep<C> step;
  float2 share;
  float t, c0, c1, c2;

  __device__ HitFit(const StagedOf<C>& staged, int i, float x, float y)
      : f0(staged.fit[0][i]), f1(staged.fit[1][i]), f2(staged.fit[2][i]), f3(staged.fit[3][i]), step(staged, i) {
    if constexpr (C::Compensated) share = staged.share[i];
    t = fmaf(f2.y, y, f2.x);
    c0 = fmaf(f1.y, x, fmaf(f0.y, y, f0.x));
    c1 = fmaf(f1.z, x, fmaf(f0.w, y, f0.z));
    c2 = Curved ? fmaf(f3.y, x, fmaf(f3.z, y, f1.x)) : f1.x;
  }

  // The same in row r of the lane, which is 4 r rows on; A is what the exponent has of y alone.
  struct Row {
    float A, c0, c1, c2;

    // The exponent in pixel p of the row, seen from v.
    __device__ float exponent(const HitFit& hit, int p, float v) const {
      const float p0 = p ? c0 + hit.f1.y : c0, p1 = p ? c1 + hit.f1.z : c1, p2 = Curved && p ? c2 + hit.f3.y : c2;
      const float d = fmaf(v, fmaf(v, Curved ? fmaf(v, hit.f3.w, p2) : p2, p1), p0);
      return fmaf(-d, d, C::Compensated ? fmaf(v, fmaf(v, hit.share.y, hit.share.x), A) : A);
    }
  };
  __device__ Row row(int r) const {
    const float steps = 4.f * r, at = r ? fmaf(steps, f2.y, t) : t;
    if (r == 0) return {fmaf(-at, at, f1.w), c0, c1, c2};
    return {fmaf(-at, at, f1.w), fmaf(steps, f0.y, c0), fmaf(steps, f0.w, c1), Curved ? fmaf(steps, f3.z, c2) : c2};
  }
};

// Adds a careful hit to one sample, by the formulas as they are written: with a division, the limit of alpha, the whole
// colour polynomial and the end of samples that become opaque; with compensation with the share of opacity.
template <class C>
struct CarefulHit {
  const LensFrame& frame;
  Splat<float> splat;
  Compensation<float> compensation;
  int order;
  const float4* powers;
  float4 highest, background;

  __device__ CarefulHit(const LensFrame& frame, uint32_t id, float2 centre, float4 background)
      : frame(frame),
        splat(whole_splat_about(frame.splats, id, centre)),
        compensation(C::Compensated ? frame.splats.compensations[id] : Compensation<float>{}),
        order(C::Harmonics ? frame.splats.orders[id] : 0),
        powers(reinterpret_cast<const float4*>(frame.splats.colours) + int64_t(id) * (frame.splats.colour_order + 1)),
        highest(by_place<C::Cells>(frame.optics, powers[order])),
        background(background) {}

  __device__ void add(float x, float y, float s, int k, float& T, float& colour) const {
    const float dy = y - splat.v0, dx = x - splat.u0 - splat.c0 * dy - s * fmaf(splat.c1, dy, splat.du);
    const float S = fmaf(s, fmaf(s, splat.S2, splat.S1), splat.S0);
    float power = splat.log2_opacity - splat.tau * dy * dy - __fdividef(dx * dx, S);
    if constexpr (C::Compensated) power += log2_share(compensation, s, S);
    const float alpha = fminf(fast_exp2(power), float(kMaxAlpha)), after = fmaf(-alpha, T, T);
    float c = part(highest, k);
    for (int q = order - 1; q >= 0; --q) c = fmaf(c, s, part(by_place<C::Cells>(frame.optics, powers[q]), k));
    // A sample that should have ended before takes no more, see ended()
    const bool hit = power >= frame.hit_cut && T >= float(kMinTransmittance), stop = after < float(kMinTransmittance);
    // A sample that ends here keeps its light for the background. Where this splat draws nothing, nothing changes
    const float light = stop ? part(background, k) * T : fmaxf(c, 0.f) * (alpha * T);
    if (hit) colour += light, T = stop ? 0 : after;
  }
};

}  // namespace lfgs::cuda
