// A tile of composite_lattice.cu: its sub-pixels, the nodes from which they are interpolated, and a block's shared
// memory for both.
//
// A tile is made of sections, and each section has a list of splats and a lattice of its own. A tile of pixels is one
// section, which sees the whole rig; a tile of lenses has a section for each group of lens_columns.
#pragma once

#include <cuda_fp16.h>

#include "cuda/frame/composite_frame.cuh"
#include "cuda/common/halves.cuh"
#include "cuda/frame/direct_frame.h"
#include "cuda/frame/lattice/lattice_planner.cuh"
#include "cuda/frame/lens_optics.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kWarps = 4, kThreads = 32 * kWarps;
constexpr int kTileRows = 32;
constexpr int kMostSections = (kMostLensColumns + kGroupColumns - 1) / kGroupColumns;
constexpr int kBatch = 32, kShapes = 512;
constexpr int kMostTableViews = 192;

// a / b, rounded down, of whole numbers below 2^12. The division is approximate, but (a + 1/2) / b is at least 1 / (2
// b) from any whole number, so that the result is exact.
__device__ inline int quotient(int a, int b) { return int((float(a) + 0.5f) * fast_reciprocal(float(b))); }

// A batch of splats, as all points of a lattice read them.
struct Staged {
  float4 place[kBatch];    // u0, du, v0, log2 of the opacity
  float4 form[kBatch];     // tau, c0, c1
  float4 shapes[kShapes];  // a splat's colour and 1 / S on the planes and half-way between: [splats, 2 planes - 1]
};

// The position of a sub-pixel in a lattice: an offset between two planes of a lattice. `aside`: how many nodes aside it
// lies on the first plane. The word below holds the storage index of that plane (16 bits) and the part of the way to
// the next plane (a half, above).
struct alignas(8) Seen {
  float aside;
  unsigned first_and_part;

  Seen() = default;
  __device__ Seen(const Lattice& lattice, int plane, float part)
      : aside(lattice.plane[plane].aside * part),
        first_and_part(unsigned(lattice.plane[plane].first) | bits(__floats2half2_rn(0.f, part))) {}
  __device__ unsigned first() const { return first_and_part & 0xffffu; }
  __device__ __half2 part() const { return __high2half2(as_half2(first_and_part)); }
};

// A number of nodes in 65536ths. Half a 1024th is added, since only 1024ths are used later: so they are rounded.
__device__ inline unsigned fixed(float nodes) { return unsigned(int(fmaf(nodes, 65536.f, 32.f))); }

// The same for rows of pixels, see lattice_rows.cuh. It has the shift within a stored row, in 65536ths of a node, and
// the part of the way to the next plane.
struct alignas(8) RowSeen {
  unsigned on;
  __half2 part;

  RowSeen() = default;
  __device__ RowSeen(const Lattice& lattice, int plane, float part_)
      : on((plane * lattice.across << 16) - unsigned(int(rintf(lattice.plane[plane].aside * part_ * 65536.f)))),
        part(__float2half2_rn(part_)) {}
};

// Colours from a node to the next along x, in a row of pixels: first + t step. t is 1 at the one node and 2 at the
// other. Also the changes of `first` and `step` to the next plane.
struct alignas(8) Between {
  __half2 first_and_step, change;

  Between() = default;
  __device__ Between(__half2 near, __half2 far)
      : first_and_step(line(near)), change(__hsub2(line(far), first_and_step)) {}

 private:
  static __device__ __half2 line(__half2 ends) {
    const __half step = __hsub(__high2half(ends), __low2half(ends));
    return __halves2half2(__hsub(__low2half(ends), step), step);
  }
};

// Colours, 0..1, at the corners of a cell: a node and the next along x, in its row (low) and in the next (high). A
// place in the cell needs all four, and reads them at once; so every colour is stored up to four times.
struct alignas(8) Corners {
  __half2 low, high;
};

// The three channels at a place, in halves.
struct alignas(8) Triple {
  __half2 red_green, blue;

  Triple() = default;
  __device__ explicit Triple(float3 c) : red_green(__floats2half2_rn(c.x, c.y)), blue(__floats2half2_rn(c.z, 0.f)) {}
  __device__ float3 floats() const {
    return make_float3(__low2float(red_green), __high2float(red_green), __low2float(blue));
  }
};

constexpr int kChannelNodes = kMostNodes + 5;  // so that the same node of another channel is in another bank

// Memory for interpolation. First the position of every view in the section, then the colours (bytes) or the nodes
// (between) of as many rows as fit.
struct Interpolated {
  static constexpr int kRowBytes = sizeof(Staged) - kMostTableViews * sizeof(Seen);
  union {
    Seen seen[kMostTableViews];
    RowSeen row_seen[kMostTableViews];
  };
  union {
    alignas(16) uint8_t bytes[kRowBytes];
    Between between[kRowBytes / sizeof(Between)];
  };
};
// One row of pixels must fit: of each channel it has a row of nodes on every plane but the last. With two rows of nodes
// or more that is half of all nodes at most.
constexpr int kMostBetween = Interpolated::kRowBytes / sizeof(Between);
static_assert(kMostBetween >= 3 * kMostNodes / 2);

