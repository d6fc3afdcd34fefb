// Stage composite for ordinary images, and its reverse. A work item is one band of one image; a band is cut into tiles,
// a tile into patches of one vector each (4 columns, as many rows as fit); splats come nearest first.
#include <algorithm>
#include <vector>

#include "base/parallel.h"
#include "cpu/tile_lists.h"
#include "pipeline/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/composite_dense.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/aligned_allocator.h"
#include "hwy/highway.h"
#include "math/blend-inl.h"

#ifndef LFGS_COMPOSITE_DENSE_ONCE
#define LFGS_COMPOSITE_DENSE_ONCE
namespace lfgs {
// Inputs of both directions; the reverse also reads what the forward wrote.
template <class T>
struct DenseJob {
  Splats<T> splats;
  Bins bins;
  int64_t width_px, height_px;
  const T* background;  // [I, 3]
  DenseImages<T> out;
  DenseImages<const T> images, gradients;
  const int64_t* first_pair;
  T *pair_gradients, *band_background;
  bool backward;  // pair_gradients may be null in both directions: nothing may be drawn
  int threads;
};
}  // namespace lfgs
#endif

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// One tile of 16 x 16 pixels: sample positions and what is accumulated, a vector per patch.
template <class T>
struct DenseTile {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  static constexpr int kLanes = int(hn::MaxLanes(D()));
  static constexpr int kColumns = kLanes < 4 ? kLanes : 4, kRows = kLanes / kColumns;
  static constexpr int kSide = kBandRows, kAcross = kSide / kColumns, kDown = kSide / kRows;
  static constexpr int kSamples = kSide * kSide;

  alignas(64) T x[kSide], y[kSamples];              // pixel centres in the tile: lane columns, lane rows
  alignas(64) T value[5][kSamples];                 // r, g, b, depth, transmittance
  alignas(64) T gradient[5][kSamples], total[kSamples], prefix[kSamples], rest[kSamples];

  DenseTile() {
    for (int v = 0; v < kSamples; ++v) {
      const int patch = v / kLanes, lane = v % kLanes;
      y[v] = T(patch / kAcross * kRows + lane / kColumns) + T(0.5);
    }
  }
  // Lane centres of a patch.
  V xs(D d, int across) const {
    alignas(64) T lanes[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = T(across * kColumns + lane % kColumns) + T(0.5);
    return hn::Load(d, lanes);
  }
  static int64_t pixel(int sample, int64_t x0, int64_t y0, int64_t width) {
    const int patch = sample / kLanes, lane = sample % kLanes;
    const int64_t row = y0 + patch / kAcross * kRows + lane / kColumns;
    return row * width + x0 + patch % kAcross * kColumns + lane % kColumns;
  }
  static bool inside(int sample, int64_t x0, int64_t y0, int64_t width, int64_t height) {
    const int patch = sample / kLanes, lane = sample % kLanes;
    return y0 + patch / kAcross * kRows + lane / kColumns < height &&
           x0 + patch % kAcross * kColumns + lane % kColumns < width;
  }
};

// Walks one band: calls tile_begin(x0, y0), splat(s, colour, first patch row/col ranges), tile_end().
template <class T>
class DenseBand {
 public:
  using Tile = DenseTile<T>;
  using D = typename Tile::D;
  using V = typename Tile::V;

  DenseBand(const DenseJob<T>& job, int64_t item) : job_(job) {
    const int64_t bands = band_count(job.height_px);
    image = item / bands, y0 = item % bands * kBandRows;
    splats_ = job.splats.splats + image * job.splats.count;
    ids_ = job.bins.band_splats + job.bins.band_offsets[item];
    count_ = job.bins.band_offsets[item + 1] - job.bins.band_offsets[item];
  }

  int64_t image, y0, x0 = 0;

  int64_t tiles() const { return (job_.width_px + Tile::kSide - 1) / Tile::kSide; }

  void build(TileLists& lists) const {
    const T low = T(y0) + T(0.5), high = T(std::min(y0 + kBandRows, job_.height_px)) - T(0.5);
    lists.build(ids_, count_, tiles(), [&](int32_t id) -> Range {
      T a, b;
      if (!columns_of(splats_[id], low, high, T(0), a, b)) return {0, -1};
      const Range pixels = pixels_within(a, b, job_.width_px);
      if (pixels.last < pixels.first) return {0, -1};
      return {pixels.first / Tile::kSide, pixels.last / Tile::kSide};
    });
  }

