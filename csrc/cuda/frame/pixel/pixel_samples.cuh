// The samples of a lane in composite_pixel.cu: where they stand, what they hold, and how an intersection is added to
// them. They read the polynomials that specialise() made, and at the end write the pixels of the image. In the
// functions below, r is a row of the lane, p one of its two pixels there, and k a place in the pixel.
#pragma once

#include "cuda/stages/projection.cuh"
#include "cuda/frame/composite_frame.cuh"
#include "cuda/frame/lens_optics.cuh"
#include "cuda/frame/pixel/pixel_fit.cuh"
#include "math/colour_circle.h"

namespace lfgs::cuda {

// The part of a colour at place k.
__device__ inline float part(float4 c, int k) { return k == 0 ? c.x : k == 1 ? c.y : c.z; }

// A lane's pixels: two neighbours in every fourth row of the patch, from row lane / 8 on.
template <int lane_rows>
struct LanePixels {
  int column, row;  // of the lane's first pixel
  float x, y;       // centre of that pixel, from the centre of the patch

  __device__ LanePixels(int left, int top) {
    const int lane = threadIdx.x % 32, lane_x = 2 * (lane % 8), lane_y = lane / 8;
    column = left + lane_x, row = top + lane_y;
    x = lane_x + 0.5f - 0.5f * kPatchWidth, y = lane_y + 0.5f - 0.5f * 4 * lane_rows;
  }
  // Whether a pixel is on the panel.
  __device__ bool seen(const LensOptics& lens, int r, int p) const {
    return row + 4 * r < lens.height_px && column + p < lens.width_px;
  }
  // Call visit(r, p, k) for the sub-pixels.
  template <class Visit>
  __device__ static void for_each(const Visit& visit) {
#pragma unroll
    for (int r = 0; r < lane_rows; ++r)
#pragma unroll
      for (int p = 0; p < 2; ++p)
#pragma unroll
        for (int k = 0; k < 3; ++k) visit(r, p, k);
  }
  // Call visit(r, p, k, s) for the sub-pixels, with the offset from which each is seen.
  template <bool Cells, class Visit>
  __device__ void for_each_offset(const LensOptics& lens, const Visit& visit) const {
#pragma unroll
    for (int r = 0; r < lane_rows; ++r)
#pragma unroll
      for (int p = 0; p < 2; ++p) {
        uint64_t phase = phase_at(lens, row + 4 * r, 3 * (column + p));
        const uint64_t* beyond = lens.cells.phases[row % kCellPeriod] + 3 * ((column + p) % kCellPeriod);
#pragma unroll
        for (int k = 0; k < 3; ++k, phase += lens.phase_x) {
          const uint64_t own = Cells && lens.has_cells ? phase + beyond[k] : phase;
          visit(r, p, k, fmaf(lens.s_step, camera_offset(lens, own), lens.s_start));
        }
      }
  }
  // Put the sub-pixels value(r, p, k) into the image.
  template <bool Cells, class Out, class Value>
  __device__ void store(const LensOptics& lens, Out* out, const Value& value) const {
#pragma unroll
    for (int r = 0; r < lane_rows; ++r) {
      float values[6];
#pragma unroll
      for (int p = 0; p < 2; ++p)
#pragma unroll
        for (int k = 0; k < 3; ++k) values[3 * p + k] = value(r, p, k);
      store_pixels<Cells>(lens, column, row + 4 * r, values, out);
    }
  }
};

// The step from the colour of the last intersection, seen from s, to that of the background.
template <class C>
__device__ float last_step(const Staged<C::Harmonics>& staged, float4 background, float s, int k) {
  const ColourFit& last = staged.colour;
  const float step = part(background, k) - part(last.value, k);
  const float slope = C::Bends ? fmaf(s, part(last.bend, k), part(last.slope, k)) : part(last.slope, k);
  return C::Harmonics ? fmaf(-s, slope, step) : step;
}

// The part in a channel of a colour on a circle. A function of its own, so that the kernels keep their registers.
__device__ inline __noinline__ float circle_part(const float4* terms, int channel, float s) {
  const CirclePoint<float> point(terms[kPlaceTerm].w, terms[kDistanceTerm].w, s);
  return point.colour([&](int m) { return reinterpret_cast<const float*>(terms + m)[channel]; });
}

// Add an exact intersection to one sample: with a division, the limit of alpha and the compensation. The colour is the
// whole polynomial, or on its circle. Samples that become opaque end.
template <class C>
struct ExactIntersection {
  const DirectFrame& frame;
  Splat<float> splat;
  Compensation<float> compensation;
  int order;
  const float4* powers;
  float4 highest, background;

