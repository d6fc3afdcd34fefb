// Kernels of composite_ordinal.cu that write what splats have at every ordinal, once for the whole frame, since several
// lists have the same splat: with harmonics their colours, with compensation their shares of opacity.
#pragma once

#include "cuda/frame/ordinal/ordinal_operands.cuh"
#include "cuda/frame/ordinal/ordinal_share.cuh"
#include "cuda/frame/root_series.cuh"
#include "math/colour_circle.h"

namespace lfgs::cuda {
namespace {

// Writes the colours of every splat at every ordinal into LensFrame::ordinal_colours and ordinal_slopes: parabolas
// through three places of what the ordinal sees, with nothing below zero there. They are made once for the whole frame,
// since several lists have the same splat. A thread makes kShare ordinals of one splat.
constexpr int kShare = 3, kColourThreads = 128;
__global__ void __launch_bounds__(kColourThreads) ordinal_colours_kernel(const __grid_constant__ LensFrame frame) {
#if __CUDA_ARCH__ >= 800
  if (!frame.ordinal_chosen()) return;
  const Ordinals& ordinals = frame.optics.ordinals;
  const Splats<float>& splats = frame.splats;
  const int columns = ordinals.columns(), items = columns / kShare;
  const int64_t thread = int64_t(blockIdx.x) * kColourThreads + threadIdx.x, id = thread / items;
  if (id >= splats.count || splats.splats[id].reach_y < 0) return;
  const int first = int(thread % items) * kShare, order = splats.orders[id];
  const float4* powers = reinterpret_cast<const float4*>(splats.colours) + id * (splats.colour_order + 1);

  // The offsets at which the colour polynomial is evaluated
  constexpr int kAhead = 4;                       // loads under way at a time
  float s[kShare][3], values[kShare][3][3] = {};  // by ordinal; low, middle, high; values also by place
#pragma unroll
  for (int o = 0; o < kShare; ++o)
#pragma unroll
    for (int n = 0; n < 3; ++n) {
      const int ordinal = min(first + o, ordinals.count - 1);
      s[o][n] = fmaf(float(n - 1) * kParabolaPlace, ordinals.half[ordinal], ordinals.centre[ordinal]);
    }

  // On a circle
  if (order == kCircleOrder)
    for (int m = 0; m < kCircleTerms; ++m) {
      const float4 term = by_place(frame.optics, powers[m]);
#pragma unroll
      for (int o = 0; o < kShare; ++o)
#pragma unroll
        for (int n = 0; n < 3; ++n) {
          const CirclePoint<float> point(powers[kPlaceTerm].w, powers[kDistanceTerm].w, s[o][n]);
          const float basis = point.colour([&](int other) { return other == m ? 1.f : 0.f; });
          float (&value)[3] = values[o][n];
          value[0] = fmaf(basis, term.x, value[0]), value[1] = fmaf(basis, term.y, value[1]);
          value[2] = fmaf(basis, term.z, value[2]);
        }
    }

  // Horner's rule, from the highest power of s down
  for (int high = order; high >= 0; high -= kAhead) {
    float4 c[kAhead];
#pragma unroll
    for (int k = 0; k < kAhead; ++k) c[k] = by_place(frame.optics, powers[max(high - k, 0)]);
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      if (high < k) break;
#pragma unroll
      for (int o = 0; o < kShare; ++o)
#pragma unroll
        for (int n = 0; n < 3; ++n) {
          float (&value)[3] = values[o][n];
          value[0] = fmaf(value[0], s[o][n], c[k].x), value[1] = fmaf(value[1], s[o][n], c[k].y);
          value[2] = fmaf(value[2], s[o][n], c[k].z);
        }
    }
  }

  // The parabolas, in v
#pragma unroll
  for (int o = 0; o < kShare; ++o) {
    const float half = ordinals.half[min(first + o, ordinals.count - 1)];
    // 1 / (2 v), where v is that of the last of the three offsets, with its sign
    const float inverse = half > 0 ? 0.5f * offset_unit(frame.optics) / (kParabolaPlace * half) : 0.5f;
    float middle[3];
    unsigned slope[3];
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      const float low = fmaxf(values[o][0][c], 0.f), high = fmaxf(values[o][2][c], 0.f);
      middle[c] = fmaxf(values[o][1][c], 0.f);
      const float bend = (high + low - 2 * middle[c]) * 2 * inverse * inverse;
      slope[c] = slope_and_bend((high - low) * inverse, bend);
    }
    const int64_t at = id * columns + first + o;
    reinterpret_cast<float4*>(frame.ordinal_colours)[at] =
        make_float4(middle[0], middle[1], middle[2], __uint_as_float(slope[0]));
    reinterpret_cast<uint2*>(frame.ordinal_slopes)[at] = make_uint2(slope[1], slope[2]);
  }
#endif
}

// With compensation: writes the share of opacity of every splat at every ordinal into
// LensFrame::ordinal_shares, as ShareFit has it. A thread makes one.
__global__ void __launch_bounds__(kColourThreads) ordinal_shares_kernel(const __grid_constant__ LensFrame frame) {
#if __CUDA_ARCH__ >= 800
  if (!frame.ordinal_chosen()) return;
  const Ordinals& ordinals = frame.optics.ordinals;
  const int columns = ordinals.columns();
  const int64_t at = int64_t(blockIdx.x) * kColourThreads + threadIdx.x, id = at / columns;
  if (id >= frame.splats.count || frame.splats.splats[id].reach_y < 0) return;
  const float centre = ordinals.centre[min(int(at % columns), ordinals.count - 1)], unit = offset_unit(frame.optics);
  const OrdinalShape shape(frame.splats.splats[id], centre, unit);
  const ShareFit fit(OrdinalShare(frame.splats.compensations[id], shape, centre, unit), shape, ordinals);
  reinterpret_cast<float2*>(frame.ordinal_shares)[at] =
      make_float2(fit.level, __uint_as_float(halves(fit.slope, fit.bend)));
#endif
}

}  // namespace
}  // namespace lfgs::cuda