  // Patches that a splat may touch, and its constants there: visit(patch, across, A, dy, M0).
  template <class Visit>
  HWY_INLINE void for_each_patch(const Tile& tile, const Splat<T>& s, const Visit& visit) const {
    const D d;
    const T u = s.u0 - T(x0), v = s.v0 - T(y0);
    const Range rows = pixels_within(v - s.reach_y, v + s.reach_y, Tile::kSide);
    const V tau = hn::Set(d, s.tau), log2_opacity = hn::Set(d, s.log2_opacity);
    for (int64_t down = rows.first / Tile::kRows; down <= rows.last / Tile::kRows && rows.last >= 0; ++down) {
      // Columns of this patch row
      const T top = T(down * Tile::kRows) + T(0.5), bottom = top + T(Tile::kRows - 1);
      Splat<T> local = s;
      local.u0 = u, local.v0 = v;
      T a, b;
      if (!columns_of(local, top, bottom, T(0), a, b)) continue;
      const Range columns = pixels_within(a, b, Tile::kSide);
      if (columns.last < columns.first) continue;

      const V dy = hn::Sub(hn::Load(d, tile.y + down * Tile::kAcross * Tile::kLanes), hn::Set(d, v));
      const V A = hn::NegMulAdd(hn::Mul(tau, dy), dy, log2_opacity);
      const V M0 = hn::MulAdd(hn::Set(d, s.c0), dy, hn::Set(d, u));
      for (int64_t across = columns.first / Tile::kColumns; across <= columns.last / Tile::kColumns; ++across)
        visit(int(down * Tile::kAcross + across), int(across), A, dy, M0);
    }
  }

  const Splat<T>& splat(int32_t id) const { return splats_[id]; }
  const T* colour(int32_t id) const { return job_.splats.colours + (image * job_.splats.count + id) * kColourStride; }

