// How a block of composite_lattice.cu interpolates a tile of lenses, or fills a tile with the background. It reads the
// nodes in shared memory and writes the image. A thread interpolates the run of sub-pixels of one lens in a row. Bytes
// are collected in shared memory, then whole rows are stored at once.
#pragma once

#include "cuda/frame/lattice/lattice_tile.cuh"

namespace lfgs::cuda {
namespace {

// A colour in 0..1 as stored() makes it. Instead of a conversion a number is added that leaves the byte in the bits.
__device__ inline uint8_t to_byte(float c) { return uint8_t(__float_as_uint(fmaf(c, 255.f, NodePosition::kMagic))); }

// Interpolate the sub-pixels [ends.x, ends.y) in row r of a tile of lenses, and call put(m, colour) for each. `phase`
// is that of the first.
template <bool Table, class Put>
__device__ void interpolate_run(const Tile& tile, const Nodes& nodes, const Views<Seen>& views, unsigned phase, int r,
                                int2 ends, const Put& put) {
  __half2 part;
  const int row = nodes.row(float(r) + 0.5f, part), pixel = ends.x / 3, place = ends.x - 3 * pixel;
  const float x_first = (float(pixel) + 0.5f - tile.origin().x - nodes.x0) * nodes.per_x;

  // The nodes' row and the place along x of three sub-pixels, in the order in which they follow in the run
  unsigned channels[3];
  float x[3];
#pragma unroll
  for (int i = 0; i < 3; ++i) {
    const bool next = place + i >= 3;
    const int at = place + i - 3 * next;
    channels[i] = nodes.row_index(tile.lens.channels[at], row), x[i] = next ? x_first + nodes.per_x : x_first;
  }

  // Three at a time
#pragma unroll 1
  for (int m = ends.x; m < ends.y; m += 3) {
    float colours[3];
#pragma unroll
    for (int i = 0; i < 3; ++i) {  // also those behind the end, so that several reads are under way
      colours[i] = nodes.at(channels[i], part, nodes.within(x[i]), views.at<Table>(phase));
      phase += views.step;
    }
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      if (m + i < ends.y) put(m + i, colours[i]);
      x[i] += nodes.per_x;
    }
  }
}

// Interpolate the sub-pixels of a section in the rows [top, end), and call put(r, at, colour) with the place of each in
// its row. By all threads of the block: a thread has the runs of one lens, in some of the rows.
template <bool Table, class Put>
__device__ void interpolate_section(const Tile& tile, const Memory& memory, const Views<Seen>& views, int section,
                                    int top, int end, const Put& put) {
  const Nodes nodes(memory, section);
  const int n = int(threadIdx.x) % kTileLenses;
  for (int r = top + int(threadIdx.x) / kTileLenses; r < end; r += kThreads / kTileLenses) {
    const int first = memory.rows[r].x;
    const int2 ends = tile.run(r, section, n);
    const unsigned phase = memory.phases[r] + views.step * unsigned(ends.x - first);
    interpolate_run<Table>(tile, nodes, views, phase, r, ends, [&](int m, float colour) { put(r, m - first, colour); });
  }
}

// Store the collected bytes of the rows from `top` to before `end`: [rows, row_bytes], each from its first sub-pixel
// on. 16 bytes at a time where the image allows it.
__device__ void store_rows(const Tile& tile, const Memory& memory, int top, int end, int row_bytes, uint8_t* out) {
  const int width = 3 * tile.lens.width_px;
  constexpr int kWord = sizeof(uint4), kWords = 3 * kPixelTileWidth / kWord;
  const bool words = width % kWord == 0 && reinterpret_cast<uintptr_t>(out) % kWord == 0;
  if (words && !tile.by_lens && !tile.lens.permuted) {
    const int first = memory.rows[0].x;
    for (int n = threadIdx.x; n < (end - top) * kWords; n += kThreads) {
      const int m = first + n % kWords * kWord;
      if (m < width)
        *reinterpret_cast<uint4*>(out + int64_t(tile.top + top + n / kWords) * width + m) =
            reinterpret_cast<const uint4*>(memory.interpolated.bytes)[n];
    }
    return;
  }
  for (int r = top + int(threadIdx.x) / 32; r < end; r += kWarps)
    store_row(tile.lens, tile.top + r, memory.rows[r], memory.interpolated.bytes + (r - top) * row_bytes, out);
}

// Draw a tile, as many rows at a time as fit the memory. Call draw(top, end, put) for the rows [top, end), which calls
// put(row, place in it, colour) for every sub-pixel. By all threads of the block, which wait for each other before and
// after `draw`.
template <class Out, class Draw>
__device__ void draw_rows(const Tile& tile, Memory& memory, Out* out, const Draw& draw) {
  const int row_bytes = tile.row_bytes();
  const int fitting = min(int(sizeof memory.interpolated.bytes) / row_bytes, tile.rows);
  for (int top = 0; top < tile.rows; top += fitting) {
    const int end = min(top + fitting, tile.rows);
    __syncthreads();
    draw(top, end, [&](int r, int at, float colour) {
      if constexpr (sizeof(Out) == 1)
        memory.interpolated.bytes[(r - top) * row_bytes + at] = to_byte(colour);
      else
        out[int64_t(tile.top + r) * 3 * tile.lens.width_px + in_image(tile.lens, memory.rows[r].x + at)] =
            __saturatef(colour);
    });
    __syncthreads();
    if constexpr (sizeof(Out) == 1) store_rows(tile, memory, top, end, row_bytes, out);
  }
}

// Interpolate the sub-pixels of a tile of lenses, section after section. By all threads of the block.
template <class Out>
__device__ void interpolate_lenses(const Tile& tile, Memory& memory, Out* out) {
  draw_rows(tile, memory, out, [&](int top, int end, const auto& put) {
    for (int section = 0; section < tile.sections; ++section) {
      if (section > 0) __syncthreads();
      Views<Seen> views(tile.lens, memory.lattices[section]);
      views.tabulate(memory.interpolated.seen);
      __syncthreads();
      if (views.table)
        interpolate_section<true>(tile, memory, views, section, top, end, put);
      else
        interpolate_section<false>(tile, memory, views, section, top, end, put);
    }
  });
}

// Fill a tile with the background. By all threads of the block: a warp has a row at a time.
template <class Out>
__device__ void fill(const Tile& tile, Memory& memory, float4 background, Out* out) {
  const float4 shown = by_place(tile.lens, background);
  draw_rows(tile, memory, out, [&](int top, int end, const auto& put) {
    for (int r = top + int(threadIdx.x) / 32; r < end; r += kWarps) {
      const int first = max(memory.rows[r].x, 0), last = min(memory.rows[r].y, 3 * tile.lens.width_px);
      for (int m = first + int(threadIdx.x) % 32; m < last; m += 32) {
        const int place = m % 3;
        put(r, m - memory.rows[r].x, __saturatef(place == 0 ? shown.x : place == 1 ? shown.y : shown.z));
      }
    }
  });
}

}  // namespace
}  // namespace lfgs::cuda
