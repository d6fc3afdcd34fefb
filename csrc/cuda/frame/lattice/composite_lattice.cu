// Composite of a light-field frame where the light field is smooth: twin of cpu/lens/lens_lattice-inl.h on the device.
//
// A tile is one of the kernel that the frame chose, with that kernel's lists. A warp lays a coarse lattice in
// (x, y, view) through every section of it. Where that pays a block draws the nodes, all channels at once, and the
// middles of cells; where these show that it is as good as asked for, it interpolates the tile's sub-pixels. Tiles that
// are refused are left to the kernel chosen. Some rows of tiles go first: where few of theirs fit, the rows between do
// without trying.
#include "cuda/common/check.h"
#include "cuda/frame/lattice/lattice_errors.cuh"
#include "cuda/frame/lattice/lattice_interpolate.cuh"
#include "cuda/frame/lattice/lattice_rows.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kBlocks = 7;  // on a multiprocessor; loops that are short or rare are not unrolled for its registers
constexpr int kAttempts = 2;
constexpr unsigned kLeastListed = 8;   // a tile of fewer splats is drawn before a lattice is laid
constexpr unsigned kLeastFitting = 3;  // one in so many tiles with splats of a probed row

__device__ void stage(const List& list, unsigned begin, int count, const Lattice& lattice, Staged& staged) {
  const int half_planes = 2 * lattice.planes - 1, shapes = count * half_planes;
  static_assert(kBatch <= kThreads);
  int n = threadIdx.x;
  int i = quotient(n, half_planes);
  uint32_t id = n < shapes ? list.ids[begin + i] : 0;  // asked for early
  // By the last threads, which have the fewest shapes
  const int mine = int(threadIdx.x) - (kThreads - kBatch);
  if (mine >= 0 && mine < count) {
    const Splat<float> s = list.splat(begin + mine);
    staged.place[mine] = make_float4(s.u0, s.du, s.v0, s.log2_opacity);
    staged.form[mine] = make_float4(s.tau, s.c0, s.c1, 0);
  }
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

// Adds staged splats `first` to before `end` at a point, whose colour and transmittance so far `seen` is. A splat at
// which a point ends takes what light is left.
__device__ void add_staged(const Staged& staged, int first, int end, int half_planes, const Point& point, float stop,
                           float4& seen) {
  const float4* shape = staged.shapes + first * half_planes + point.half_plane;
#pragma unroll 2
  for (int i = first; i < end; ++i, shape += half_planes) {
    const float4 place = staged.place[i], form = staged.form[i], here = *shape;
    const float dy = point.y - place.z, A = fmaf(-form.x * dy, dy, place.w);
    const float dx = point.x - place.x - form.y * dy - point.s * fmaf(form.z, dy, place.y);
    const float weight = alpha_of(fmaf(-here.w * dx, dx, A)) * seen.w, after = seen.w - weight;
    const float light = after < stop ? seen.w : weight;
    seen.w = after < stop ? 0.f : after;
    seen.x = fmaf(light, here.x, seen.x), seen.y = fmaf(light, here.y, seen.y), seen.z = fmaf(light, here.z, seen.z);
  }
}

// Where threads have shares of their points: which share is this one's, and of which point.
__device__ int own_share(int log2_shares) { return int(threadIdx.x) * (1 << log2_shares) / kThreads; }
__device__ int number_abreast(int log2_shares) { return int(threadIdx.x) & ((kThreads >> log2_shares) - 1); }

// The colour of every thread's point, 0..1. Of threads that have the same point, a power of two, each has a share of
// the staged splats.
__device__ float3 draw(const List& list, const Lattice& lattice, const Point& point, int log2_shares, float stop,
                       float4 background, Memory& memory) {
  const int half_planes = 2 * lattice.planes - 1, batch = min(kBatch, quotient(kShapes, half_planes));
  float4 seen = make_float4(0, 0, 0, point.node || point.middle ? 1.f : 0.f);
  for (unsigned begin = 0; begin < list.count; begin += batch) {
    if (begin > 0 && __syncthreads_and(seen.w < stop)) break;
    const int count = min(unsigned(batch), list.count - begin);
    stage(list, begin, count, lattice, memory.staged);
    __syncthreads();
    if (log2_shares == 0) {
      if (!__all_sync(~0u, seen.w == 0)) add_staged(memory.staged, 0, count, half_planes, point, stop, seen);
      continue;
    }
    float4 share = make_float4(0, 0, 0, 1);
    const int each = (count + (1 << log2_shares) - 1) >> log2_shares, from = own_share(log2_shares) * each;
    add_staged(memory.staged, from, min(from + each, count), half_planes, point, stop, share);
    memory.shares[threadIdx.x] = share;
    __syncthreads();
    for (int n = number_abreast(log2_shares); n < kThreads; n += kThreads >> log2_shares) {
      const float4 next = memory.shares[n];
      seen.x = fmaf(seen.w, next.x, seen.x), seen.y = fmaf(seen.w, next.y, seen.y);
      seen.z = fmaf(seen.w, next.z, seen.z), seen.w *= next.w;
    }
  }
  return make_float3(__saturatef(fmaf(seen.w, background.x, seen.x)), __saturatef(fmaf(seen.w, background.y, seen.y)),
                     __saturatef(fmaf(seen.w, background.z, seen.z)));
}

// Draws a section's nodes and the middles of its cells. The error there, as a share of what is allowed; if it is more
// than that, nodes are moved, and it is what is left, or the largest move.
__device__ float draw_lattice(const LensFrame& frame, const List& list, int section, float4 background,
                              Memory& memory) {
  const Lattice& lattice = memory.lattices[section];
  const float stop = fminf(frame.stop, fmaxf(0.1f * frame.lattice, float(kMinTransmittance)));
  const int nodes = lattice.nodes(), points = lattice.points(), numbers = 3 * (points - nodes);
  const int log2_shares = points <= kThreads / 4 ? 2 : points <= kThreads / 2 ? 1 : 0;
  ErrorSums sums;
  for (int first = 0; first < points; first += kThreads) {
    const int number = first + number_abreast(log2_shares);
    const Point point(lattice, number);
    const float3 colour = draw(list, lattice, point, log2_shares, stop, background, memory);
    const bool keeps = own_share(log2_shares) == 0;
    if (keeps && point.node) store_node(lattice, point, colour, place_of(memory, lattice, section, point), memory);
    __syncthreads();
    if (keeps && point.middle) {
      sums.add(difference(interpolated(lattice, Nodes(memory, section), point), colour));
      memory.middles[number - nodes] = Triple(colour);
    }
  }
  const float error = sums.of_block(memory, numbers, kMeanShare) / frame.lattice;
  if (error <= 1) return error;
  sums = {share_errors(lattice, section, memory), 0};
  __syncthreads();
  for_each_error(lattice, section, memory, [&](int, float3 e) { sums.add(e); });
  return sums.of_block(memory, numbers, kMovedShare) / frame.lattice;
}

// Draws the lattice that was laid through a section, or if need be a finer one. By all threads of the block.
__device__ bool fits(const LensFrame& frame, const List& list, const LatticePart& part, int section, float4 background,
                     Memory& memory) {
  Lattice& lattice = memory.lattices[section];
  LatticePlanner& planner = *reinterpret_cast<LatticePlanner*>(memory.planner);
  float fineness = first_fineness(frame.lattice);
  for (int attempt = 1;; ++attempt) {
    if (memory.first_node[section] + lattice.places() > kMostNodes) return false;
    const float error = draw_lattice(frame, list, section, background, memory);
    if (error <= 1 || attempt == kAttempts) return error <= 1;
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

// Some rows of tiles go first, to learn where lattices are worth trying: the i-th row that is drawn.
__device__ int row_of(int i, int probes) {
  const int between = i - probes;
  return i < probes ? i * kProbeRows : between / (kProbeRows - 1) * kProbeRows + between % (kProbeRows - 1) + 1;
}

// Tiles of a probed row that are done, that have splats, and whose lattice fits: in one word, for so they are of one
// moment.
class ProbedRow {
 public:
  __device__ explicit ProbedRow(const unsigned long long& counts)
      : counts_(static_cast<const volatile unsigned long long&>(counts)) {}
  // By one thread of every tile, at its end.
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

// What the probed rows above and below a row say of it: whether in one of them enough tiles have a lattice that fits.
enum Verdict : int { kUnknown, kWorth, kNotWorth };

__device__ Verdict verdict_on(const FrameState& state, const Tiling& tiling, int row) {
  const int probe = row / kProbeRows, last = (tiling.down - 1) / kProbeRows;
  const ProbedRow above(state.probed[probe]), below(state.probed[min(probe + 1, last)]);
  const bool above_done = above.done(tiling.across), below_done = below.done(tiling.across);
  if ((above_done && above.worth()) || (below_done && below.worth())) return kWorth;
  return above_done && below_done ? kNotWorth : kUnknown;
}

// By one thread: leaves a tile to the kernel chosen.
__device__ void refuse(const LensFrame& frame, int tile) {
  frame.refused[atomicAdd(&frame.state->refused_tiles, 1u)] = unsigned(tile);
}
__device__ uint2 range_of(const Lists& lists, const Tile& tile, int section) {
  return lists.range(int64_t(tile.number) * tile.sections + section);
}
__device__ List list_of(const LensFrame& frame, const Lists& lists, const Tile& tile, uint2 range) {
  return {frame.splats, lists.ids + range.x, range.y - range.x, tile.origin()};
}

// What becomes of a tile whose first section has no lattice, in the place of its planes: nothing of it is on the panel;
// nothing is in it; it is left to the kernel chosen, untried; none pays there.
enum Unlaid : int { kUnseen = -3, kEmpty = -2, kUntried = -1, kPaysNot = 0 };

// Lays lattices through the sections of tiles, of which a warp has one.
__global__ void __launch_bounds__(kThreads) plan_lattices_kernel(const __grid_constant__ LensFrame frame) {
  __shared__ LatticePlanner planners[kWarps];
  __shared__ Lattice laid[kWarps];
  if (!frame.state->lattices) return;
  const Tiling& tiling = frame.tiling();
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32, number = int(blockIdx.x) * kWarps + warp;
  if (number >= tiling.across * tiling.down) return;
  Tile tile(frame, tiling, number / tiling.across, number % tiling.across);
  const bool seen = tile.find_columns(tile.row(lane));
  const Lists lists(frame);
  const bool listed_apart = seen && lists.ranges != nullptr;  // a list of all splats is for nobody
  unsigned listed = 0;
  for (int section = 0; listed_apart && section < tile.sections; ++section)
    listed += list_of(frame, lists, tile, range_of(lists, tile, section)).count;
  const bool empty = listed_apart && listed == 0, tried = listed_apart && listed >= kLeastListed;
  Lattice* lattices = frame.lattices + int64_t(number) * tile.sections;
  bool pays = tried;
  for (int section = tile.sections - 1, places = 0; pays && section >= 0; --section) {
    LatticePlanner& planner = planners[warp];
    Lattice& lattice = laid[warp];
    planner.measure(list_of(frame, lists, tile, range_of(lists, tile, section)), tile.part(section));
    pays = planner.lay(first_fineness(frame.lattice), lattice) && (places += lattice.places()) <= kMostNodes;
    for (int k = lane; pays && k < int(sizeof lattice / sizeof(int)); k += 32)
      reinterpret_cast<int*>(lattices + section)[k] = reinterpret_cast<const int*>(&lattice)[k];
    __syncwarp();
  }
  if (lane == 0 && !pays) lattices->planes = !seen ? kUnseen : empty ? kEmpty : !tried ? kUntried : kPaysNot;
}

// Draws the nodes of a tile's lattices; false where one does not fit. range: that of the first section's list.
__device__ bool draw_tile(const LensFrame& frame, const Lists& lists, const Tile& tile, uint2 range, float4 background,
                          Memory& memory) {
  for (int section = 0;; range = range_of(lists, tile, section)) {
    const List list = list_of(frame, lists, tile, range);
    if (!fits(frame, list, tile.part(section), section, background, memory)) return false;
    const int end = memory.first_node[section] + memory.lattices[section].places();
    if (++section == tile.sections) return true;
    if (threadIdx.x == 0) memory.first_node[section] = end;
    __syncthreads();
  }
}

// Blocks of probed rows are the first. Those between know by then whether lattices are worth it; who does not, tries,
// and asks again. Nobody waits for a block of a higher number, and lower ones are running: blocks are started in turn.
template <class Out>
__global__ void __launch_bounds__(kThreads, kBlocks)
    composite_lattice_kernel(const __grid_constant__ LensFrame frame, const float* background, Out* out) {
  __shared__ Memory memory;
  FrameState& state = *frame.state;
  if (!state.lattices) return;
  const Tiling& tiling = frame.tiling();
  const int probes = (tiling.down + kProbeRows - 1) / kProbeRows, i = int(blockIdx.x) / tiling.across;
  const int row = row_of(i, probes);
  if (row >= tiling.down) return;
  const bool probe = i < probes, first = threadIdx.x == 0;
  Tile tile(frame, tiling, row, int(blockIdx.x) - i * tiling.across);
  const Lattice* laid = frame.lattices + int64_t(tile.number) * tile.sections;
  const Lists lists(frame);
  // What is read from afar is asked for at once
  const int planes = laid->planes;
  const uint2 range = range_of(lists, tile, 0);
  const float4 behind = make_float4(background[0], background[1], background[2], 0);
  if (first && !probe) memory.verdict = verdict_on(state, tiling, row);
  bool tried = planes >= kPaysNot;
  if (tried || planes == kEmpty) {
    if (planes > 0) memory.take(laid, tile.sections);
    tile.lay_rows(memory);
  }
  if (tried && !probe) tried = memory.verdict != kNotWorth;
  bool good = tried && planes != kPaysNot && draw_tile(frame, lists, tile, range, behind, memory);
  if (tried && !probe && memory.verdict == kUnknown) {
    __syncthreads();  // all have read it
    if (first) {
      Verdict verdict;
      do verdict = verdict_on(state, tiling, row);
      while (verdict == kUnknown);
      memory.verdict = verdict;
    }
    __syncthreads();
    tried = memory.verdict == kWorth, good &= tried;
  }
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

// Of the tiling that has more of them.
unsigned most_tiles(const LensFrame& frame) {
  auto tiles = [](const Tiling& tiling) { return tiling.across * tiling.down; };
  return unsigned(std::max(tiles(frame.pixel), frame.has_ordinal ? tiles(frame.ordinal) : 0));
}

}  // namespace

void composite_lattice(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream) {
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
