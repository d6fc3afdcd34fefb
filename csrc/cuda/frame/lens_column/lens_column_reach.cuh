// Which patches of a tile in composite_lens_column.cu a splat may touch, at which lens_columns. Asked once for each
// splat that a block stages, and written where all warps read it: the rows of a warp's patch are those of the three
// patches beside it, so that all four would find the same strip.
#pragma once

#include "cuda/frame/lens_column/lens_column_operands.cuh"
#include "cuda/frame/strip.cuh"

namespace lfgs::cuda {

#if __CUDA_ARCH__ >= 800
// The splat of number `id`, its depth replaced by where the arrays by lens column have its entry at lens column 0.
__device__ inline Splat<float> splat_with_entry(const DirectFrame& frame, uint32_t id) {
  const float4* parts = reinterpret_cast<const float4*>(frame.splats.splats) + 3 * int64_t(id);
  const float4 a = parts[0], b = parts[1];
  float4 c = parts[2];
  c.w = __uint_as_float(id * frame.optics.lens_columns.columns());
  return assembled(a, b, c);
}

// x + tan(slant) y of lens column -1/2, in the middle of a patch whose first lens is this one.
__device__ inline float sheared_x(const LensOptics& lens, int first_lens) {
  const float phase = fmaf(first_lens + 0.5f * (kWarpLenses - 1), lens.line_number, -lens.origin);
  return (phase - float(lens.lead)) / 3 + 0.5f * lens.slant_tan + 1.f / 6;
}

// The patches that a splat may touch, as bits: bit kWarpsAcross t + a stands for patch a of a tile from the left, in
// the upper or lower row of patches that begins in row `row0`, at lens column t of those from first to last.
__device__ inline unsigned patches_touched(const LensOptics& lens, const Splat<float>& s, int first_lens, int row0,
                                           int first, int last) {
  const LensColumns& lens_columns = lens.lens_columns;
  const Strip rows(s, row0 + 0.5f, row0 + kWarpRows - 0.5f, lens.slant_tan);
  const float width = kWarpLenses * lens.line_number / 3;
  // Half the width of a patch between the outermost pixel centres
  const float half_x = (0.5f * (kWarpLenses - 1) * lens.line_number + 0.5f) / 3 + 1.f / 3 + 0.01f;
  float x = sheared_x(lens, first_lens) + (first + 0.5f) / 3;  // of the first patch, at each lens column
  unsigned touched = 0;
#pragma unroll
  for (int t = 0; t < kGroupColumns; ++t, x += 1.f / 3) {
    const int lens_column = min(first + t, last);  // what follows behind the last is cleared below
    const Span span = rows.at(s, lens_columns.centre[lens_column], lens_columns.half[lens_column]);
    // A square below zero makes the reach negative, and very large
    const float reach = fmaf(span.square, fast_rsqrt(fmaxf(span.square, 1e-30f)), span.spread + half_x);
#pragma unroll
    for (int a = 0; a < kWarpsAcross; ++a)
      touched |= fabsf(x - span.middle + a * width) <= reach ? 1u << (kWarpsAcross * t + a) : 0u;
  }
  return touched & ((2u << (kWarpsAcross * (last - first + 1) - 1)) - 1);
}
static_assert(kWarpsAcross * kGroupColumns <= 32);
#endif

}  // namespace lfgs::cuda