// The shared memory of a block.
struct Memory {
  Corners corners[3][kChannelNodes];  // of the cell that begins at each node: by section, plane, row and node
  union {
    Triple middles[kMostNodes];  // of the section at hand, see lattice_errors.cuh
    float4 parts[kThreads];      // while points are drawn in parts: colour and transmittance of each
  };
  Lattice lattices[kMostSections];
  int first_node[kMostSections];
  int2 rows[kTileRows];        // the tile's sub-pixels in each row, from x to before y; also those beyond the panel
  unsigned phases[kTileRows];  // phase of the first of these, without the last 32 bits
  int low, high;               // first and last column of pixels
  int verdict;                 // see verdict_on
  float largest[kWarps], squares[kWarps];
  union {
    alignas(16) char planner[sizeof(LatticePlanner)];
    Staged staged;
    Triple errors[kMostNodes];  // at the middles
    Interpolated interpolated;
  };

  // Take the lattices that were laid through sections. By all threads of the block; the caller has them wait for each
  // other afterwards.
  __device__ void take(const Lattice* laid, int sections) {
    const int *from = reinterpret_cast<const int*>(laid), words = sections * int(sizeof(Lattice) / sizeof(int));
    for (int k = threadIdx.x; k < words; k += kThreads) reinterpret_cast<int*>(lattices)[k] = from[k];
    if (threadIdx.x == 0) first_node[0] = 0;
  }
};

// Which part of the panel a tile is.
struct Tile {
  const LensOptics& lens;
  const Tiling& tiling;
  bool by_lens;
  int column, number, top, rows, sections, first_lens;
  int low = 0, high = -1;  // columns of pixels

  __device__ Tile(const DirectFrame& frame, const Tiling& tiling_, int row, int column_)
      : lens(frame.optics),
        tiling(tiling_),
        by_lens(&tiling == &frame.lens_column),
        column(column_),
        number(row * tiling.across + column),
        top(row * tiling.height),
        rows(min(tiling.height, lens.height_px - top)),
        sections(tiling.groups),
        first_lens(lens.lens_columns.first_lens + column * kTileLenses) {}

  // The sub-pixels of a row, from x to before y.
  __device__ int2 row(int r) const {
    if (by_lens)
      return make_int2(lens_start(lens, top + r, first_lens), lens_start(lens, top + r, first_lens + kTileLenses));
    const int first = column * 3 * int(tiling.width);
    return make_int2(first, first + 3 * int(tiling.width));
  }
  // Find the columns of pixels, by a warp of which each lane has a row. False where nothing is on the panel.
  __device__ bool find_columns(int2 row) {
    const int width = 3 * lens.width_px;
    const bool shown = int(threadIdx.x % 32) < rows && row.y > 0 && row.x < width;
    low = shown ? max(row.x, 0) / 3 : lens.width_px, high = shown ? (min(row.y, width) - 1) / 3 : -1;
    for (int step = 16; step > 0; step /= 2)
      low = min(low, __shfl_xor_sync(~0u, low, step)), high = max(high, __shfl_xor_sync(~0u, high, step));
    return high >= low;
  }
  // Find the columns, and write rows, their phases and the columns into the block's memory. By all its threads.
  __device__ void lay_rows(Memory& memory) {
    if (threadIdx.x < 32) {
      const int2 ends = row(threadIdx.x);
      memory.rows[threadIdx.x] = ends;
      memory.phases[threadIdx.x] = unsigned(phase_at(lens, top + int(threadIdx.x), ends.x) >> 32);
      find_columns(ends);
      if (threadIdx.x == 0) memory.low = low, memory.high = high;
    }
    __syncthreads();
    low = memory.low, high = memory.high;
  }
  // Where the lattice's x and y are zero, in pixels.
  __device__ float2 origin() const { return make_float2(float(low), float(top)); }

  // The box that a section's lattice must fill: columns, rows and offsets.
  __device__ LatticePart part(int section) const {
    float centre, half;
    if (by_lens)
      group_offsets(lens.lens_columns, section, centre, half);
    else
      half = 0.5f * float(lens.views) * lens.s_step, centre = lens.s_start + half, half = fabsf(half);
    return {0.5f, float(high - low) + 0.5f, 0.5f, float(rows) - 0.5f, centre - half, centre + half};
  }

  // Bytes of a row, at most.
  __device__ int row_bytes() const { return by_lens ? lens_row_bytes(lens.line_number) : 3 * kPixelTileWidth; }

  // The sub-pixels on the panel that the n-th lens of row r has of a section, from x to before y.
  __device__ int2 run(int r, int section, int n) const {
    const int begin = lens_start(lens, top + r, first_lens + n) + kGroupColumns * section;
    const int end = section == sections - 1 ? lens_start(lens, top + r, first_lens + n + 1) : begin + kGroupColumns;
    return make_int2(max(begin, 0), min(end, 3 * lens.width_px));
  }
};

