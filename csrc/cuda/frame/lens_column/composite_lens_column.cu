// Composite of a light-field frame by tiles of lenses, for rigs of large disparity. Needs tensor cores (sm_80). Read
// the frame's splats and sorted lists, write the image.
//
// The t-th sub-pixels of neighbouring lenses see nearly the same part of the rig: a *lens column* t covers 1 / P_e of
// it. A warp task is 4 lenses x 16 rows at one lens column, 64 samples. x, y and v (the view, scaled) count from the
// centre of the task. The exponent of a splat at a sample is as follows.
//   A(y) - d(x, y, v)^2,   A = log2 o - tau (y - v0)^2,   d = S^(-1/2) (x - m(y, s)) to second order in v.
// Both A and d are inner products of *features* of the sample (1, x, y, v, x v ...) with *coefficients* of the splat. d
// has 16 of them, and A has 8. They are in half precision, large coefficients as the sum of two halves; the tensor
// cores multiply them and add in float. Colours are inner products, too: each sample has features that are not zero
// only for its own channel. A splat's colour enters as the difference to the colour of the splat before. An
// intersection is a splat that may touch the task's samples. It is *exact* where S varies too much within the lens
// column for the polynomial. Then S^(-1/2) is evaluated sample by sample.
//
// A block draws a tile of 16 lenses x 32 rows with 8 warps. The lens columns of a tile come in groups, each with a list
// of splats. A pass draws a whole group or half of one, by the size of shared memory, see BlockLayout. Every lane of a
// quad takes one contiguous quarter of a task's intersections. Over is associative, so the quarters are joined once at
// the end.
#include <cuda_fp16.h>

#include "cuda/frame/lens_column/lens_column_colours.cuh"
#include "cuda/frame/lens_column/lens_column_task.cuh"

