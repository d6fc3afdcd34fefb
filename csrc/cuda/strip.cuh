// What a splat sweeps out over a range of offsets, for lists and culls. Bounds err on the wide side.
#pragma once

#include "math/constants.h"
#include "math/projection.h"

namespace lfgs::cuda {

// Where a splat may touch rows centres [y_low, y_high] from the offsets centre -+ half, along x + shear * y:
// middle -+ (spread + sqrt(square)).
struct Strip {
  float middle, spread, square;
  bool rows;  // whether it reaches these rows at all

  __device__ Strip(const Splat<float>& s, float y_low, float y_high, float centre, float half, float shear) {
    const float d1 = fmaxf(y_low - s.v0, -s.reach_y), d2 = fminf(y_high - s.v0, s.reach_y);
    rows = d1 <= d2;
    const float nearest = fmaxf(d1, 0.f) + fminf(d2, 0.f), dy = 0.5f * (d1 + d2), dh = 0.5f * (d2 - d1);
    const float a = centre - half, b = centre + half;
    const float S = fmaxf(fmaf(a, fmaf(a, s.S2, s.S1), s.S0), fmaf(b, fmaf(b, s.S2, s.S1), s.S0));
    square = fmaxf(fmaf(-s.tau * nearest, nearest, s.log2_opacity - float(kLog2MinAlpha)), 0.f) * S * 1.00001f;
    const float slope = s.c0 + shear, tilt = fmaf(centre, s.c1, slope), sweep = fmaf(s.c1, dy, s.du);
    middle = fmaf(centre, sweep, fmaf(slope, dy, fmaf(shear, s.v0, s.u0)));
    spread = fmaf(fabsf(tilt), dh, fmaf(fabsf(sweep), half, fabsf(s.c1) * half * dh)) + 0.01f;
  }
  // Whether it may touch x -+ half.
  __device__ bool touches(float x, float half) const {
    const float gap = fmaxf(fabsf(x - middle) - spread - half, 0.f);
    return rows && gap * gap <= square;
  }
};

}  // namespace lfgs::cuda
