// Common parts of the kernels that composite a light-field frame: reading lists and splats, handing out tiles, and
// storing pixels.
#pragma once

#include "cuda/common/blend.cuh"
#include "cuda/common/launch.h"
#include "cuda/common/halves.cuh"
#include "cuda/frame/direct_frame.h"
#include "math/projection.h"

namespace lfgs::cuda {

// The lists of a frame: splats, nearest first. A frame with more intersections than its lists hold has one list for all
// tiles, of all splats drawn; then `ranges` is null.
struct Lists {
  const uint32_t* ids;
  const uint2* ranges;
  unsigned drawn;

  __device__ explicit Lists(const DirectFrame& frame) {
    ids = frame.ids, drawn = frame.state->drawn;
    ranges = frame.overfull() ? nullptr : reinterpret_cast<const uint2*>(frame.ranges);
  }
  // Where a list begins and ends in `ids`.
  __device__ uint2 range(int64_t number) const { return ranges ? ranges[number] : make_uint2(0, drawn); }
};

// How many tiles the chosen kernel draws, all or the tiles that a lattice refused, and the number of the i-th.
__device__ inline unsigned tiles_to_draw(const DirectFrame& frame, const Tiling& tiling) {
  return frame.state->lattices ? frame.state->refused_tiles : unsigned(tiling.across * tiling.down);
}
__device__ inline unsigned tile_to_draw(const DirectFrame& frame, unsigned i) {
  return frame.state->lattices ? frame.refused[i] : i;
}

// Hand out the pieces of work of a kernel. The next piece is asked for while one is drawn, so that nobody waits for
// it.
struct WorkQueue {
  unsigned* next;
  unsigned claimed = 0;

  __device__ WorkQueue(const DirectFrame& frame, FrameKernel kernel) : next(&frame.state->next_tile[int(kernel)]) {}
  // Ask for the next piece. Called by one of the threads that share it; the first `first` pieces are handed out
  // without asking, one to each block or warp.
  __device__ void claim(unsigned first) { claimed = first + atomicAdd(next, 1u); }
};

// A splat out of the three vectors that it is in memory.
__device__ inline Splat<float> assembled(float4 a, float4 b, float4 c) {
  return {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w};
}

// Read a splat with its centre counted from a point. In a frame, the place of the depth has what rounding took from u0
// and v0, as halves (see place_mean()). Small splats show the difference, so the second function adds it;
// bounds do without.
__device__ inline Splat<float> splat_about(const Splats<float>& splats, uint32_t id, float2 centre) {
  const float4* source = reinterpret_cast<const float4*>(splats.splats + id);
  float4 a = source[0];
  a.x -= centre.x, a.z -= centre.y;
  return assembled(a, source[1], source[2]);
}

__device__ inline Splat<float> whole_splat_about(const Splats<float>& splats, uint32_t id, float2 centre) {
  Splat<float> splat = splat_about(splats, id, centre);
  const __half2 rest = unpacked(splat.depth);
  splat.u0 += __low2float(rest), splat.v0 += __high2float(rest);
  return splat;
}

// Store two neighbouring pixels, the first in an even column. values are by place, and are put into the order of the
// channels. Cells: see by_place(). Bytes are stored two at a time where rows allow it.
template <bool Cells, class Out>
__device__ void store_pixels(const LensOptics& lens, int column, int row, const float (&values)[6], Out* out) {
  if (row >= lens.height_px || column >= lens.width_px) return;
  Out bytes[6];
#pragma unroll
  for (int i = 0; i < 6; ++i)
    bytes[i] = stored(!Cells && lens.permuted ? values[i / 3 * 3 + 2 - i % 3] : values[i], out);
  if (Cells && lens.permuted) {
    const Out placed[6] = {bytes[0], bytes[1], bytes[2], bytes[3], bytes[4], bytes[5]};
#pragma unroll
    for (int i = 0; i < 6; ++i) {
      const int first = i / 3 * 3, place = lens.places[i % 3];
      bytes[i] = place == 0 ? placed[first] : place == 1 ? placed[first + 1] : placed[first + 2];
    }
  }
  Out* to = out + 3 * (int64_t(row) * lens.width_px + column);
  if (sizeof(Out) == 1 && lens.width_px % 2 == 0) {
#pragma unroll
    for (int i = 0; i < 6; i += 2)
      reinterpret_cast<uint16_t*>(to)[i / 2] = uint16_t(unsigned(bytes[i]) | unsigned(bytes[i + 1]) << 8);
  } else {
#pragma unroll
    for (int i = 0; i < 6; ++i)
      if (i < 3 || column + 1 < lens.width_px) to[i] = bytes[i];
  }
}

}  // namespace lfgs::cuda