namespace lfgs::cuda {
namespace {

#if __CUDA_ARCH__ >= 800
// Bring `count` splats of a list into the block's shared memory, see Memory. Find the patches of the tile that they may
// touch at the lens columns first .. last of a group. Two threads have a splat, one for each row of patches.
template <class Layout>
__device__ void stage(const DirectFrame& frame, const uint32_t* ids, int count, int first_lens, int row0, int first,
                      int last, Memory<Layout>& memory) {
  static_assert(kWarpsDown == 2);
  const float4* colours = reinterpret_cast<const float4*>(frame.splats.colours);
  constexpr int kLooked = Memory<Layout>::kLooked;
  for (int j = threadIdx.x; j < 2 * ((count + kLooked - 1) / kLooked * kLooked); j += kThreads) {
    const int i = j / 2, down = j % 2;
    if (i >= count) {
      memory.touched[down][i] = 0;
      continue;
    }
    const uint32_t id = ids[i];
    const Splat<float> splat = splat_with_entry(frame, id);
    if constexpr (Layout::kCompact) {
      if (down == 0) memory.id[i] = id;
    } else if (down == 0) {
      memory.splat[0][i] = make_float4(splat.u0, splat.du, splat.v0, splat.log2_opacity);
      memory.splat[1][i] = make_float4(splat.S0, splat.S1, splat.S2, splat.tau);
    } else {
      memory.splat[2][i] = make_float4(splat.c0, splat.c1, splat.reach_y, splat.depth);
      if (Layout::kHoldsColours) memory.colour[Layout::kHoldsColours ? i : 0] = by_place(frame.optics, colours[id]);
    }
    const int first_row = row0 + down * kWarpRows;
    memory.touched[down][i] = patches_touched(frame.optics, splat, first_lens, first_row, first, last);
  }
}

// Draw one tile, by all threads of the block. In the full layout bytes are collected in shared memory and then stored
// row by row; otherwise what is finished goes straight to the image.
template <bool Compensated, class Layout, class Out>
__device__ void draw_tile(const DirectFrame& frame, const Lists& lists, unsigned tile, int row_bytes,
                          const float4& background, Out* out, Memory<Layout>& memory) {
  constexpr bool kBytes = sizeof(Out) == 1;
  const LensOptics& lens = frame.optics;
  const LensColumns& lens_columns = lens.lens_columns;
  const int tile_x = tile % frame.lens_column.across, tile_y = tile / frame.lens_column.across,
            width = 3 * lens.width_px;
  const int first_lens = lens_columns.first_lens + tile_x * kTileLenses;

  // Where the tile's rows begin and end; where none is on the panel there is nothing to draw
  bool shown = false;
  for (int r = threadIdx.x; r < kTileRows; r += kThreads) {
    const int row = tile_y * kTileRows + r;
    const int2 ends = make_int2(lens_start(lens, row, first_lens), lens_start(lens, row, first_lens + kTileLenses));
    memory.rows[r] = ends;
    shown = row < lens.height_px && ends.y > 0 && ends.x < width;
  }
  if (!__syncthreads_or(shown)) return;
  Task<Layout, Compensated> task(frame, memory, tile_x, tile_y);

  // `put` takes the colour of a finished sample
  uint8_t* bytes = reinterpret_cast<uint8_t*>(&memory + 1);
  auto put = [&](const auto& sample, float value) {
    if constexpr (kBytes && !Layout::kCompact) {
      bytes[sample.row * row_bytes + sample.m - memory.rows[sample.row].x] = stored(value, out);
    } else {
      const int m = lens.permuted ? sample.m - sample.place + lens.channels[sample.place] : sample.m;
      out[int64_t(tile_y * kTileRows + sample.row) * width + m] = stored(value, out);
    }
  };

  // Pass by pass: walk the list in batches that fit shared memory, until all samples are opaque. A batch is staged for
  // all passes of its group, and once only where it is the whole list
  constexpr unsigned kNone = ~0u;
  unsigned staged = kNone;  // where the batch begins that is in shared memory
  for (int first = 0; first < lens_columns.count; first += Layout::kLensColumns) {
    const int group = first / kGroupColumns, of_group = group * kGroupColumns;
    const int last = min(first + Layout::kLensColumns, lens_columns.count) - 1;
    const int last_of_group = min(of_group + kGroupColumns, lens_columns.count) - 1;
    if (first == of_group) staged = kNone;
    task.clear(first);
    const uint2 range = lists.range(int64_t(tile) * lens_columns.groups + group);
    for (unsigned begin = range.x; begin < range.y; begin += Layout::kBatch) {
      const int count = min(unsigned(Layout::kBatch), range.y - begin);
      const bool opaque = task.all_opaque(last - first + 1);
      if (!Layout::kCompact || staged != begin) {
        if (__syncthreads_and(opaque)) break;
        stage(frame, lists.ids + begin, count, first_lens, tile_y * kTileRows, of_group, last_of_group, memory);
        __syncthreads();
        staged = begin;
      }
      if (opaque) continue;
#pragma unroll 1
      for (int lens_column = first; lens_column <= last; ++lens_column) {
        const int t = lens_column - first;
        if (task.opaque(t)) continue;
        const int n = task.cull(lens_column - of_group, count);
        if (n > 0) task.draw(t, n, lens_column);
      }
    }
    __syncwarp();
    task.finish(first, last, background, put);
  }

  // Full layout: store the bytes, a row a warp
  if constexpr (kBytes && !Layout::kCompact) {
    __syncthreads();
    for (int r = threadIdx.x / 32; r < kTileRows; r += kWarps) {
      const int row = tile_y * kTileRows + r;
      if (row < lens.height_px) store_row(lens, row, memory.rows[r], bytes + r * row_bytes, out);
    }
  }
}
#endif

// Draw the frame, if it has chosen this kernel. There are as many blocks as the device holds at a time. Each draws one
// tile after another until none is left. Task describes the part of a thread.
template <class Layout, bool Compensated, class Out>
__global__ void __launch_bounds__(kThreads, 2)
    composite_lens_column_kernel(const __grid_constant__ DirectFrame frame, int row_bytes, const float* background,
                                 Out* out) {
#if __CUDA_ARCH__ >= 800
  if (!frame.lens_column_chosen()) return;
  extern __shared__ __align__(16) char shared[];
  Memory<Layout>& memory = *reinterpret_cast<Memory<Layout>*>(shared);
  const float4 behind = by_place(frame.optics, make_float4(background[0], background[1], background[2], 0));
  const Lists lists(frame);
  const unsigned tiles = tiles_to_draw(frame, frame.lens_column);
  WorkQueue work(frame, FrameKernel::kLensColumn);
  constexpr int kBlack = Layout::kHoldsColours ? Layout::kBatch : 0;  // see Task::colour()
  if (Layout::kHoldsColours && threadIdx.x == 0) memory.colour[kBlack] = make_float4(0, 0, 0, 0);
  for (unsigned tile = blockIdx.x; tile < tiles; tile = memory.next_tile) {
    if (threadIdx.x == 0) work.claim(gridDim.x);
    draw_tile<Compensated>(frame, lists, tile_to_draw(frame, tile), row_bytes, behind, out, memory);
    __syncthreads();
    if (threadIdx.x == 0) memory.next_tile = work.claimed;
    __syncthreads();
  }
#endif
}

// The shared memory of a block.
template <class Layout>
size_t block_bytes(float line_number) {
  return sizeof(Memory<Layout>) + (Layout::kCompact ? 0 : kTileRows * lens_row_bytes(line_number));
}

// Let blocks of a kernel take so much shared memory, and ask for two of them on a multiprocessor. The rest of its
// memory there is cache.
template <class Kernel>
void allow_shared_memory(Kernel kernel, size_t bytes) {
  int device = 0, all = 0;
  check(cudaGetDevice(&device), "composite_lens_column: device");
  check(cudaDeviceGetAttribute(&all, cudaDevAttrMaxSharedMemoryPerMultiprocessor, device),
        "composite_lens_column: memory of a multiprocessor");
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(bytes)),
        "composite_lens_column: shared memory");
  const int percent = int(blocks_for(100 * 2 * int64_t(bytes + kReservedBytes), all));
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributePreferredSharedMemoryCarveout, std::min(percent, 100)),
        "composite_lens_column: cache");
}

