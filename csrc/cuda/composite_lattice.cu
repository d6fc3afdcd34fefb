// Composite of a light-field frame where the light field is smooth: twin of cpu/lens_lattice-inl.h on the device.
//
// A tile is one of the kernel that the frame chose, with that kernel's lists. A warp lays a coarse lattice in
// (x, y, view) through every section of it. Where that pays a block draws the nodes, all channels at once, and the
// middles of cells; where these show that it is as good as asked for, it interpolates the tile's sub-pixels. Tiles that
// are refused are left to the kernel chosen. Some rows of tiles go first: where few of theirs fit, the rows between do
// without trying.
#include "cuda/check.h"
#include "cuda/lattice_errors.cuh"
#include "cuda/lattice_interpolate.cuh"
#include "cuda/lattice_rows.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kBlocks = 6;  // on a multiprocessor; loops that are short or rare are not unrolled for its registers
constexpr int kAttempts = 2;
constexpr unsigned kLeastListed = 8;   // a tile of fewer splats is drawn before a lattice is laid
constexpr unsigned kLeastFitting = 3;  // one in so many tiles with splats of a probed row

__device__ void stage(const List& list, unsigned begin, int count, const Lattice& lattice, Staged& staged) {
  const int half_planes = 2 * lattice.planes - 1, shapes = count * half_planes;
  static_assert(kBatch % kWarps == 0);
  int n = threadIdx.x;
  uint32_t id = n < shapes ? list.ids[begin + n / half_planes] : 0;  // asked for early
  // Some splats by every warp, so that none waits for all of them before it goes on
  const int lane = threadIdx.x % 32, mine = int(threadIdx.x) / 32 * (kBatch / kWarps) + lane;
  if (lane < kBatch / kWarps && mine < count) {
    const Splat<float> s = list.splat(begin + mine);
    staged.place[mine] = make_float4(s.u0, s.du, s.v0, s.log2_opacity);
    staged.form[mine] = make_float4(s.tau, s.c0, s.c1, 0);
  }
#pragma unroll 1
  while (n < shapes) {
    const float s = fmaf(0.5f * float(n % half_planes), lattice.step_s, lattice.s0);
    const float4 shape = list.shape(id, s);
    const int next = n + kThreads;
    id = next < shapes ? list.ids[begin + next / half_planes] : 0;
    staged.shapes[n] = shape, n = next;
  }
}

// The colour of every thread's point, 0..1. A splat at which a point ends takes what light is left.
__device__ float3 draw(const List& list, const Lattice& lattice, const Point& point, float stop, float4 background,
                       Staged& staged) {
  const int half_planes = 2 * lattice.planes - 1, batch = min(kBatch, kShapes / half_planes);
  float3 colour = make_float3(0, 0, 0);
  float transmittance = point.node || point.middle ? 1.f : 0.f;
  for (unsigned begin = 0; begin < list.count; begin += batch) {
    if (__syncthreads_and(transmittance == 0)) break;
    const int count = min(unsigned(batch), list.count - begin);
    stage(list, begin, count, lattice, staged);
    __syncthreads();
    if (__all_sync(~0u, transmittance == 0)) continue;
    const float4* shape = staged.shapes + point.half_plane;
#pragma unroll 2
    for (int i = 0; i < count; ++i, shape += half_planes) {
      const float4 place = staged.place[i], form = staged.form[i], here = *shape;
      const float dy = point.y - place.z, A = fmaf(-form.x * dy, dy, place.w);
      const float dx = point.x - place.x - form.y * dy - point.s * fmaf(form.z, dy, place.y);
      const float weight = alpha_of(fmaf(-here.w * dx, dx, A)) * transmittance, after = transmittance - weight;
      const float light = after < stop ? transmittance : weight;
      transmittance = after < stop ? 0.f : after;
      colour.x = fmaf(light, here.x, colour.x), colour.y = fmaf(light, here.y, colour.y);
      colour.z = fmaf(light, here.z, colour.z);
    }
  }
  return make_float3(__saturatef(fmaf(transmittance, background.x, colour.x)),
                     __saturatef(fmaf(transmittance, background.y, colour.y)),
                     __saturatef(fmaf(transmittance, background.z, colour.z)));
}