  __device__ ExactIntersection(const DirectFrame& frame, uint32_t id, float2 centre, float4 background)
      : frame(frame),
        splat(whole_splat_about(frame.splats, id, centre)),
        compensation(C::Compensated ? frame.splats.compensations[id] : Compensation<float>{}),
        order(C::Harmonics ? frame.splats.orders[id] : 0),
        powers(reinterpret_cast<const float4*>(frame.splats.colours) + int64_t(id) * (frame.splats.colour_order + 1)),
        highest(by_place<C::Cells>(frame.optics, powers[max(order, 0)])),
        background(background) {}

  __device__ void add(float x, float y, float s, int k, float& T, float& colour) const {
    const float dy = y - splat.v0, dx = x - splat.u0 - splat.c0 * dy - s * fmaf(splat.c1, dy, splat.du);
    const float S = fmaf(s, fmaf(s, splat.S2, splat.S1), splat.S0);
    float power = splat.log2_opacity - splat.tau * dy * dy - __fdividef(dx * dx, S);
    if constexpr (C::Compensated) power += log2_compensation(compensation, s, S);
    const float alpha = fminf(fast_exp2(power), float(kMaxAlpha)), after = fmaf(-alpha, T, T);
    float c = part(highest, k);
    if (C::Harmonics && order == kCircleOrder) c = circle_part(powers, frame.optics.channels[k], s);
    for (int q = order - 1; q >= 0; --q) c = fmaf(c, s, part(by_place<C::Cells>(frame.optics, powers[q]), k));
    // A sample that should have ended before takes no more, see ended()
    const bool drawn = power >= frame.sample_cut && T >= float(kMinTransmittance),
               stop = after < float(kMinTransmittance);
    // A sample that ends here keeps its light for the background. Where this splat draws nothing, nothing changes
    const float light = stop ? part(background, k) * T : fmaxf(c, 0.f) * (alpha * T);
    if (drawn) colour += light, T = stop ? 0 : after;
  }
};

// A lane's samples in float.
template <class C>
struct FloatSamples {
  LanePixels<C::lane_rows> pixels;
  float s[C::lane_rows][2][3], colour[C::lane_rows][2][3], transmittance[C::lane_rows][2][3];

  __device__ FloatSamples(const DirectFrame& frame, int left, int top) : pixels(left, top) {
    pixels.template for_each_offset<C::Cells>(frame.optics, [&](int r, int p, int k, float offset) {
      s[r][p][k] = offset, colour[r][p][k] = 0, transmittance[r][p][k] = pixels.seen(frame.optics, r, p) ? 1.f : 0.f;
    });
  }

  // Whether all samples are done.
  __device__ bool opaque(float stop) const {
    bool all = true;
    pixels.for_each([&](int r, int p, int k) { all = all && transmittance[r][p][k] < stop; });
    return all;
  }

  // The step of the colour of intersection i at place k, seen from s.
  struct Step {
    float4 value, slope, bend;

    __device__ Step(const Staged<C::Harmonics>& staged, int i)
        : value(make_float4(staged.fit[2][i].z, staged.fit[2][i].w, staged.fit[3][i].x, 0)),
          slope(C::SlopesInFit ? shifted(staged.fit[3][i])
                : C::Harmonics ? staged.slope[i]
                               : value),
          bend(C::Harmonics ? staged.bend[i] : value) {}
    __device__ static float4 shifted(float4 f) { return make_float4(f.y, f.z, f.w, 0); }
    template <bool Bent>
    __device__ float at(int k, float s) const {
      const float line = C::Bends && Bent ? fmaf(s, part(bend, k), part(slope, k)) : part(slope, k);
      return C::Harmonics ? fmaf(s, line, part(value, k)) : part(value, k);
    }
  };

