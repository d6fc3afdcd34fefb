// r = S^(-1/2) of a splat along the rig, as a series, and the terms of it that kernels may leave out.
#pragma once

#include "cuda/common/blend.cuh"
#include "cuda/frame/direct_frame.h"

namespace lfgs::cuda {

// The lens-column kernel evaluates a splat by the exact formulas if its parabola_error() is above kMostParabolaError.
// Otherwise alpha is off by less than 0.42/255. No splat with s2 reach^2 up to kLeastBend has so large an error: the
// worst S, the square of a line, has it there.
constexpr float kMostParabolaError = 0.002f, kLeastBend = 0.026f;

// The series of r for S = S0 (1 + s1 v + s2 v^2): r = S0^(-1/2) (1 + p1 v + p2 v^2 + p3 v^3 + p4 v^4 ...).
struct RootSeries {
  float s1, s2;

  __device__ float p1() const { return -0.5f * s1; }
  __device__ float p2() const { return fmaf(0.375f * s1, s1, -0.5f * s2); }
  __device__ float p3() const { return s1 * fmaf(-0.3125f * s1, s1, 0.75f * s2); }
  __device__ float p4() const {
    const float square = s1 * s1;
    return s2 * (0.375f * s2 - 0.9375f * square) + 0.2734375f * square * square;
  }
};

// The series of a splat about the offset `centre`, in the middle of an lens_column. v = 1 stands for the offset `unit`
// from there, and r is the value in the middle, S0^(-1/2).
struct LensColumnShape : RootSeries {
  float r;

  __device__ LensColumnShape(const Splat<float>& s, float centre, float unit) {
    r = fast_rsqrt(fmaf(centre, fmaf(centre, s.S2, s.S1), s.S0));
    s1 = fmaf(2 * centre, s.S2, s.S1) * unit * (r * r), s2 = s.S2 * unit * unit * (r * r);
  }

  // The largest error of r, relative, over the lens column when it is a parabola, times the opacity of the splat. Where
  // v reaches 1, it is 0.4 (|p3| + s2^2). Other terms do not matter: S is nowhere below zero, so |s1| < 2 sqrt(s2),
  // which bounds them all.
  __device__ float parabola_error(const LensColumns& lens_columns, float log2_opacity) const {
    constexpr float kLeastOpacity = 0.1f;  // fainter splats count as if they had this: their edge shows
    const float reach = lens_columns.reach, opacity = fmaxf(fast_exp2(log2_opacity), kLeastOpacity);
    return 0.4f * reach * reach * reach * opacity * fmaf(reach * s2, s2, fabsf(p3()));
  }
};

}  // namespace lfgs::cuda
