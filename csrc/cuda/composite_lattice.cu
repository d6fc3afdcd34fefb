// Composite of a light-field frame where the light field is smooth: twin of cpu/lens_lattice-inl.h on the device.
//
// A block takes a tile of the kernel that the frame chose, with that kernel's lists. It lays a coarse lattice in
// (x, y, view) through every section of the tile, draws its nodes, all channels at once, and the middles of its cells;
// where they show that it is as good as asked for, it interpolates the tile's sub-pixels. Tiles that are refused are
// left to the kernel chosen. Some rows of tiles go first: where few of theirs fit, the rows between do without trying.
#include <new>

#include "cuda/check.h"
#include "cuda/lattice_tile.cuh"
#include "cuda/lens_plan.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kBlocks = 5;      // on a multiprocessor; loops that are short or rare are not unrolled for its registers
constexpr int kAttempts = 2;
constexpr float kReach = 2.3f;  // of splats, in units of a plan's
constexpr int kMeasured = 256;  // splats of a list, about; enough for averages
constexpr unsigned kLeastFitting = 3;  // one in so many tiles with splats of a probed row

// A node of a section's lattice, or the middle of a cell.
struct Point {
  bool node, middle;
  int i, j, k, half_plane;
  float x, y, s;

  __device__ Point(const LatticePlan& plan, int number) {
    const int nodes = plan.nodes(), cells = plan.across - 1 - 2 * plan.margin, rows = plan.down - 1;
    node = number < nodes, middle = !node && number < nodes + cells * rows * (plan.planes - 1);
    const int n = node ? number : number - nodes, across = node ? plan.across : cells, down = node ? plan.down : rows;
    i = n % across, j = n / across % down, k = n / (across * down);
    half_plane = node || middle ? 2 * k + !node : 0;
    const float half = node ? 0.f : 0.5f;
    if (!node) i += plan.margin;
    x = fmaf(float(i) + half, plan.step_x, plan.x0), y = fmaf(float(j) + half, plan.step_y, plan.y0);
    s = fmaf(float(k) + half, plan.step_s, plan.s0);
  }
};

// The list of a section.
struct List {
  const Splats<float>& splats;
  const uint32_t* ids;
  unsigned count;
  float2 origin;

  __device__ Splat<float> splat(unsigned i) const { return splat_about(splats, ids[i], origin); }
  // At the offset s, no channel below zero; w: 1 / S.
  __device__ float4 shape(unsigned i, float s) const {
    const uint32_t id = ids[i];
    const float4 S = reinterpret_cast<const float4*>(splats.splats + id)[1];
    const float4* powers = reinterpret_cast<const float4*>(splats.colours) + int64_t(id) * (splats.colour_order + 1);
    const int order = splats.orders ? splats.orders[id] : 0;
    float4 c = powers[order];
    for (int p = order - 1; p >= 0; --p) {
      const float4 power = powers[p];
      c.x = fmaf(c.x, s, power.x), c.y = fmaf(c.y, s, power.y), c.z = fmaf(c.z, s, power.z);
    }
    return make_float4(fmaxf(c.x, 0.f), fmaxf(c.y, 0.f), fmaxf(c.z, 0.f), 1 / fmaf(s, fmaf(s, S.z, S.y), S.x));
  }
};

// Measures how fast the light field of a part varies, by some of its splats. A thread takes every eighth for one bin.
__device__ void measure(const List& list, const LatticePart& part, Memory& memory) {
  constexpr int kShare = kThreads / LatticeCurvature::kBins;
  LatticeCurvature& curvature = *reinterpret_cast<LatticeCurvature*>(memory.curvature);
  if (threadIdx.x == 0) new (&curvature) LatticeCurvature(part);
  __syncthreads();
  const int bin = threadIdx.x / kShare;
  const unsigned stride = list.count / kMeasured + 1, measured = list.count / stride;
  LatticeCurvature::Sums sums;
#pragma unroll 1
  for (unsigned begin = 0; begin < measured; begin += kThreads) {
    const unsigned i = begin + threadIdx.x, count = min(unsigned(kThreads), measured - begin);
    if (i < measured) {
      const Splat<float> splat = list.splat(i * stride);
      memory.terms[threadIdx.x] = curvature.term(splat, splat.u0);
    }
    __syncthreads();
#pragma unroll 1
    for (unsigned t = threadIdx.x % kShare; t < count; t += kShare) {
      const LatticeCurvature::Term& term = memory.terms[t];
      if (term.first <= bin && bin <= term.last) sums.add(term);
    }
    __syncthreads();
  }
  for (int step = kShare / 2; step > 0; step /= 2)
    for (float* sum : {&sums.weight, &sums.x, &sums.y, &sums.x_du, &sums.x_du2})
      *sum += __shfl_xor_sync(~0u, *sum, step);
  if (threadIdx.x % kShare == 0) curvature.set(bin, sums);
}