 private:
  const DenseJob<T>& job_;
  const Splat<T>* splats_;
  const int32_t* ids_;
  int64_t count_;
};

template <class T>
void ForwardTile(const DenseJob<T>& job, const DenseBand<T>& band, DenseTile<T>& tile, const int32_t* begin,
                 const int32_t* end, Counters& counters) {
  using Tile = DenseTile<T>;
  using V = typename Tile::V;
  const Tag<T> d;
  for (int k = 0; k < 4; ++k) std::fill(tile.value[k], tile.value[k] + Tile::kSamples, T(0));
  std::fill(tile.value[4], tile.value[4] + Tile::kSamples, T(1));
  const T* background = job.background + 3 * band.image;
  V x[Tile::kAcross];
  for (int across = 0; across < Tile::kAcross; ++across) x[across] = tile.xs(d, across);
  uint64_t alive[4] = {~0ull, ~0ull, ~0ull, ~0ull};  // bit per patch: some sample still takes light
  int open = Tile::kDown * Tile::kAcross;

  for (const int32_t* id = begin; id != end && open > 0; ++id) {
    const Splat<T>& s = band.splat(*id);
    const T* c = band.colour(*id);
    const V channel[4] = {hn::Set(d, c[0]), hn::Set(d, c[1]), hn::Set(d, c[2]), hn::Set(d, s.depth)};
    const V inverse_S = hn::Set(d, T(1) / s.S0);
    band.for_each_patch(tile, s, [&](int patch, int across, V A, V, V M0) HWY_ATTR {
      if (!(alive[patch / 64] >> (patch % 64) & 1)) return;
      counters.evaluations += Tile::kLanes;
      const V dx = hn::Sub(x[across], M0);
      const V alpha = Alpha(d, hn::NegMulAdd(hn::Mul(dx, dx), inverse_S, A));
      const int first = patch * Tile::kLanes;
      const V before = hn::Load(d, tile.value[4] + first);
      V weight = hn::Mul(alpha, before), after = hn::Sub(before, weight);

      // A sample whose transmittance would fall too low ends here: what it still lets through is kept for the end
      const auto stop = hn::Lt(after, hn::Set(d, T(kMinTransmittance)));
      if (HWY_UNLIKELY(!hn::AllFalse(d, stop))) {
        const auto ends = hn::And(stop, hn::Gt(before, hn::Zero(d)));
        hn::BlendedStore(before, ends, d, tile.rest + first);
        weight = hn::IfThenZeroElse(stop, weight);
        after = hn::IfThenZeroElse(stop, after);
        if (hn::AllFalse(d, hn::Gt(after, hn::Zero(d)))) alive[patch / 64] &= ~(1ull << patch % 64), --open;
      }
      for (int k = 0; k < 4; ++k) {
        T* value = tile.value[k] + first;
        hn::Store(hn::MulAdd(weight, channel[k], hn::Load(d, value)), d, value);
      }
      hn::Store(after, d, tile.value[4] + first);
    });
  }

  for (int v = 0; v < Tile::kSamples; ++v) {
    if (!Tile::inside(v, band.x0, band.y0, job.width_px, job.height_px)) continue;
    const int64_t p = band.image * job.width_px * job.height_px + Tile::pixel(v, band.x0, band.y0, job.width_px);
    const T rest = tile.value[4][v] > 0 ? tile.value[4][v] : tile.rest[v];
    for (int k = 0; k < 3; ++k) job.out.image[3 * p + k] = tile.value[k][v] + rest * background[k];
    job.out.alpha[p] = 1 - rest;
    job.out.depth[p] = tile.value[3][v];
  }
}

// dL/dalpha_i = T_i v_i - (total - prefix_i) / (1 - alpha_i), where v is what a unit of weight adds to the loss: the
// sum over all later samples and the background follows from the total, so the walk is front to back as well.
template <class T>
void BackwardTile(const DenseJob<T>& job, const DenseBand<T>& band, DenseTile<T>& tile, const int32_t* begin,
                  const int32_t* end, Counters& counters, T* g_background) {
  using Tile = DenseTile<T>;
  using V = typename Tile::V;
  const Tag<T> d;
  V x[Tile::kAcross];
  for (int across = 0; across < Tile::kAcross; ++across) x[across] = tile.xs(d, across);

  // Gradients of colour (0..2) and depth (3); total = sum_i w_i v_i + rest * v_background
  for (int v = 0; v < Tile::kSamples; ++v) {
    const bool inside = Tile::inside(v, band.x0, band.y0, job.width_px, job.height_px);
    const int64_t p = band.image * job.width_px * job.height_px + Tile::pixel(v, band.x0, band.y0, job.width_px);
    T total = 0;
    for (int k = 0; k < 3; ++k) {
      tile.gradient[k][v] = inside ? job.gradients.image[3 * p + k] : T(0);
      if (inside) total += tile.gradient[k][v] * job.images.image[3 * p + k];
    }
    tile.gradient[3][v] = inside ? job.gradients.depth[p] : T(0);
    if (inside) {
      const T rest = 1 - job.images.alpha[p];
      total += tile.gradient[3][v] * job.images.depth[p] - job.gradients.alpha[p] * rest;
      for (int k = 0; k < 3; ++k) g_background[k] += tile.gradient[k][v] * rest;
    }
    tile.total[v] = total;
    tile.prefix[v] = 0;
    tile.value[4][v] = inside ? T(1) : T(0);
  }

  const int64_t size = pair_gradient_size(0);
  const int64_t image = band.image;
  for (const int32_t* id = begin; id != end; ++id) {
    const Splat<T>& s = band.splat(*id);
    const T* c = band.colour(*id);
    const V channel[4] = {hn::Set(d, c[0]), hn::Set(d, c[1]), hn::Set(d, c[2]), hn::Set(d, s.depth)};
    const V inverse_S = hn::Set(d, T(1) / s.S0);
    SplatSums<Tag<T>> sums(d);
    V g_channel[4] = {hn::Zero(d), hn::Zero(d), hn::Zero(d), hn::Zero(d)};
    bool touched = false;
    band.for_each_patch(tile, s, [&](int patch, int across, V A, V dy, V M0) HWY_ATTR {
      const int first = patch * Tile::kLanes;
      const V before = hn::Load(d, tile.value[4] + first);
      const V dx = hn::Sub(x[across], M0);
      const V power = hn::NegMulAdd(hn::Mul(dx, dx), inverse_S, A);
      V alpha = Alpha(d, power);
      const V after = hn::NegMulAdd(alpha, before, before);
      const auto stop = hn::Lt(after, hn::Set(d, T(kMinTransmittance)));
      hn::Store(hn::IfThenZeroElse(stop, after), d, tile.value[4] + first);
      alpha = hn::IfThenZeroElse(stop, alpha);
      if (hn::AllFalse(d, hn::Gt(alpha, hn::Zero(d)))) return;
      touched = true;
      counters.evaluations += Tile::kLanes;

      const V weight = hn::Mul(alpha, before);
      V v = hn::Zero(d);
      for (int k = 0; k < 4; ++k) {
        const V g = hn::Load(d, tile.gradient[k] + first);
        v = hn::MulAdd(g, channel[k], v);
        g_channel[k] = hn::MulAdd(g, weight, g_channel[k]);
      }
      const V prefix = hn::MulAdd(weight, v, hn::Load(d, tile.prefix + first));
      hn::Store(prefix, d, tile.prefix + first);
      const V later = hn::Div(hn::Sub(hn::Load(d, tile.total + first), prefix), hn::Sub(hn::Set(d, T(1)), alpha));
      const V g_alpha = hn::MulSub(before, v, later);
      const auto free = hn::And(hn::Gt(alpha, hn::Zero(d)), hn::Lt(power, hn::Set(d, T(kLog2MaxAlpha))));
      const V g_power = hn::IfThenElseZero(free, hn::Mul(hn::Mul(g_alpha, alpha), hn::Set(d, T(kLn2))));
      sums.Add(g_power, dy, hn::Mul(dx, inverse_S));
    });
    if (!touched) continue;
    const int64_t own_band = band.y0 / kBandRows - rows_of(s, job.height_px).first / kBandRows;
    T* out = job.pair_gradients + (job.first_pair[image * job.splats.count + *id] + own_band) * size;
    sums.Reduce(d, s, out);
    out[kSplatFields - 1] += hn::GetLane(hn::SumOfLanes(d, g_channel[3]));
    for (int k = 0; k < 3; ++k) out[kSplatFields + k] += hn::GetLane(hn::SumOfLanes(d, g_channel[k]));
  }
}

template <class T>
Counters CompositeDenseImpl(const DenseJob<T>& job) {
  const int64_t items = job.splats.images * band_count(job.height_px);
  std::vector<TileLists> lists(size_t(std::max(job.threads, 1)));
  std::vector<Counters> counters(lists.size());
  auto tiles = hwy::MakeUniqueAlignedArray<DenseTile<T>>(lists.size());
  parallel_for(items, job.threads, [&](int64_t item, int worker) {
    DenseBand<T> band(job, item);
    TileLists& list = lists[size_t(worker)];
    Counters& c = counters[size_t(worker)];
    band.build(list);
    c.pairs += list.pairs();
    for (int64_t t = 0; t < band.tiles(); ++t) {
      band.x0 = t * DenseTile<T>::kSide;
      if (job.backward)
        BackwardTile(job, band, tiles[size_t(worker)], list.begin(t), list.end(t), c, job.band_background + 3 * item);
      else
        ForwardTile(job, band, tiles[size_t(worker)], list.begin(t), list.end(t), c);
    }
  });
  Counters sum;
  for (size_t w = 0; w < lists.size(); ++w) {
    sum.pairs += counters[w].pairs;
    sum.evaluations += counters[w].evaluations;
    sum.scratch_bytes += lists[w].bytes() + int64_t(sizeof(DenseTile<T>));
  }
  return sum;
}

Counters CompositeDenseF32(const DenseJob<float>& job) { return CompositeDenseImpl(job); }
Counters CompositeDenseF64(const DenseJob<double>& job) { return CompositeDenseImpl(job); }

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lfgs {
namespace {

HWY_EXPORT(CompositeDenseF32);
HWY_EXPORT(CompositeDenseF64);

Counters dispatch(const DenseJob<float>& job) { return HWY_DYNAMIC_DISPATCH(CompositeDenseF32)(job); }
Counters dispatch(const DenseJob<double>& job) { return HWY_DYNAMIC_DISPATCH(CompositeDenseF64)(job); }

}  // namespace

template <class T>
Counters composite_dense(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const T* background,
                         DenseImages<T> out, int threads) {
  DenseJob<T> job{};
  job.splats = splats, job.bins = bins, job.background = background, job.out = out, job.threads = threads;
  job.width_px = cameras.width_px, job.height_px = cameras.height_px;
  return dispatch(job);
}

template <class T>
Counters composite_dense_backward(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const T* background,
                                  DenseImages<const T> images, DenseImages<const T> gradients,
                                  const int64_t* first_pair, T* pair_gradients, T* band_background, int threads) {
  DenseJob<T> job{};
  job.splats = splats, job.bins = bins, job.background = background, job.threads = threads;
  job.images = images, job.gradients = gradients, job.first_pair = first_pair;
  job.pair_gradients = pair_gradients, job.band_background = band_background, job.backward = true;
  job.width_px = cameras.width_px, job.height_px = cameras.height_px;
  return dispatch(job);
}

#define LFGS_INSTANTIATE(T)                                                                                          \
  template Counters composite_dense(const Splats<T>&, Bins, const Cameras<T>&, const T*, DenseImages<T>, int);       \
  template Counters composite_dense_backward(const Splats<T>&, Bins, const Cameras<T>&, const T*,                    \
                                             DenseImages<const T>, DenseImages<const T>, const int64_t*, T*, T*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
#endif
