// How a block of composite_lattice interpolates a tile of lenses, runs of sub-pixels side by side and then rows at
// once, or fills a tile with the background.
#pragma once

#include "cuda/frame/lattice/lattice_tile.cuh"

namespace lfgs::cuda {
namespace {

// A colour in 0..1 -> stored(), without a conversion.
__device__ inline uint8_t byte_of(float c) { return uint8_t(__float_as_uint(fmaf(c, 255.f, Place::kMagic))); }

// Interpolates a run of sub-pixels of row r of a tile of lenses, the first with this phase: put(m, colour).
template <bool Table, class Put>
__device__ void interpolate_run(const Tile& tile, const Nodes& nodes, const Views<Seen>& views, unsigned phase, int r,
                                int2 ends, const Put& put) {
  __half2 part;
  const int row = nodes.row(float(r) + 0.5f, part), pixel = ends.x / 3, place = ends.x - 3 * pixel;
  const float x_first = (float(pixel) + 0.5f - tile.origin().x - nodes.x0) * nodes.per_x;
  unsigned channels[3];
  float x[3];
#pragma unroll
  for (int i = 0; i < 3; ++i) {  // in the order in which the sub-pixels follow
    const bool next = place + i >= 3;
    const int at = place + i - 3 * next;
    channels[i] = nodes.row_of(tile.lens.channels[at], row), x[i] = next ? x_first + nodes.per_x : x_first;
  }
#pragma unroll 1
  for (int m = ends.x; m < ends.y; m += 3) {
    float colours[3];
#pragma unroll
    for (int i = 0; i < 3; ++i) {  // all of them, to have several reads under way
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

// The same for all of the rows from `top` to before `end` that a section has: put(r, at, colour), with the place in the
// row.
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

// Stores the bytes of rows of a tile: [rows, row_bytes], from the first sub-pixel of each on.
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

// Draws a tile some rows at a time: draw(top, end, put) for the rows from `top` to before `end`, with put(row, place in
// it, colour). By all threads of the block, which wait for each other before and after.
template <class Out, class Draw>
__device__ void draw_rows(const Tile& tile, Memory& memory, Out* out, const Draw& draw) {
  const int row_bytes = tile.row_bytes();
  const int fitting = min(int(sizeof memory.interpolated.bytes) / row_bytes, tile.rows);
  for (int top = 0; top < tile.rows; top += fitting) {
    const int end = min(top + fitting, tile.rows);
    __syncthreads();
    draw(top, end, [&](int r, int at, float colour) {
      if constexpr (sizeof(Out) == 1)
        memory.interpolated.bytes[(r - top) * row_bytes + at] = byte_of(colour);
      else
        out[int64_t(tile.top + r) * 3 * tile.lens.width_px + in_image(tile.lens, memory.rows[r].x + at)] =
            __saturatef(colour);
    });
    __syncthreads();
    if constexpr (sizeof(Out) == 1) store_rows(tile, memory, top, end, row_bytes, out);
  }
}

// Interpolates the sub-pixels of a tile of lenses.
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

// Fills a tile with the background.
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