__device__ void stage(const List& list, unsigned begin, int count, const LatticePlan& plan, Staged& staged) {
  const int half_planes = 2 * plan.planes - 1;
#pragma unroll 1
  for (int i = threadIdx.x; i < count; i += kThreads) {
    const Splat<float> s = list.splat(begin + i);
    staged.place[i] = make_float4(s.u0, s.du, s.v0, s.log2_opacity);
    staged.form[i] = make_float4(s.tau, s.c0, s.c1, 0);
  }
#pragma unroll 1
  for (int n = threadIdx.x; n < count * half_planes; n += kThreads)
    staged.shapes[n] = list.shape(begin + n / half_planes, fmaf(0.5f * float(n % half_planes), plan.step_s, plan.s0));
}

// The colour of every thread's point, 0..1. A splat at which a point ends takes what light is left.
__device__ float3 draw(const List& list, const LatticePlan& plan, const Point& point, float stop, float4 background,
                       Staged& staged) {
  const int half_planes = 2 * plan.planes - 1, batch = min(kBatch, kShapes / half_planes);
  float3 colour = make_float3(0, 0, 0);
  float transmittance = point.node || point.middle ? 1.f : 0.f;
  for (unsigned begin = 0; begin < list.count; begin += batch) {
    if (__syncthreads_and(transmittance == 0)) break;
    const int count = min(unsigned(batch), list.count - begin);
    stage(list, begin, count, plan, staged);
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

// first: where the nodes of its plane begin.
__device__ void store_node(const LatticePlan& plan, const Point& point, float3 colour, int first, Memory& memory) {
  const int at = first + point.j * plan.across + point.i;
  const float values[3] = {colour.x, colour.y, colour.z};
#pragma unroll
  for (int c = 0; c < 3; ++c) {
    const __half value = __float2half_rn(values[c]);
    Corners* corners = memory.corners[c] + at;
    corners[0].low.x = value;
    if (point.i > 0) corners[-1].low.y = value;
    if (point.j > 0) corners[-plan.across].high.x = value;
    if (point.i > 0 && point.j > 0) corners[-plan.across - 1].high.y = value;
  }
}

// A tile of fewer splats is drawn before a lattice is laid.
constexpr unsigned kLeastListed = 8;

// Draws a section's nodes and the middles of its cells. The error there, as a share of what is allowed.
__device__ float draw_lattice(const LensFrame& frame, const List& list, int section, int points, float4 background,
                              Memory& memory) {
  const LatticePlan& plan = memory.plans[section];
  const float stop = fminf(frame.stop, fmaxf(0.1f * frame.lattice, float(kMinTransmittance)));
  float largest = 0, squares = 0;
  for (int first = 0; first < points; first += kThreads) {
    const Point point(plan, first + int(threadIdx.x));
    const float3 is = draw(list, plan, point, stop, background, memory.staged);
    if (point.node)
      store_node(plan, point, is, memory.first_node[section] + memory.planes[section][point.k].first, memory);
    __syncthreads();
    if (!point.middle) continue;
    const Nodes nodes(memory, section);
    for (int c = 0; c < 3; ++c) {
      const float made = nodes.at(nodes.row_of(c, point.j), __float2half2_rn(0.5f), float(point.i) + 0.5f,
                                  Seen(memory.planes[section][point.k], 0.5f));
      const float error = made - (c == 0 ? is.x : c == 1 ? is.y : is.z);
      largest = fmaxf(largest, fabsf(error)), squares = fmaf(error, error, squares);
    }
  }
  largest = warp_max(largest), squares = warp_sum(squares);
  if (threadIdx.x % 32 == 0) memory.errors[threadIdx.x / 32] = largest, memory.squares[threadIdx.x / 32] = squares;
  __syncthreads();
  largest = squares = 0;
  for (int w = 0; w < kWarps; ++w) largest = fmaxf(largest, memory.errors[w]), squares += memory.squares[w];
  const float mean = sqrtf(squares / float(3 * (points - plan.nodes())));
  return fmaxf(largest, kMeanShare * mean) / frame.lattice;
}

// LatticeCurvature::plan by a warp: a lane has a bin, then a plane.
__device__ void lay_by_warp(const LatticeCurvature& curvature, float fineness, LatticePlan& plan) {
  const int lane = threadIdx.x;
  LatticeCurvature::Totals totals;
  if (lane < LatticeCurvature::kBins) totals.add(curvature.bin(lane));
  for (float* total : {&totals.weight, &totals.x, &totals.y, &totals.spread}) *total = warp_sum(*total);
  if (lane == 0) curvature.lay(totals, fineness, kPlanes + 1, plan);
  __syncwarp();
  const float lean = curvature.lean_of(lane, plan);
  const float margin = warp_max(fabsf(lean));
  if (lane < plan.planes) plan.lean[lane] = lean;
  if (lane == 0) curvature.widen(margin, plan);
}

// Where the planes of a lattice are stored: what is seen at a node is plane_stride places further on the next plane.
__device__ void place_planes(const LatticePlan& plan, Plane* planes) {
  if (int(threadIdx.x) >= plan.planes) return;
  int first = 0;
  for (int k = 0; k < int(threadIdx.x); ++k) first += Nodes::stride_of(plan) - int(plan.lean[k]);
  planes[threadIdx.x] = {plan.lean[threadIdx.x], first};
}
// How many places that takes, at most.
__device__ int stored_nodes(const LatticePlan& plan) {
  return plan.nodes() + 2 * plan.margin * (plan.planes - 1);
}

// Lays a lattice through a section and judges it, by all threads of the block.
__device__ bool fits(const LensFrame& frame, const List& list, const LatticePart& part, int section, float4 background,
                     Memory& memory) {
  measure(list, part, memory);
  float fineness = first_fineness(frame.lattice);
  for (int attempt = 0; attempt < kAttempts; ++attempt) {
    __syncthreads();
    LatticePlan& plan = memory.plans[section];
    if (threadIdx.x < 32) lay_by_warp(*reinterpret_cast<const LatticeCurvature*>(memory.curvature), fineness, plan);
    __syncthreads();
    if (plan.planes > kPlanes || plan.across > kMostNodes || plan.down > kMostNodes) return false;
    const int nodes = plan.nodes();
    const int points = nodes + (plan.across - 1 - 2 * plan.margin) * (plan.down - 1) * (plan.planes - 1);
    const float reach = 2 * kReach / fineness;
    if (float(points) > points_worth(reach * plan.step_x, reach * plan.step_y)) return false;
    if (memory.first_node[section] + stored_nodes(plan) > kMostNodes) return false;
    place_planes(plan, memory.planes[section]);
    __syncthreads();
    const float error = draw_lattice(frame, list, section, points, background, memory);
    if (error <= 1) return true;
    fineness *= fmaxf(kBackOff * rsqrtf(error), 0.4f);
  }
  return false;
}

// A colour in 0..1 -> stored(), without a conversion.
__device__ inline uint8_t byte_of(float c) { return uint8_t(__float_as_uint(fmaf(c, 255.f, Place::kMagic))); }

// Interpolates a run of sub-pixels of row r, the first with this phase: put(m, colour).
template <bool Table, class Put>
__device__ void interpolate_run(const Tile& tile, const Nodes& nodes, const Views& views, unsigned phase, int r,
                                int2 ends, const Put& put) {
  __half2 part;
  const int row = nodes.row(float(r) + 0.5f, part), pixel = ends.x / 3, place = ends.x - 3 * pixel;
  const float x_first = (float(pixel) + 0.5f - tile.origin.x - nodes.x0) * nodes.per_x;
  unsigned channels[3];
  float x[3];
#pragma unroll
  for (int i = 0; i < 3; ++i) {  // in the order in which the sub-pixels follow
    const bool next = place + i >= 3;
    const int at = place + i - 3 * next;
    channels[i] = nodes.row_of(tile.lens.bgr ? 2 - at : at, row), x[i] = next ? x_first + nodes.per_x : x_first;
  }
#pragma unroll 1
  for (int m = ends.x; m < ends.y; m += 3) {
    float colours[3];
#pragma unroll
    for (int i = 0; i < 3; ++i) {  // all of them, to have several reads under way
      colours[i] = nodes.at(channels[i], part, nodes.within(x[i]), views.at<Table>(phase));
      phase += views.step, x[i] += nodes.per_x;
    }
#pragma unroll
    for (int i = 0; i < 3; ++i)
      if (m + i < ends.y) put(m + i, colours[i]);
  }
}

// The same for all runs of the rows from `top` to before `end` that a section serves: put(r, at, colour), with the
// place in the row.
template <bool Table, class Put>
__device__ void interpolate_section(const Tile& tile, const Memory& memory, const Views& views, int section, int top,
                                    int end, const Put& put) {
  const Nodes nodes(memory, section);
  const int runs = tile.runs(), rows_on = kThreads / runs, runs_on = kThreads % runs;
  int r = top + int(threadIdx.x) / runs, n = int(threadIdx.x) % runs;
  while (r < end) {
    const int2 row = memory.rows[r];
    const unsigned phase = unsigned(phase_at(tile.lens, tile.top + r, row.x) >> 32);
    const int2 ends = tile.run(row, r, section, n, phase);
    interpolate_run<Table>(tile, nodes, views, phase + views.step * unsigned(ends.x - row.x), r, ends,
                           [&](int m, float colour) { put(r, m - row.x, colour); });
    r += rows_on, n += runs_on;
    if (n >= runs) n -= runs, ++r;
  }
}

// Stores the bytes of rows of a tile: [rows, row_bytes], from the first sub-pixel of each on.
__device__ void store_rows(const Tile& tile, const Memory& memory, int top, int end, int row_bytes, uint8_t* out) {
  const int width = 3 * tile.lens.width_px, warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  constexpr int kWord = sizeof(uint4), kWords = 3 * kPixelTileWidth / kWord;
  const bool words = width % kWord == 0 && reinterpret_cast<uintptr_t>(out) % kWord == 0;
  if (words && !tile.by_lens && !tile.lens.bgr) {
    const int first = memory.rows[0].x;
    for (int n = threadIdx.x; n < (end - top) * kWords; n += kThreads) {
      const int m = first + n % kWords * kWord;
      if (m < width)
        *reinterpret_cast<uint4*>(out + int64_t(tile.top + top + n / kWords) * width + m) =
            reinterpret_cast<const uint4*>(memory.bytes)[n];
    }
    return;
  }
  for (int r = top + warp; r < end; r += kWarps) {
    const int first = memory.rows[r].x, last = min(memory.rows[r].y, width);
    const uint8_t* from = memory.bytes + (r - top) * row_bytes;
    uint8_t* line = out + int64_t(tile.top + r) * width;
    for (int m = first + lane; m < last; m += 32)
      if (m >= 0) line[in_image(tile.lens, m)] = from[m - first];
  }
}

// Interpolates the sub-pixels of a tile.
template <class Out>
__device__ void interpolate(const Tile& tile, Memory& memory, Out* out) {
  const int row_bytes = tile.row_bytes(), fitting = min(int(sizeof memory.bytes) / row_bytes, tile.rows);
  for (int top = 0; top < tile.rows; top += fitting) {
    const int end = min(top + fitting, tile.rows);
    for (int section = 0; section < tile.sections; ++section) {
      __syncthreads();
      Views views(tile.lens, memory, section);
      views.tabulate(memory);
      auto put = [&](int r, int at, float colour) {
        if constexpr (sizeof(Out) == 1)
          memory.bytes[(r - top) * row_bytes + at] = byte_of(colour);
        else
          out[int64_t(tile.top + r) * 3 * tile.lens.width_px + in_image(tile.lens, memory.rows[r].x + at)] =
              __saturatef(colour);
      };
      if (views.table)
        interpolate_section<true>(tile, memory, views, section, top, end, put);
      else
        interpolate_section<false>(tile, memory, views, section, top, end, put);
    }
    __syncthreads();
    if constexpr (sizeof(Out) == 1) store_rows(tile, memory, top, end, row_bytes, out);
  }
}

// The rows of tiles that are drawn first, to learn where lattices are worth trying; and those between.
enum class Rows { kProbe, kBetween };

template <Rows rows>
__device__ int row_of(int i) {
  return rows == Rows::kProbe ? i * kProbeRows : i / (kProbeRows - 1) * kProbeRows + i % (kProbeRows - 1) + 1;
}

// Whether enough tiles of a row that was probed, above or below this one, have a lattice that fits.
__device__ bool worth_trying(const FrameState& state, const Tiling& tiling, int row) {
  const int above = row / kProbeRows, below = min(above + 1, (tiling.down - 1) / kProbeRows);
  auto fits = [&](int probe) { return kLeastFitting * state.probed[1][probe] >= state.probed[0][probe]; };
  return fits(above) || fits(below);
}

// By one thread: what became of a tile.
__device__ void note(const LensFrame& frame, int tile, bool good) {
  FrameState& state = *frame.state;
  if (good)
    atomicAdd(&state.lattice_tiles, 1u);
  else
    frame.refused[atomicAdd(&state.refused_tiles, 1u)] = unsigned(tile);
}

template <Rows rows, class Out>
__global__ void __launch_bounds__(kThreads, kBlocks)
    composite_lattice_kernel(const __grid_constant__ LensFrame frame, const float* background, Out* out) {
  __shared__ Memory memory;
  FrameState& state = *frame.state;
  if (!state.lattices) return;
  const bool by_lens = state.kernel == int(LensKernel::kOrdinal);
  const Tiling& tiling = by_lens ? frame.ordinal : frame.pixel;
  const int row = row_of<rows>(int(blockIdx.x) / tiling.across);
  if (row >= tiling.down) return;
  Tile tile(frame, tiling, by_lens, row * tiling.across + int(blockIdx.x) % tiling.across);
  if (!tile.lay_rows(tiling, memory)) return;
  const Lists lists(frame);
  const float4 behind = make_float4(background[0], background[1], background[2], 0);

  bool tried = lists.ranges != nullptr;  // a list of all splats is for nobody
  unsigned listed = 0;
  for (int section = 0; tried && section < tile.sections; ++section) {
    const uint2 range = lists.range(int64_t(tile.number) * tile.sections + section);
    listed += range.y - range.x;
  }
  tried = tried && listed >= kLeastListed && (rows == Rows::kProbe || worth_trying(state, tiling, row));
  bool good = tried;
  for (int section = 0, first = 0; good && section < tile.sections; ++section) {
    const uint2 range = lists.range(int64_t(tile.number) * tile.sections + section);
    if (threadIdx.x == 0) memory.first_node[section] = first;
    good = fits(frame, {frame.splats, lists.ids + range.x, range.y - range.x, tile.origin},
                tile.part(section, memory), section, behind, memory);
    first += good ? stored_nodes(memory.plans[section]) : 0;
  }
  if (threadIdx.x == 0) {
    note(frame, tile.number, good);
    if (tried) atomicAdd(&state.tried_tiles, 1u);
    if (rows == Rows::kProbe && tried) atomicAdd(&state.probed[0][row / kProbeRows], 1u);
    if (rows == Rows::kProbe && tried && good) atomicAdd(&state.probed[1][row / kProbeRows], 1u);
  }
  if (!good) return;
  __syncthreads();
  interpolate(tile, memory, out);
}

template <Rows rows, class Out>
void launch(const LensFrame& frame, const float* background, Out* out, Stream stream) {
  auto tiles = [](const Tiling& tiling) {
    const int probes = (tiling.down + kProbeRows - 1) / kProbeRows;
    return tiling.across * (rows == Rows::kProbe ? probes : tiling.down - probes);
  };
  const int most = std::max(tiles(frame.pixel), frame.has_ordinal ? tiles(frame.ordinal) : 0);
  if (most == 0) return;
  composite_lattice_kernel<rows><<<unsigned(most), kThreads, 0, cudaStream_t(stream)>>>(frame, background, out);
  check_launch("composite_lattice");
}

}  // namespace

void composite_lattice(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream) {
  auto draw = [&](auto* image) {
    launch<Rows::kProbe>(frame, background, image, stream);
    launch<Rows::kBetween>(frame, background, image, stream);
  };
  out8 ? draw(out8) : draw(out);
}

}  // namespace lfgs::cuda
