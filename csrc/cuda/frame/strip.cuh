// What a splat sweeps out over a range of offsets, for lists and culls. Bounds err on the wide side.
#pragma once

#include "math/footprint.h"
#include "math/projection.h"

namespace lfgs::cuda {

// Where a splat may touch some offsets' samples: middle -+ (spread + sqrt(square)); square below zero: nowhere.
struct Span {
  float middle, spread, square;

  // Whether it may touch x -+ half.
  __device__ bool touches(float x, float half) const {
    const float gap = fmaxf(fabsf(x - middle) - spread - half, 0.f);
    return gap * gap <= square;
  }
};

// The part of a splat in rows of centres y_low .. y_high, along x + shear * y.
struct Strip {
  float dy, dh;                    // middle and half height of the rows that it reaches, from its centre
  float range;                     // exponent left there; below zero: it does not reach these rows
  float slope, base, sweep, turn;  // of the centre line: see at()

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

  // From the offsets centre -+ half. S is convex, so largest at an end.
  __device__ Span at(const Splat<float>& s, float centre, float half) const {
    const float S = fmaf(centre, fmaf(centre, s.S2, s.S1), s.S0), dS = fmaf(2 * centre, s.S2, s.S1);
    const float tilt = fmaf(centre, s.c1, slope);
    return {fmaf(centre, sweep, base), fmaf(fabsf(tilt), dh, fmaf(turn, half, 0.01f)),
            range * fmaf(fabsf(dS), half, fmaf(s.S2 * half, half, S))};
  }
  // From the whole rig, the offsets -1 .. 1.
  __device__ Span whole_rig(const Splat<float>& s) const {
    return {base, fmaf(fabsf(slope), dh, turn + 0.01f), range * (s.S0 + fabsf(s.S1) + s.S2)};
  }
};

}  // namespace lfgs::cuda
