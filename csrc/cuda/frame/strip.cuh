// The area of a splat over a range of offsets: bounds with which lists are filled and splats are culled. They err
// on the wide side, so that nothing that shows is left out.
#pragma once

#include "math/footprint.h"
#include "math/projection.h"

namespace lfgs::cuda {

// Where along x a splat may touch samples that are seen from some range of offsets: middle -+ (spread + sqrt(square)).
// Where square is below zero it touches none.
struct Span {
  float middle, spread, square;

  // Whether it may touch a sample within x -+ half.
  __device__ bool touches(float x, float half) const {
    const float gap = fmaxf(fabsf(x - middle) - spread - half, 0.f);
    return gap * gap <= square;
  }
};

// The part of a splat in the rows whose centres are y_low .. y_high. With a shear, places are x + shear * y instead of
// x.
struct Strip {
  float dy, dh;  // middle and half height of the rows that it reaches, counted from its centre
  float range;   // exponent that is left along x there; below zero: it does not reach these rows
  // The line of its centres: `base` is x at dy, seen from the middle of the rig; `slope` is by row, `sweep` by offset.
  // `turn` is the largest slope by offset in the rows
  float slope, base, sweep, turn;

  __device__ Strip(const Splat<float>& s, float y_low, float y_high) {
    const float d1 = fmaxf(y_low - s.v0, -s.reach_y), d2 = fminf(y_high - s.v0, s.reach_y);
    const float nearest = fmaxf(d1, 0.f) + fminf(d2, 0.f);
    dy = 0.5f * (d1 + d2), dh = 0.5f * (d2 - d1);
    range = fmaxf(exponent_left(s, nearest), 0.f) * 1.00001f;
    range = d1 <= d2 ? range : -1.f;
    slope = s.c0, base = fmaf(slope, dy, s.u0);
    sweep = fmaf(s.c1, dy, s.du), turn = fmaf(fabsf(s.c1), dh, fabsf(sweep));
  }
  __device__ Strip(const Splat<float>& s, float y_low, float y_high, float shear) : Strip(s, y_low, y_high) {
    slope += shear, base = fmaf(shear, s.v0 + dy, base);
  }

  // The span that it may touch, seen from the offsets centre -+ half. S is convex in s, so it is largest at one of the
  // ends.
  __device__ Span at(const Splat<float>& s, float centre, float half) const {
    const float S = fmaf(centre, fmaf(centre, s.S2, s.S1), s.S0), dS = fmaf(2 * centre, s.S2, s.S1);
    const float tilt = fmaf(centre, s.c1, slope);
    return {fmaf(centre, sweep, base), fmaf(fabsf(tilt), dh, fmaf(turn, half, 0.01f)),
            range * fmaf(fabsf(dS), half, fmaf(s.S2 * half, half, S))};
  }
  // The same for the whole rig, the offsets -1 .. 1.
  __device__ Span whole_rig(const Splat<float>& s) const {
    return {base, fmaf(fabsf(slope), dh, turn + 0.01f), range * (s.S0 + fabsf(s.S1) + s.S2)};
  }
};

}  // namespace lfgs::cuda