// x >= 0 as n + part, with n whole and part in [-1e-4, 1): an x just below a whole number counts as whole. Conversions
// to integers are slow, so there is none: after 2^23 + 2^22 is added, the last bits of the float are n.
struct NodePosition {
  static constexpr float kMagic = 12582912.f;
  static constexpr unsigned kMagicBits = 0x4b400000u;
  unsigned bits;  // n + kMagicBits, which whoever needs n subtracts
  float part;

  __device__ explicit NodePosition(float x) {
    const float shifted = (x - 0.4999f) + kMagic;
    bits = __float_as_uint(shifted), part = x - (shifted - kMagic);
  }
};

// Interpolate colours between the nodes of a section. Numbers that are read again and again are copied here, to be in
// registers.
struct Nodes {
  const Corners* corners;
  int across, down, plane_stride;
  float x0, y0, per_x, per_y, last_along;

  __device__ Nodes(const Memory& memory, int section)
      : Nodes(memory.lattices[section], memory.corners[0] + memory.first_node[section]) {}
  __device__ Nodes(const Lattice& lattice, const Corners* corners_)
      : corners(corners_),
        across(lattice.across),
        down(lattice.down),
        plane_stride(lattice.stride()),
        x0(lattice.x0),
        y0(lattice.y0),
        per_x(fast_reciprocal(lattice.step_x)),
        per_y(fast_reciprocal(lattice.step_y)),
        last_along(float(lattice.across - 1 - lattice.margin) - 0.02f) {}

  // Where a row of nodes of a channel begins, less what the bits of a NodePosition are too large by (modulo 2^32).
  __device__ unsigned row_index(int channel, int row) const {
    return unsigned(channel * kChannelNodes + row * across) - NodePosition::kMagicBits;
  }
  // The colour at x0 + along step_x, as seen, `part` (twice in a word) of the way from the row of nodes to the next. It
  // is interpolated straight along y, between the two planes, and along x.
  __device__ float at(unsigned row, __half2 part, float along, const Seen& seen) const {
    const NodePosition node(along - seen.aside);
    const Corners* first = corners + (node.bits + seen.first() + row);
    const Corners here = first[0], next = first[plane_stride];
    const __half2 near = mixed(here.low, here.high, part), far = mixed(next.low, next.high, part);
    const __half2 pair = mixed(near, far, seen.part());
    return fmaf(node.part, __high2float(pair) - __low2float(pair), __low2float(pair));
  }
  // Keep `along` within the lattice.
  __device__ float within(float along) const { return fminf(along, last_along); }
  // The row of nodes before y, and as `part` the way from there to the next.
  __device__ int row(float y, __half2& part) const {
    const float place = (y - y0) * per_y;
    const int row = min(int(place), down - 2);
    part = __float2half2_rn(place - float(row));
    return row;
  }
  static __device__ __half2 mixed(__half2 a, __half2 b, __half2 part) { return __hfma2(part, __hsub2(b, a), a); }
};

// Find what sub-pixels of a section see, as Seen or RowSeen, by their phases. The last 32 bits of phases are left out:
// now and then that gives a sub-pixel at the border of two views the other one.
template <class S>
struct Views {
  const Lattice& lattice;
  const S* table = nullptr;
  unsigned step, whole;  // phase from a sub-pixel to the next; offsets told apart: views, or enough to be continuous
  float slope, base, last_up;

  __device__ Views(const LensOptics& lens, const Lattice& lattice_)
      : lattice(lattice_),
        step(unsigned(lens.phase_x >> 32)),
        whole(lens.continuous ? 1u << 24 : unsigned(lens.views)) {
    const float per_s = fast_reciprocal(lattice.step_s);
    slope = lens.s_step * per_s * (lens.continuous ? float(lens.views) * 0x1p-24f : 1.f);
    base = fmaf(lens.continuous ? 0.f : 0.5f, slope, (lens.s_start - lattice.s0) * per_s);
    last_up = float(lattice.planes - 1) - 1e-3f;
  }
  __device__ S from(unsigned number) const {
    const NodePosition plane(fminf(fmaxf(fmaf(float(number), slope, base), 0.f), last_up));
    return {lattice, int(plane.bits - NodePosition::kMagicBits), plane.part};
  }
  // Make a table if the offsets are few. By all threads of the block; the caller has them wait for each other before
  // the table is read.
  __device__ void tabulate(S (&seen)[kMostTableViews]) {
    if (whole > kMostTableViews) return;
    for (unsigned number = threadIdx.x; number < whole; number += kThreads) seen[number] = from(number);
    table = seen;
  }
  template <bool Table>
  __device__ S at(unsigned phase) const {
    const unsigned number = __umulhi(phase, whole);
    return Table ? table[number] : from(number);
  }
};

}  // namespace
}  // namespace lfgs::cuda
