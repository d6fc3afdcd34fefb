// The samples of a lane in composite_pixel.cu: where they stand, what they hold, and how a hit is added to them. They
// read the polynomials that specialise() made, and at the end write the pixels of the image. In the functions below, r
// is a row of the lane, p one of its two pixels there, and k a place in the pixel.
#pragma once

#include "cuda/frame/composite_frame.cuh"
#include "cuda/frame/lens_optics.cuh"
#include "cuda/frame/pixel/pixel_hit.cuh"

namespace lfgs::cuda {

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
  // Calls visit(r, p, k) for the sub-pixels.
  template <class Visit>
  __device__ static void for_each(const Visit& visit) {
#pragma unroll
    for (int r = 0; r < lane_rows; ++r)
#pragma unroll
      for (int p = 0; p < 2; ++p)
#pragma unroll
        for (int k = 0; k < 3; ++k) visit(r, p, k);
  }
  // Calls visit(r, p, k, s) for the sub-pixels, with the offset from which each is seen.
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
          visit(r, p, k, fmaf(lens.s_step, camera_of(lens, own), lens.s_start));
        }
      }
  }
  // Puts the sub-pixels value(r, p, k) into the image.
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

// The step from the colour of the last hit, seen from s, to that of the background.
template <class C>
__device__ float last_step(const Staged<C::Harmonics>& staged, float4 background, float s, int k) {
  const ColourFit& last = staged.colour;
  const float step = part(background, k) - part(last.value, k);
  const float slope = C::Bends ? fmaf(s, part(last.bend, k), part(last.slope, k)) : part(last.slope, k);
  return C::Harmonics ? fmaf(-s, slope, step) : step;
}

// A lane's samples in float.
template <class C>
struct FloatSamples {
  LanePixels<C::lane_rows> pixels;
  float s[C::lane_rows][2][3], colour[C::lane_rows][2][3], transmittance[C::lane_rows][2][3];

  __device__ FloatSamples(const LensFrame& frame, int left, int top) : pixels(left, top) {
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

  // The exponents of a hit in row r of the lane, by pixel and place.
  struct Exponents {
    float of[2][3];
  };
  template <bool Parabola>
  __device__ Exponents exponents(const HitFit<C, Parabola>& hit, int r) const {
    Exponents out;
    const auto row = hit.row(r);
#pragma unroll
    for (int p = 0; p < 2; ++p)
#pragma unroll
      for (int k = 0; k < 3; ++k) out.of[p][k] = row.exponent(hit, p, s[r][p][k]);
    return out;
  }

  // Adds a hit to the samples of row r.
  template <bool Parabola>
  __device__ void blend(const ColourStep<C>& step, const Exponents& exponents, int r, float cut) {
#pragma unroll
    for (int p = 0; p < 2; ++p)
#pragma unroll
      for (int k = 0; k < 3; ++k) {
        float& T = transmittance[r][p][k];
        const float power = exponents.of[p][k], alpha = fast_exp2(power);
        colour[r][p][k] = fmaf(T, step.template at<Parabola>(k, s[r][p][k]), colour[r][p][k]);
        if (power >= cut) T = fmaf(-alpha, T, T);
      }
  }

  // Adds the hits [h, end), at least one. Parabola: whether they are special, that is, have parabolas for r or for the
  // steps of their colours. An exp2 keeps its pipe busy for 8 cycles, so that what a hit has of them takes nearly as
  // long as all its other instructions. They must be spread evenly among those: therefore the exponents of the row that
  // comes next, which may be one of the next hit, are made while a row is blended. See Config::MadeAhead.
  template <bool Parabola>
  __device__ void add_all(const StagedOf<C>& staged, int h, int end, float cut) {
    if constexpr (!C::MadeAhead) {
#pragma unroll 1
      for (; h < end; ++h) {
        const HitFit<C, Parabola> hit(staged, h, pixels.x, pixels.y);
#pragma unroll
        for (int r = 0; r < C::lane_rows; ++r) blend<Parabola>(hit.step, exponents(hit, r), r, cut);
      }
      return;
    }
    HitFit<C, Parabola> hit(staged, h, pixels.x, pixels.y);
    Exponents ready = exponents(hit, 0);
    auto finish_rows = [&] {  // all of this hit but its last row, whose exponents are then ready
#pragma unroll
      for (int r = 1; r < C::lane_rows; ++r) {
        const Exponents next = exponents(hit, r);
        blend<Parabola>(hit.step, ready, r - 1, cut);
        ready = next;
      }
    };
#pragma unroll 2
    for (++h; h < end; ++h) {
      finish_rows();
      const HitFit<C, Parabola> next_hit(staged, h, pixels.x, pixels.y);
      const Exponents next = exponents(next_hit, 0);
      blend<Parabola>(hit.step, ready, C::lane_rows - 1, cut);
      hit = next_hit, ready = next;
    }
    finish_rows();
    blend<Parabola>(hit.step, ready, C::lane_rows - 1, cut);
  }

  // Colours are summed in float all the way, see HalfSamples.
  __device__ void flush() {}

  // Adds only the step of careful hit i, which takes the colour of the hit before off again.
  __device__ void close(const Staged<C::Harmonics>& staged, int i) {
    const ColourStep<C> step(staged, i);
    pixels.for_each([&](int r, int p, int k) {
      colour[r][p][k] = fmaf(transmittance[r][p][k], step.template at<true>(k, s[r][p][k]), colour[r][p][k]);
    });
  }

  __device__ void add_carefully(const CarefulHit<C>& hit) {
    pixels.for_each([&](int r, int p, int k) {
      hit.add(pixels.x + p, pixels.y + 4 * r, s[r][p][k], k, transmittance[r][p][k], colour[r][p][k]);
    });
  }

  // Puts the samples over the background and into the image.
  template <class Out>
  __device__ void store(const LensOptics& lens, const Staged<C::Harmonics>& staged, float4 background, Out* out) const {
    float shown[C::lane_rows][2][3], least = 1;
    pixels.for_each([&](int r, int p, int k) {
      const float T = transmittance[r][p][k];
      shown[r][p][k] = fmaf(T, last_step<C>(staged, background, s[r][p][k], k), colour[r][p][k]);
      least = fminf(least, T);
    });
    // Few lanes have samples that have ended: the others are not asked one by one
    if (least < float(kMinTransmittance))
      pixels.for_each([&](int r, int p, int k) {
        shown[r][p][k] = ended(shown[r][p][k], transmittance[r][p][k], part(background, k));
      });
    pixels.template store<C::Cells>(lens, out, [&](int r, int p, int k) { return shown[r][p][k]; });
  }
};

}  // namespace lfgs::cuda
