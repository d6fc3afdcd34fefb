// Kernels of composite_lens_column.cu that write the colours (with harmonics) and the compensations of splats at every
// lens column. They run once for the whole frame, since several lists have the same splat.
#pragma once

#include "cuda/frame/lens_column/lens_column_operands.cuh"
#include "cuda/frame/lens_column/lens_column_compensation.cuh"
#include "cuda/frame/root_series.cuh"
#include "math/colour_circle.h"

namespace lfgs::cuda {
namespace {

// Write the colours of every splat at every lens column into DirectFrame::lens_column_colours and lens_column_slopes.
// They are parabolas through three offsets of the lens column, not below zero there. They are made once for the whole
// frame. A thread makes kPerThread lens columns of one splat.
constexpr int kPerThread = 3, kColourThreads = 128;
__global__ void __launch_bounds__(kColourThreads)
    lens_column_colours_kernel(const __grid_constant__ DirectFrame frame) {
#if __CUDA_ARCH__ >= 800
  if (!frame.lens_column_chosen()) return;
  const LensColumns& lens_columns = frame.optics.lens_columns;
  const Splats<float>& splats = frame.splats;
  const int columns = lens_columns.columns(), items = columns / kPerThread;
  const int64_t thread = int64_t(blockIdx.x) * kColourThreads + threadIdx.x, id = thread / items;
  if (id >= splats.count || splats.splats[id].reach_y < 0) return;
  const int first = int(thread % items) * kPerThread, order = splats.orders[id];
  const float4* powers = reinterpret_cast<const float4*>(splats.colours) + id * (splats.colour_order + 1);

  // The offsets at which the colour polynomial is evaluated
  constexpr int kAhead = 4;                               // loads under way at a time
  float s[kPerThread][3], values[kPerThread][3][3] = {};  // by lens column; low, middle, high; values also by place
#pragma unroll
  for (int o = 0; o < kPerThread; ++o)
#pragma unroll
    for (int n = 0; n < 3; ++n) {
      const int lens_column = min(first + o, lens_columns.count - 1);
      s[o][n] = fmaf(float(n - 1) * kParabolaPlace, lens_columns.half[lens_column], lens_columns.centre[lens_column]);
    }

  // On a circle
  if (order == kCircleOrder)
    for (int m = 0; m < kCircleTerms; ++m) {
      const float4 term = by_place(frame.optics, powers[m]);
#pragma unroll
      for (int o = 0; o < kPerThread; ++o)
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
      for (int o = 0; o < kPerThread; ++o)
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
  for (int o = 0; o < kPerThread; ++o) {
    const float half = lens_columns.half[min(first + o, lens_columns.count - 1)];
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
    reinterpret_cast<float4*>(frame.lens_column_colours)[at] =
        make_float4(middle[0], middle[1], middle[2], __uint_as_float(slope[0]));
    reinterpret_cast<uint2*>(frame.lens_column_slopes)[at] = make_uint2(slope[1], slope[2]);
  }
#endif
}

// With compensation: writes the compensation of every splat at every lens column into
// DirectFrame::lens_column_compensations, as CompensationFit has it. A thread makes one.
__global__ void __launch_bounds__(kColourThreads)
    lens_column_compensations_kernel(const __grid_constant__ DirectFrame frame) {
#if __CUDA_ARCH__ >= 800
  if (!frame.lens_column_chosen()) return;
  const LensColumns& lens_columns = frame.optics.lens_columns;
  const int columns = lens_columns.columns();
  const int64_t at = int64_t(blockIdx.x) * kColourThreads + threadIdx.x, id = at / columns;
  if (id >= frame.splats.count || frame.splats.splats[id].reach_y < 0) return;
  const float centre = lens_columns.centre[min(int(at % columns), lens_columns.count - 1)],
              unit = offset_unit(frame.optics);
  const LensColumnShape shape(frame.splats.splats[id], centre, unit);
  const CompensationFit fit(LensColumnCompensation(frame.splats.compensations[id], shape, centre, unit), shape,
                            lens_columns);
  reinterpret_cast<float2*>(frame.lens_column_compensations)[at] =
      make_float2(fit.level, __uint_as_float(halves(fit.slope, fit.bend)));
#endif
}

}  // namespace
}  // namespace lfgs::cuda
