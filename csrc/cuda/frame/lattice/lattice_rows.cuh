// How a block of composite_lattice.cu interpolates a tile of pixels. It reads the nodes in shared memory and writes the
// image.
//
// Many rows of pixels lie between two rows of nodes, so the block interpolates the nodes along y first, to every row of
// pixels. For each sub-pixel there is left to interpolate along x and the view, in halves; a thread does so for four
// sub-pixels side by side. (A row of a tile of lenses has more nodes and fewer sub-pixels: see
// lattice_interpolate.cuh.)
#pragma once

#include "cuda/frame/lattice/lattice_tile.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kWords = 3 * kPixelTileWidth / 4;  // words of four sub-pixels in a row
// A thread works on kColumns words, and on the same words in every kRowsOn-th row.
constexpr int kColumns = 3, kRowsOn = kColumns * kThreads / kWords;
static_assert(kRowsOn * kWords == kColumns * kThreads);

// The nodes interpolated to the rows of pixels of a tile, from `top` on. There is an interval between neighbouring
// nodes for each channel and each plane but the last.
struct NodeRows {
  const Nodes& nodes;
  const Lattice& lattice;
  Between* between;
  int of_channel, of_row, top = 0;

  __device__ NodeRows(const Nodes& nodes_, const Lattice& lattice_, Memory& memory)
      : nodes(nodes_),
        lattice(lattice_),
        between(memory.interpolated.between),
        of_channel((lattice.planes - 1) * lattice.across),
        of_row(3 * of_channel) {}

  // How many rows are laid at a time: what fits, and in whole turns of the threads if there are several.
  __device__ int fitting(int rows) const {
    const int fit = min(quotient(kMostBetween, of_row), rows);
    return fit < rows && fit > kRowsOn ? fit / kRowsOn * kRowsOn : fit;
  }
  __device__ int first_between(int row) const { return (row - top) * of_row; }

  // Lay rows from top_ to before `end`. By all threads of the block: a thread has one node of one channel and plane,
  // in all rows or in some of them.
  __device__ void lay(int top_, int end) {
    top = top_;
    const int rows_on = max(quotient(kThreads, of_row), 1), first = rows_on > 1 ? quotient(threadIdx.x, of_row) : 0;
    if (first >= rows_on) return;
#pragma unroll 1
    for (int n = int(threadIdx.x) - first * of_row; n < of_row; n += kThreads) {
      const int channel = quotient(n, of_channel), in_channel = n - channel * of_channel;
      const int k = quotient(in_channel, lattice.across), i = in_channel - k * lattice.across;
      const Corners* planes = nodes.corners + channel * kChannelNodes;
      const Corners* near = planes + lattice.plane[k].first + i;
      // Where the next plane has no such node, no sample sees this one, and any will do
      const int on = min(max(i + int(lattice.plane[k].aside), 0), lattice.across - 1);
      const Corners* far = planes + lattice.plane[k + 1].first + on;
#pragma unroll 1
      for (int r = top + first; r < end; r += rows_on) {
        __half2 part;
        const int row = nodes.row(float(r) + 0.5f, part) * lattice.across;
        const Corners &a = near[row], &b = far[row];
        between[first_between(r) + n] = Between(Nodes::mixed(a.low, a.high, part), Nodes::mixed(b.low, b.high, part));
      }
    }
  }
};

// Four colours, 0..1, as bytes. Instead of a conversion 1024 is added: a half of that size has steps of one.
__device__ inline unsigned pack_bytes(__half2 first, __half2 second) {
  const __half2 scale = __float2half2_rn(255.f), magic = __float2half2_rn(1024.f);
  return __byte_perm(bits(__hfma2(first, scale, magic)), bits(__hfma2(second, scale, magic)), 0x6420);
}

// Put four colours into a row of the image, from number `first` of the row on. Words: the image is of bytes, and they
// may be stored four at a time.
template <bool Words, class Out>
__device__ void put_four(int width, int first, __half2 low, __half2 high, Out* row) {
  if constexpr (Words) {
    *reinterpret_cast<unsigned*>(row + first) = pack_bytes(low, high);
    return;
  }
  const float colours[4] = {__low2float(low), __high2float(low), __low2float(high), __high2float(high)};
  for (int i = 0; i < 4; ++i)
    if (first + i < width) row[first + i] = stored(colours[i], row);
}