// Draws a section's nodes and the middles of its cells. The error there, as a share of what is allowed; if it is more
// than that, nodes are moved, and it is what is left, or the largest move.
__device__ float draw_lattice(const LensFrame& frame, const List& list, int section, float4 background,
                              Memory& memory) {
  const Lattice& lattice = memory.lattices[section];
  const float stop = fminf(frame.stop, fmaxf(0.1f * frame.lattice, float(kMinTransmittance)));
  const int nodes = lattice.nodes(), points = lattice.points(), numbers = 3 * (points - nodes);
  ErrorSums sums;
  for (int first = 0; first < points; first += kThreads) {
    const int number = first + int(threadIdx.x);
    const Point point(lattice, number);
    const float3 colour = draw(list, lattice, point, stop, background, memory.staged);
    if (point.node) store_node(lattice, point, colour, place_of(memory, lattice, section, point), memory);
    __syncthreads();
    if (point.middle) {
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
__device__ bool fits(const LensFrame& frame, const List& list, const LatticePart& part, const Lattice& laid,
                     int section, float4 background, Memory& memory) {
  Lattice& lattice = memory.lattices[section];
  LatticePlanner& planner = *reinterpret_cast<LatticePlanner*>(memory.planner);
  constexpr int kWords = sizeof(Lattice) / sizeof(int);
  static_assert(kWords <= kThreads);
  if (threadIdx.x < kWords)
    reinterpret_cast<int*>(&lattice)[threadIdx.x] = reinterpret_cast<const int*>(&laid)[threadIdx.x];
  __syncthreads();
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

// What the probed rows above and below a row say of it: whether in one of them enough tiles have a lattice that fits.
enum Verdict : int { kUnknown, kWorth, kNotWorth };

__device__ Verdict verdict_on(const FrameState& state, const Tiling& tiling, int row) {
  auto probed = [&](Probed what, int probe) {
    return static_cast<const volatile unsigned&>(state.probed[what][probe]);
  };
  const int above = row / kProbeRows, below = min(above + 1, (tiling.down - 1) / kProbeRows);
  bool all = true;
  for (int probe = above; probe <= below; ++probe) {
    if (probed(kDone, probe) < unsigned(tiling.across)) {
      all = false;
      continue;
    }
    __threadfence();  // between this and what was counted before it
    if (kLeastFitting * probed(kFitting, probe) >= probed(kTried, probe)) return kWorth;
  }
  return all ? kNotWorth : kUnknown;
}

// By one thread of every tile of a probed row, at its end.
__device__ void report_probe(FrameState& state, int row, bool tried, bool fits) {
  const int probe = row / kProbeRows;
  if (tried) atomicAdd(&state.probed[kTried][probe], 1u);
  if (fits) atomicAdd(&state.probed[kFitting][probe], 1u);
  __threadfence();
  atomicAdd(&state.probed[kDone][probe], 1u);
}

// By one thread: leaves a tile to the kernel chosen.
__device__ void refuse(const LensFrame& frame, int tile) {
  frame.refused[atomicAdd(&frame.state->refused_tiles, 1u)] = unsigned(tile);
}
__device__ List list_of(const LensFrame& frame, const Lists& lists, const Tile& tile, int section) {
  const uint2 range = lists.range(int64_t(tile.number) * tile.sections + section);
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
  Tile tile(frame, tiling, number);
  const bool seen = tile.find_columns(tile.row(lane));
  const Lists lists(frame);
  const bool listed_apart = seen && lists.ranges != nullptr;  // a list of all splats is for nobody
  unsigned listed = 0;
  for (int section = 0; listed_apart && section < tile.sections; ++section)
    listed += list_of(frame, lists, tile, section).count;
  const bool empty = listed_apart && listed == 0, tried = listed_apart && listed >= kLeastListed;
  Lattice* lattices = frame.lattices + int64_t(number) * tile.sections;
  bool pays = tried;
  for (int section = tile.sections - 1, places = 0; pays && section >= 0; --section) {
    LatticePlanner& planner = planners[warp];
    Lattice& lattice = laid[warp];
    planner.measure(list_of(frame, lists, tile, section), tile.part(section));
    pays = planner.lay(first_fineness(frame.lattice), lattice) && (places += lattice.places()) <= kMostNodes;
    for (int k = lane; pays && k < int(sizeof lattice / sizeof(int)); k += 32)
      reinterpret_cast<int*>(lattices + section)[k] = reinterpret_cast<const int*>(&lattice)[k];
    __syncwarp();
  }
  if (lane == 0 && !pays) lattices->planes = !seen ? kUnseen : empty ? kEmpty : !tried ? kUntried : kPaysNot;
}

// Draws a tile from its lattices; false where one does not fit.
__device__ bool draw_tile(const LensFrame& frame, Tile& tile, const Lattice* laid, float4 background, Memory& memory) {
  tile.lay_rows(memory);
  const Lists lists(frame);
  for (int section = 0, first = 0; section < tile.sections; ++section) {
    if (threadIdx.x == 0) memory.first_node[section] = first;
    const List list = list_of(frame, lists, tile, section);
    if (!fits(frame, list, tile.part(section), laid[section], section, background, memory)) return false;
    first += memory.lattices[section].places();
  }
  return true;
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
  Tile tile(frame, tiling, row * tiling.across + int(blockIdx.x) % tiling.across);
  const Lattice* laid = frame.lattices + int64_t(tile.number) * tile.sections;
  const int planes = laid->planes;
  const float4 behind = make_float4(background[0], background[1], background[2], 0);
  bool tried = planes >= kPaysNot;
  if (tried && !probe) {
    if (first) memory.verdict = verdict_on(state, tiling, row);
    __syncthreads();
    tried = memory.verdict != kNotWorth;
  }
  bool good = tried && planes != kPaysNot && draw_tile(frame, tile, laid, behind, memory);
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
    if (probe) report_probe(state, row, tried, good);
  }
  if (planes == kEmpty) {
    tile.lay_rows(memory);
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
