// Which sub-pixel belongs to which lens, and from which offset of the rig it is seen: twin of scene/lens.h for kernels.
#pragma once

#include "cuda/frame/direct_frame.h"

namespace lfgs::cuda {

// Functions of the offset are fitted over -1..1 through the zeros of Chebyshev's polynomials of the second kind, which
// minimizes the mean error. A line goes through -+ kLinePlace, a parabola through 0 and -+ kParabolaPlace.
constexpr float kLinePlace = 0.5f, kParabolaPlace = 0.70710678f;

// The phase of a stripe.
__device__ inline uint64_t phase_at(const LensOptics& lens, int row, int subpixel) {
  return lens.phase0 + lens.phase_x * uint64_t(int64_t(subpixel)) + lens.phase_y * uint64_t(int64_t(row));
}

// The camera coordinate x of a phase. It is n + 1/2, where n is the high part of phase * views; with a continuous lens
// it is x itself.
__device__ inline float camera_offset(const LensOptics& lens, uint64_t phase) {
  const unsigned views = unsigned(lens.views), high = unsigned(phase >> 32);
  const uint64_t product = uint64_t(high) * views + __umulhi(unsigned(phase), views);
  const unsigned part = lens.continuous ? unsigned(product) : 1u << 31;
  return fmaf(float(part), 1.f / 4294967296.f, float(unsigned(product >> 32)));
}

// The phase of a sub-pixel minus the phase of its stripe, on a panel with cells.
__device__ inline uint64_t cell_phase(const LensOptics& lens, int row, int subpixel) {
  return lens.cells.phases[row % kCellPeriod][(subpixel % kRowPeriod + kRowPeriod) % kRowPeriod];
}

// The first stripe of a lens in a row. It is estimated in float, to within one, and then made exact with the phase. For
// lenses of 4 sub-pixels or more.
__device__ inline int first_stripe(const LensOptics& lens, int row, int number) {
  const int m = int(ceilf(fmaf(float(number), lens.line_number, -lens.origin) - 3 * lens.slant_tan * float(row)));
  const uint64_t phase = phase_at(lens, row, m);
  return phase < lens.phase_x ? m : phase >> 63 ? m + 1 : m - 1;
}

// The first sub-pixel of a lens in a row: with cells it may stand before or behind the first stripe.
__device__ inline int lens_start(const LensOptics& lens, int row, int number) {
  int m = first_stripe(lens, row, number);
  if (!lens.has_cells) return m;
  auto inside = [&](int at) { return int64_t(phase_at(lens, row, at) + cell_phase(lens, row, at)) >= 0; };
  while (inside(m - 1)) --m;
  while (!inside(m)) ++m;
  return m;
}

// The offsets that a group of lens columns sees: centre -+ half.
__device__ inline void group_offsets(const LensColumns& lens_columns, int group, float& centre, float& half) {
  const int first = group * lens_columns.per_group, last = min(first + lens_columns.per_group, lens_columns.count) - 1;
  const float a =
      fminf(lens_columns.centre[first] - lens_columns.half[first], lens_columns.centre[last] - lens_columns.half[last]);
  const float b =
      fmaxf(lens_columns.centre[first] + lens_columns.half[first], lens_columns.centre[last] + lens_columns.half[last]);
  centre = 0.5f * (a + b), half = 0.5f * (b - a);
}

// Place of a sub-pixel within its pixel.
__device__ inline int place_index(int subpixel) { return (subpixel % 3 + 3) % 3; }

// Where a sub-pixel m >= 0 of a row stands in the image: pixels are stored as red, green, blue.
__device__ inline int in_image(const LensOptics& lens, int m) {
  return lens.permuted ? m - m % 3 + lens.channels[m % 3] : m;
}

// Bytes that the sub-pixels of a row of a tile of lenses take, at most.
LFGS_HD int lens_row_bytes(float line_number) { return (int(kTileLenses * line_number) + 5) & ~3; }

// Store the sub-pixels of a row from ends.x to before ends.y in the image, as far as they are on the panel. By a warp.
__device__ inline void store_row(const LensOptics& lens, int row, int2 ends, const uint8_t* bytes, uint8_t* out) {
  const int width = 3 * lens.width_px, end = min(ends.y, width);
  uint8_t* to = out + int64_t(row) * width;
  for (int m = ends.x + int(threadIdx.x % 32); m < end; m += 32)
    if (m >= 0) to[in_image(lens, m)] = bytes[m - ends.x];
}

// A colour in the order of the sub-pixels of a pixel, from the left. Cells: false where the panel has no cells; then an
// order that is not red, green, blue can only be blue, green, red.
template <bool Cells = true>
__device__ float4 by_place(const LensOptics& lens, float4 c) {
  if constexpr (!Cells) return lens.permuted ? make_float4(c.z, c.y, c.x, c.w) : c;
  if (!lens.permuted) return c;
  auto at = [&](int place) { return lens.channels[place] == 0 ? c.x : lens.channels[place] == 1 ? c.y : c.z; };
  return make_float4(at(0), at(1), at(2), c.w);
}

// The offset from the middle of a lens column that v = 1 stands for.
__device__ inline float offset_unit(const LensOptics& lens) { return lens.s_step / lens.lens_columns.view_unit; }

}  // namespace lfgs::cuda