// Launch the kernel that draws, after those that make colours and compensations by lens column where the scene needs
// them.
template <class Layout, bool Compensated, class Out>
void launch(const DirectFrame& frame, const float* background, Out* out, cudaStream_t stream) {
  if (Layout::kHarmonics && frame.splats.count) {
    const int64_t items = frame.splats.count * (frame.optics.lens_columns.columns() / kPerThread);
    lens_column_colours_kernel<<<unsigned(blocks_for(items, kColourThreads)), kColourThreads, 0, stream>>>(frame);
    check_launch("composite_lens_column: colours");
  }
  if (Compensated && frame.splats.count) {
    const int64_t items = frame.splats.count * frame.optics.lens_columns.columns();
    lens_column_compensations_kernel<<<unsigned(blocks_for(items, kColourThreads)), kColourThreads, 0, stream>>>(frame);
    check_launch("composite_lens_column: compensations");
  }
  const auto kernel = composite_lens_column_kernel<Layout, Compensated, Out>;
  const size_t bytes = block_bytes<Layout>(frame.optics.line_number);
  const int row = lens_row_bytes(frame.optics.line_number);
  allow_shared_memory(kernel, bytes);
  kernel<<<resident_blocks(kernel, kThreads, bytes), kThreads, bytes, stream>>>(frame, row, background, out);
  check_launch("composite_lens_column");
}

// Whether the kernel can draw a lens, on a device whose shared memory holds its tiles.
bool suits_lens_columns(const Lens& lens) {
  const double number = lens.line_number, views_each = double(lens.views) / number;
  if (!lens.has_cells) return number >= kMinLineNumber && number <= kMaxLineNumber && views_each <= kMostViewsEach;
  // With cells there are two more lens columns, and each sees more views. All sub-pixels at a place must have one
  // channel
  return number >= kMinCellLineNumber && number <= kMaxLineNumber - 2 && lens.stands_in_order() &&
         lens.has_one_order() && (1 + 2 * lens.most_beyond()) * views_each <= kMostViewsEach;
}

}  // namespace

// Ask for the kernels' architecture, since a device may run PTX made for an older one without tensor cores.
LensColumnLayout lens_column_layout(const Lens& lens, int64_t shared_memory) {
  int device = 0, limit = 0;
  cudaFuncAttributes built{};
  check(cudaGetDevice(&device), "composite_lens_column: device");
  check(cudaFuncGetAttributes(&built, lens_column_colours_kernel), "composite_lens_column: architecture");
  check(cudaDeviceGetAttribute(&limit, cudaDevAttrMaxSharedMemoryPerBlockOptin, device),
        "composite_lens_column: shared memory");
  const int64_t most = shared_memory ? std::min(shared_memory, int64_t(limit)) : limit;
  if (built.ptxVersion < 80 || most < kCompactBytes || !suits_lens_columns(lens)) return LensColumnLayout::kNone;
  // A multiprocessor has the memory of the largest block, and the system's memory for that block
  const int64_t full = int64_t(block_bytes<BlockLayout<true, false>>(float(lens.line_number)));
  return 2 * (full + kReservedBytes) <= most + kReservedBytes ? LensColumnLayout::kFull : LensColumnLayout::kCompact;
}

void composite_lens_column(const DirectFrame& frame, const float* background, float* out, uint8_t* out8,
                           Stream stream) {
  if (!frame.has_lens_column()) return;
  auto in_layout = [&](auto layout, auto* image) {
    const auto to = cudaStream_t(stream);
    using Chosen = decltype(layout);
    if (frame.rig.compensated())
      launch<Chosen, true>(frame, background, image, to);
    else
      launch<Chosen, false>(frame, background, image, to);
  };
  auto draw = [&](auto harmonics, auto* image) {
    if (frame.lens_column_layout == LensColumnLayout::kCompact)
      in_layout(BlockLayout<harmonics, true>(), image);
    else
      in_layout(BlockLayout<harmonics, false>(), image);
  };
  auto to_image = [&](auto* image) {
    frame.splats.orders ? draw(std::true_type(), image) : draw(std::false_type(), image);
  };
  out8 ? to_image(out8) : to_image(out);
}

}  // namespace lfgs::cuda
