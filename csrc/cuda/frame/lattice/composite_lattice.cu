// Composite of a light-field frame where the light field is smooth: twin of cpu/direct/direct_lattice-inl.h on the
// device. Read the splats and the sorted lists of the frame. Write the image where a lattice is good enough, and the
// numbers of all other tiles into DirectFrame::refused.
//
// It uses the tiles and lists of the kernel that the frame chose. First a warp lays a coarse lattice in (x, y, view)
// through every section of a tile (see lattice_tile.cuh). Where that pays, a block draws the nodes, all channels at
// once, and the middles of cells. Where the middles show that interpolation is as good as asked for, the block
// interpolates the tile's sub-pixels. Tiles that are refused are left to the kernel chosen. Some rows of tiles go
// first, as probes: where lattices fit in few of their tiles, the rows between do not try.
#include "cuda/common/launch.h"
#include "cuda/frame/lattice/lattice_errors.cuh"
#include "cuda/frame/lattice/lattice_interpolate.cuh"
#include "cuda/frame/lattice/lattice_rows.cuh"

namespace lfgs::cuda {
namespace {

// Blocks on a multiprocessor. They leave few registers, so loops that are short or rare are not unrolled.
constexpr int kBlocks = 7;
constexpr int kAttempts = 2;
constexpr unsigned kLeastListed = 8;   // a tile of fewer splats is drawn before a lattice is laid
constexpr unsigned kLeastFitting = 3;  // lattices must fit one in so many of the tiles that a probed row tried

// Copy splats of a list into shared memory, with their colours and 1 / S on every plane of the lattice and half-way
// between planes. By all threads of the block: a thread makes the shape of a splat at one of these offsets.
__device__ void stage(const List& list, unsigned begin, int count, const Lattice& lattice, Staged& staged) {
  const int half_planes = 2 * lattice.planes - 1, shapes = count * half_planes;
  static_assert(kBatch <= kThreads);
  int n = threadIdx.x;
  int i = quotient(n, half_planes);
  uint32_t id = n < shapes ? list.ids[begin + i] : 0;  // asked for early

  // The geometry of the splats: by the last threads of the block, which have the fewest shapes
  const int mine = int(threadIdx.x) - (kThreads - kBatch);
  if (mine >= 0 && mine < count) {
    const Splat<float> s = list.splat(begin + mine);
    staged.place[mine] = make_float4(s.u0, s.du, s.v0, s.log2_opacity);
    staged.form[mine] = make_float4(s.tau, s.c0, s.c1, 0);
  }

  // The shapes; the number of the next one's splat is read while this one is worked out
#pragma unroll 1
  while (n < shapes) {
    const float s = fmaf(0.5f * float(n - i * half_planes), lattice.step_s, lattice.s0);
    const float4 shape = list.shape(id, s);
    const int next = n + kThreads;
    i = quotient(next, half_planes);
    id = next < shapes ? list.ids[begin + i] : 0;
    staged.shapes[n] = shape, n = next;
  }
}

// Blend the staged splats from `first` to before `end` at a point. `seen` has the colour of the point so far, and in w
// its transmittance. The splat at which a point ends takes the light that is left.
__device__ void add_staged(const Staged& staged, int first, int end, int half_planes, const Point& point, float stop,
                           float4& seen) {
  const float4* shape = staged.shapes + first * half_planes + point.half_plane;
#pragma unroll 2
  for (int i = first; i < end; ++i, shape += half_planes) {
    const float4 place = staged.place[i], form = staged.form[i], here = *shape;
    const float dy = point.y - place.z, A = fmaf(-form.x * dy, dy, place.w);
    const float dx = point.x - place.x - form.y * dy - point.s * fmaf(form.z, dy, place.y);
    const float weight = to_alpha(fmaf(-here.w * dx, dx, A)) * seen.w, after = seen.w - weight;
    const float light = after < stop ? seen.w : weight;
    seen.w = after < stop ? 0.f : after;
    seen.x = fmaf(light, here.x, seen.x), seen.y = fmaf(light, here.y, seen.y), seen.z = fmaf(light, here.z, seen.z);
  }
}

// Where 1 << log2_parts threads share a point: the part and the point of this thread.
__device__ int own_part(int log2_parts) { return int(threadIdx.x) * (1 << log2_parts) / kThreads; }
__device__ int number_abreast(int log2_parts) { return int(threadIdx.x) & ((kThreads >> log2_parts) - 1); }

// Return the colour, 0..1, of this thread's point. Where there are few points, several threads have the same point.
// Each of them blends a part of the staged splats, and then they join the parts. All threads of the block call this.
__device__ float3 draw(const List& list, const Lattice& lattice, const Point& point, int log2_parts, float stop,
                       float4 background, Memory& memory) {
  const int half_planes = 2 * lattice.planes - 1, batch = min(kBatch, quotient(kShapes, half_planes));
  float4 seen = make_float4(0, 0, 0, point.node || point.middle ? 1.f : 0.f);
  for (unsigned begin = 0; begin < list.count; begin += batch) {
    if (begin > 0 && __syncthreads_and(seen.w < stop)) break;
    const int count = min(unsigned(batch), list.count - begin);
    stage(list, begin, count, lattice, memory.staged);
    __syncthreads();
    if (log2_parts == 0) {
      if (!__all_sync(~0u, seen.w == 0)) add_staged(memory.staged, 0, count, half_planes, point, stop, seen);
      continue;
    }
    // Blend this thread's part, then join the parts of the point from front to back
    float4 part = make_float4(0, 0, 0, 1);
    const int each = (count + (1 << log2_parts) - 1) >> log2_parts, from = own_part(log2_parts) * each;
    add_staged(memory.staged, from, min(from + each, count), half_planes, point, stop, part);
    memory.parts[threadIdx.x] = part;
    __syncthreads();
    for (int n = number_abreast(log2_parts); n < kThreads; n += kThreads >> log2_parts) {
      const float4 next = memory.parts[n];
      seen.x = fmaf(seen.w, next.x, seen.x), seen.y = fmaf(seen.w, next.y, seen.y);
      seen.z = fmaf(seen.w, next.z, seen.z), seen.w *= next.w;
    }
  }
  return make_float3(__saturatef(fmaf(seen.w, background.x, seen.x)), __saturatef(fmaf(seen.w, background.y, seen.y)),
                     __saturatef(fmaf(seen.w, background.z, seen.z)));
}

// Draw a section's nodes and the middles of its cells, by all threads of the block. Return the error at the middles,
// relative to the allowed one. If it is above 1, nodes are moved to lower it. Then the error that is left counts, or
// the largest move if that is more.
__device__ float draw_lattice(const DirectFrame& frame, const List& list, int section, float4 background,
                              Memory& memory) {
  const Lattice& lattice = memory.lattices[section];
  const float stop = fminf(frame.stop, fmaxf(0.1f * frame.lattice, float(kMinTransmittance)));
  const int nodes = lattice.nodes(), points = lattice.points(), numbers = 3 * (points - nodes);
  const int log2_parts = points <= kThreads / 4 ? 2 : points <= kThreads / 2 ? 1 : 0;
  // A thread draws one point at a time; it stores a node, and compares a middle with its interpolation
  ErrorSums sums;
  for (int first = 0; first < points; first += kThreads) {
    const int number = first + number_abreast(log2_parts);
    const Point point(lattice, number);
    const float3 colour = draw(list, lattice, point, log2_parts, stop, background, memory);
    const bool keeps = own_part(log2_parts) == 0;
    if (keeps && point.node) store_node(lattice, point, colour, place_index(memory, lattice, section, point), memory);
    __syncthreads();
    if (keeps && point.middle) {
      sums.add(difference(interpolated(lattice, Nodes(memory, section), point), colour));
      memory.middles[number - nodes] = Triple(colour);
    }
  }

  // Good as it is, or good after nodes have moved
  const float error = sums.of_block(memory, numbers, kMeanFactor) / frame.lattice;
  if (error <= 1) return error;
  sums = {move_nodes(lattice, section, memory), 0};
  __syncthreads();
  for_each_error(lattice, section, memory, [&](int, float3 e) { sums.add(e); });
  return sums.of_block(memory, numbers, kMovedFactor) / frame.lattice;
}

// Draw the lattice that was laid through a section, or if need be a finer one; return whether one of them is good
// enough. By all threads of the block.
__device__ bool fits(const DirectFrame& frame, const List& list, const LatticePart& part, int section,
                     float4 background, Memory& memory) {
  Lattice& lattice = memory.lattices[section];
  LatticePlanner& planner = *reinterpret_cast<LatticePlanner*>(memory.planner);
  float fineness = first_fineness(frame.lattice);
  for (int attempt = 1;; ++attempt) {
    if (memory.first_node[section] + lattice.places() > kMostNodes) return false;
    const float error = draw_lattice(frame, list, section, background, memory);
    if (error <= 1 || attempt == kAttempts) return error <= 1;

    // Lay a finer one, unless that takes too many nodes to pay
    fineness *= fmaxf(kBackOff * rsqrtf(error), 0.4f);
    __syncthreads();
    bool pays = true;
    if (threadIdx.x < 32) {
      if (attempt == 1) planner.measure(list, part);
      pays = planner.lay(fineness, lattice);
    }
    if (!__syncthreads_and(pays)) return false;
  }
}

// The i-th row of tiles that is drawn. The probed rows go first, to learn where lattices are worth trying.
__device__ int row_index(int i, int probes) {
  const int between = i - probes;
  return i < probes ? i * kProbeRows : between / (kProbeRows - 1) * kProbeRows + between % (kProbeRows - 1) + 1;
}

// The state of a probed row: the number of tiles that are done, that tried a lattice, and that have one that fits. The
// three counts are in one word, so that a reader gets all of them from the same moment.
class ProbedRow {
 public:
  __device__ explicit ProbedRow(const unsigned long long& counts)
      : counts_(static_cast<const volatile unsigned long long&>(counts)) {}
  // Add a tile that is done. Called by one thread of its block.
  static __device__ void report(unsigned long long& counts, bool tried, bool fits) {
    atomicAdd(&counts, 1ull | (unsigned long long)(tried) << kBits | (unsigned long long)(fits) << 2 * kBits);
  }
  __device__ bool done(int tiles) const { return count(0) >= unsigned(tiles); }
  __device__ bool worth() const { return kLeastFitting * count(2) >= count(1); }