// Interpolate the tile's sub-pixels in the rows that were laid, to before `end`, in the order of the image. Table:
// whether `views` has one.
template <bool Table, bool Words, class Out>
__device__ void interpolate_rows(const Tile& tile, const Memory& memory, const Views<RowSeen>& views,
                                 const NodeRows& rows, int end, Out* out) {
  const LensOptics& lens = tile.lens;
  const Nodes& nodes = rows.nodes;
  const int tile_first = memory.rows[0].x, width = 3 * lens.width_px;
#pragma unroll 1
  for (int n = threadIdx.x; n < kColumns * kThreads; n += kThreads) {
    const int word = n % kWords, channel = word % 3, pixel = word + word / 3, first = tile_first + 4 * word;
    if (first >= width) continue;

    // Common to the four in every row: the place along x, and the phase from the first sub-pixel of the row on
    const float x = float(tile_first / 3 + pixel) + 0.5f - tile.origin().x - nodes.x0;
    const unsigned here = fixed(nodes.within(x * nodes.per_x)), next = fixed(nodes.within((x + 1) * nodes.per_x));
    unsigned along[4], phase_on[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      const bool inside = channel + i < 3;
      const int c = inside ? channel + i : channel + i - 3;
      along[i] = (inside ? here : next) + (unsigned(c * rows.of_channel) << 16);
      phase_on[i] = views.step * unsigned(3 * (inside ? pixel : pixel + 1) + lens.places[c]);
    }

    // Row after row
    int r = rows.top + n / kWords;
    unsigned base = rows.first_between(r);
    Out* row = out + int64_t(tile.top + r) * width;
#pragma unroll 1
    for (; r < end; r += kRowsOn, base += kRowsOn * rows.of_row, row += kRowsOn * width) {
      const unsigned phase = memory.phases[r];
      unsigned at[4];
      __half2 pair[4];
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        const RowSeen seen = views.at<Table>(phase + phase_on[i]);
        at[i] = along[i] + seen.on;
        const Between line = rows.between[base + (at[i] >> 16)];
        pair[i] = __hfma2(seen.part, line.change, line.first_and_step);
      }
      auto colours = [&](int i) {
        const unsigned parts = __byte_perm(at[i], at[i + 1], 0x5410) >> 6 & 0x03ff03ffu;  // of the way, as 1 .. 2
        return __hfma2_sat(as_half2(parts | 0x3c003c00u), __highs2half2(pair[i], pair[i + 1]),
                           __lows2half2(pair[i], pair[i + 1]));
      };
      put_four<Words>(width, first, colours(0), colours(2), row);
    }
  }
}

// Interpolate the sub-pixels of a tile of pixels. By all threads of the block.
template <class Out>
__device__ void interpolate_pixels(const Tile& tile, Memory& memory, Out* out) {
  const Lattice& lattice = memory.lattices[0];
  const Nodes nodes(memory, 0);
  NodeRows rows(nodes, lattice, memory);
  __syncthreads();
  Views<RowSeen> views(tile.lens, lattice);
  views.tabulate(memory.interpolated.row_seen);
  const int fitting = rows.fitting(tile.rows);

  // As many rows at a time as fit the memory
  const bool words = sizeof(Out) == 1 && tile.lens.width_px % 4 == 0 && reinterpret_cast<uintptr_t>(out) % 4 == 0;
  for (int top = 0; top < tile.rows; top += fitting) {
    const int end = min(top + fitting, tile.rows);
    if (top > 0) __syncthreads();
    rows.lay(top, end);
    __syncthreads();
    if (views.table && words)
      interpolate_rows<true, sizeof(Out) == 1>(tile, memory, views, rows, end, out);
    else if (views.table)
      interpolate_rows<true, false>(tile, memory, views, rows, end, out);
    else
      interpolate_rows<false, false>(tile, memory, views, rows, end, out);
  }
}

}  // namespace
}  // namespace lfgs::cuda