  // Add intersection i, see shape_polynomial() for the polynomial. Parabola: whether it is special, that is, has a
  // parabola for r or for the step of its colour.
  template <bool Parabola>
  __device__ void add(const StagedOf<C>& staged, int i, float cut) {
    constexpr bool Curved = C::Quadratic && Parabola;
    const float4 f0 = staged.fit[0][i], f1 = staged.fit[1][i], f2 = staged.fit[2][i], f3 = staged.fit[3][i];
    const Step step(staged, i);
    float2 compensation;
    if constexpr (C::Compensated) compensation = staged.compensation[i];

    // The polynomials in s at the lane's first pixel; the other pixels are a step away in x, and four steps in y
    float t = fmaf(f2.y, pixels.y, f2.x);
    float c0 = fmaf(f1.y, pixels.x, fmaf(f0.y, pixels.y, f0.x));
    float c1 = fmaf(f1.z, pixels.x, fmaf(f0.w, pixels.y, f0.z));
    float c2 = Curved ? fmaf(f3.y, pixels.x, fmaf(f3.z, pixels.y, f1.x)) : f1.x;

    // Row by row: exponent, alpha, and the step of the colour in every sub-pixel
#pragma unroll
    for (int r = 0; r < C::lane_rows; ++r) {
      const float A = fmaf(-t, t, f1.w);
#pragma unroll
      for (int p = 0; p < 2; ++p) {
        const float p0 = p ? c0 + f1.y : c0, p1 = p ? c1 + f1.z : c1, p2 = Curved && p ? c2 + f3.y : c2;
#pragma unroll
        for (int k = 0; k < 3; ++k) {
          const float v = s[r][p][k];
          float& T = transmittance[r][p][k];
          const float d = fmaf(v, fmaf(v, Curved ? fmaf(v, f3.w, p2) : p2, p1), p0);
          const float power = fmaf(-d, d, C::Compensated ? fmaf(v, fmaf(v, compensation.y, compensation.x), A) : A);
          const float alpha = fast_exp2(power);
          colour[r][p][k] = fmaf(T, step.template at<Parabola>(k, v), colour[r][p][k]);
          if (power >= cut) T = fmaf(-alpha, T, T);
        }
      }
      t = fmaf(4, f2.y, t), c0 = fmaf(4, f0.y, c0), c1 = fmaf(4, f0.w, c1);
      if (Curved) c2 = fmaf(4, f3.z, c2);
    }
  }

  // Colours are summed in float all the way, see HalfSamples.
  __device__ void flush() {}

  // Add only the step of exact intersection i, which takes the colour of the intersection before off again.
  __device__ void close(const Staged<C::Harmonics>& staged, int i) {
    const Step step(staged, i);
    pixels.for_each([&](int r, int p, int k) {
      colour[r][p][k] = fmaf(transmittance[r][p][k], step.template at<true>(k, s[r][p][k]), colour[r][p][k]);
    });
  }

  __device__ void add_exactly(const ExactIntersection<C>& intersection) {
    pixels.for_each([&](int r, int p, int k) {
      intersection.add(pixels.x + p, pixels.y + 4 * r, s[r][p][k], k, transmittance[r][p][k], colour[r][p][k]);
    });
  }

  // Put the samples over the background and into the image.
  template <class Out>
  __device__ void store(const LensOptics& lens, const Staged<C::Harmonics>& staged, float4 background, Out* out) const {
    pixels.template store<C::Cells>(lens, out, [&](int r, int p, int k) {
      const float T = transmittance[r][p][k];
      const float shown = fmaf(T, last_step<C>(staged, background, s[r][p][k], k), colour[r][p][k]);
      return ended(shown, T, part(background, k));
    });
  }
};

}  // namespace lfgs::cuda