 private:
  static constexpr int kBits = 21;
  unsigned long long counts_;
  __device__ unsigned count(int which) const { return unsigned(counts_ >> which * kBits) & ((1u << kBits) - 1); }
};

// The verdict of the probed rows above and below on a row between them. Lattices are worth trying if one of these rows
// has enough tiles with a fitting lattice. They are not if both rows are done and neither has.
enum Verdict : int { kUnknown, kWorth, kNotWorth };

__device__ Verdict verdict_on(const FrameState& state, const Tiling& tiling, int row) {
  const int probe = row / kProbeRows, last = (tiling.down - 1) / kProbeRows;
  const ProbedRow above(state.probed[probe]), below(state.probed[min(probe + 1, last)]);
  const bool above_done = above.done(tiling.across), below_done = below.done(tiling.across);
  if ((above_done && above.worth()) || (below_done && below.worth())) return kWorth;
  return above_done && below_done ? kNotWorth : kUnknown;
}

// Leave a tile to the kernel chosen. Called by one thread of the block.
__device__ void refuse(const DirectFrame& frame, int tile) {
  frame.refused[atomicAdd(&frame.state->refused_tiles, 1u)] = unsigned(tile);
}
__device__ uint2 section_range(const Lists& lists, const Tile& tile, int section) {
  return lists.range(int64_t(tile.number) * tile.sections + section);
}
__device__ List make_list(const DirectFrame& frame, const Lists& lists, const Tile& tile, uint2 range) {
  return {frame.splats, lists.ids + range.x, range.y - range.x, tile.origin()};
}

// Why a tile has no lattices; stored as the number of planes of its first lattice. In order: the tile is off the panel;
// it has no splats, only background; its splats are few or unlisted; a lattice would not pay. In the last two cases the
// chosen kernel draws the tile.
enum Unlaid : int { kUnseen = -3, kEmpty = -2, kUntried = -1, kPaysNot = 0 };

// Lay lattices through the sections of all tiles, and write them into DirectFrame::lattices. A warp has one tile.
__global__ void __launch_bounds__(kThreads) plan_lattices_kernel(const __grid_constant__ DirectFrame frame) {
  __shared__ LatticePlanner planners[kWarps];
  __shared__ Lattice laid[kWarps];
  if (!frame.state->lattices) return;
  const Tiling& tiling = frame.tiling();
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32, number = int(blockIdx.x) * kWarps + warp;
  if (number >= tiling.across * tiling.down) return;
  Tile tile(frame, tiling, number / tiling.across, number % tiling.across);
  const bool seen = tile.find_columns(tile.row(lane));

  // How many splats are in the tile; where one list has the splats of all tiles, no lattice is tried
  const Lists lists(frame);
  const bool listed_apart = seen && lists.ranges != nullptr;
  unsigned listed = 0;
  for (int section = 0; listed_apart && section < tile.sections; ++section)
    listed += make_list(frame, lists, tile, section_range(lists, tile, section)).count;
  const bool empty = listed_apart && listed == 0, tried = listed_apart && listed >= kLeastListed;

  // A lattice for every section, as long as all of them pay and fit the memory of a block
  Lattice* lattices = frame.lattices + int64_t(number) * tile.sections;
  bool pays = tried;
  for (int section = tile.sections - 1, places = 0; pays && section >= 0; --section) {
    LatticePlanner& planner = planners[warp];
    Lattice& lattice = laid[warp];
    planner.measure(make_list(frame, lists, tile, section_range(lists, tile, section)), tile.part(section));
    pays = planner.lay(first_fineness(frame.lattice), lattice) && (places += lattice.places()) <= kMostNodes;
    for (int k = lane; pays && k < int(sizeof lattice / sizeof(int)); k += 32)
      reinterpret_cast<int*>(lattices + section)[k] = reinterpret_cast<const int*>(&lattice)[k];
    __syncwarp();
  }
  if (lane == 0 && !pays) lattices->planes = !seen ? kUnseen : empty ? kEmpty : !tried ? kUntried : kPaysNot;
}

// Draw the nodes of a tile's lattices; false where one of them is not good enough. range is that of the first
// section's list.
__device__ bool draw_tile(const DirectFrame& frame, const Lists& lists, const Tile& tile, uint2 range,
                          float4 background, Memory& memory) {
  for (int section = 0;; range = section_range(lists, tile, section)) {
    const List list = make_list(frame, lists, tile, range);
    if (!fits(frame, list, tile.part(section), section, background, memory)) return false;
    const int end = memory.first_node[section] + memory.lattices[section].places();
    if (++section == tile.sections) return true;
    if (threadIdx.x == 0) memory.first_node[section] = end;
    __syncthreads();
  }
}

// Draw the tiles whose lattices fit. A block has a tile; its threads have points of the lattice, and then sub-pixels.
// The first blocks have the probed rows. Most blocks of the rows between know at their start whether lattices are worth
// it. A block that cannot know yet tries its own, then waits for the probed rows. The wait ends: blocks start in turn,
// so all blocks of a lower number run. No block waits for one of a higher number.
template <class Out>
__global__ void __launch_bounds__(kThreads, kBlocks)
    composite_lattice_kernel(const __grid_constant__ DirectFrame frame, const float* background, Out* out) {
  __shared__ Memory memory;
  FrameState& state = *frame.state;
  if (!state.lattices) return;
  const Tiling& tiling = frame.tiling();
  const int probes = (tiling.down + kProbeRows - 1) / kProbeRows, i = int(blockIdx.x) / tiling.across;
  const int row = row_index(i, probes);
  if (row >= tiling.down) return;
  const bool probe = i < probes, first = threadIdx.x == 0;
  Tile tile(frame, tiling, row, int(blockIdx.x) - i * tiling.across);
  const Lattice* laid = frame.lattices + int64_t(tile.number) * tile.sections;
  const Lists lists(frame);

  // Read distant memory all at once
  const int planes = laid->planes;
  const uint2 range = section_range(lists, tile, 0);
  const float4 behind = make_float4(background[0], background[1], background[2], 0);
  if (first && !probe) memory.verdict = verdict_on(state, tiling, row);

  // Try the lattices, if there are any and the probed rows do not speak against it
  bool tried = planes >= kPaysNot;
  if (tried || planes == kEmpty) {
    if (planes > 0) memory.take(laid, tile.sections);
    tile.lay_rows(memory);
  }
  if (tried && !probe) tried = memory.verdict != kNotWorth;
  bool good = tried && planes != kPaysNot && draw_tile(frame, lists, tile, range, behind, memory);

  // Wait for the probed rows where they were not done: whether a tile is drawn so must not depend on what came first
  if (tried && !probe && memory.verdict == kUnknown) {
    __syncthreads();  // all have read the verdict
    if (first) {
      Verdict verdict;
      do verdict = verdict_on(state, tiling, row);
      while (verdict == kUnknown);
      memory.verdict = verdict;
    }
    __syncthreads();
    tried = memory.verdict == kWorth, good &= tried;
  }

  // Write the outcome of the tile, then draw it
  if (first) {
    if (!good && planes >= kUntried) refuse(frame, tile.number);
    if (good) atomicAdd(&state.lattice_tiles, 1u);
    if (tried) atomicAdd(&state.tried_tiles, 1u);
    if (probe) ProbedRow::report(state.probed[row / kProbeRows], tried, good);
  }
  if (planes == kEmpty) {
    fill(tile, memory, behind, out);
  } else if (good && tile.by_lens) {
    interpolate_lenses(tile, memory, out);
  } else if (good) {
    interpolate_pixels(tile, memory, out);
  }
}

// The number of tiles of the tiling that has more of them: which one the frame uses is decided on the device.
unsigned most_tiles(const DirectFrame& frame) {
  auto tiles = [](const Tiling& tiling) { return tiling.across * tiling.down; };
  return unsigned(std::max(tiles(frame.pixel), frame.has_lens_column() ? tiles(frame.lens_column) : 0));
}

}  // namespace

void composite_lattice(const DirectFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream) {
  const unsigned tiles = most_tiles(frame);
  plan_lattices_kernel<<<(tiles + kWarps - 1) / kWarps, kThreads, 0, cudaStream_t(stream)>>>(frame);
  check_launch("composite_lattice: plan");
  auto draw = [&](auto* image) {
    composite_lattice_kernel<<<tiles, kThreads, 0, cudaStream_t(stream)>>>(frame, background, image);
    check_launch("composite_lattice");
  };
  out8 ? draw(out8) : draw(out);
}

}  // namespace lfgs::cuda
