// Stage composite for the panel, and its reverse. A work item is one band of rows.
#include <algorithm>
#include <memory>
#include <vector>

#include "base/parallel.h"
#include "cpu/lens_layout.h"
#include "cpu/tile_lists.h"
#include "math/colour_polynomial.h"
#include "pipeline/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/composite_lens.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"
#include "cpu/lens_tile-inl.h"
#include "math/blend-inl.h"

#ifndef LFGS_COMPOSITE_LENS_ONCE
#define LFGS_COMPOSITE_LENS_ONCE
namespace lfgs {
template <class T>
struct LensJob {
  Splats<T> splats;
  Bins bins;
  const Lens* lens;
  const T* background;  // [3]
  T* out;               // one of these two
  uint8_t* out8;
  const T *image, *gradient;  // reverse only
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

// Colour of a splat at the samples' offsets. kOrder: 0, 1, 2, or -1 for `order`.
template <int kOrder, class D>
HWY_INLINE hn::Vec<D> ColourAt(D d, const hn::TFromD<D>* colour, int order, hn::Vec<hn::RebindToSigned<D>> channel,
                               hn::Vec<D> s) {
  if constexpr (kOrder == 0) return Lookup(d, colour, channel);
  const int n = kOrder < 0 ? order : kOrder;
  auto c = Lookup(d, colour + n * kColourStride, channel);
  for (int p = n - 1; p >= 0; --p) c = hn::MulAdd(c, s, Lookup(d, colour + p * kColourStride, channel));
  return hn::Max(c, hn::Zero(d));
}

// A splat's constants as the samples of a tile read them.
template <class T>
struct LensSplat {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  V S0, S1, S2;
  const T* colour;
  int order;

  HWY_INLINE LensSplat(const Splats<T>& splats, int32_t id) {
    const D d;
    const Splat<T>& s = splats.splats[id];
    S0 = hn::Set(d, s.S0), S1 = hn::Set(d, s.S1), S2 = hn::Set(d, s.S2);
    colour = splats.colours + int64_t(id) * (splats.colour_order + 1) * kColourStride;
    order = splats.orders[id];
  }
  // log2 of opacity * weight; also dx = px - m(s) and 1 / S(s).
  HWY_INLINE V power(V x, V s, const typename LensTile<T>::Rows& rows, V& dx, V& inverse_S) const {
    const D d;
    dx = hn::NegMulAdd(s, hn::Load(d, rows.M1), hn::Sub(x, hn::Load(d, rows.M0)));
    inverse_S = Reciprocal(d, hn::MulAdd(hn::MulAdd(s, S2, S1), s, S0));
    return hn::NegMulAdd(hn::Mul(dx, dx), inverse_S, hn::Load(d, rows.A));
  }
};

template <int kOrder, class T>
void ForwardSplat(const LensJob<T>& job, LensTile<T>& tile, const T* background, int32_t id, int64_t count) {
  using Tile = LensTile<T>;
  using V = typename Tile::V;
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  const LensSplat<T> splat(job.splats, id);
  const T *xs = tile.x.get(), *ss = tile.s.get();
  T *colours = tile.colour.get(), *transmittances = tile.transmittance.get();
  const auto* channels = tile.channel.get();
  const auto* list = tile.list();

  for (int64_t k = 0; k < count; ++k) {
    const int64_t i = int64_t(list[k]) * Tile::kLanes;
    const typename Tile::Rows& rows = tile.rows(list[k]);
    const V s = hn::Load(d, ss + i);
    V dx, inverse_S;
    const V alpha = Alpha(d, splat.power(hn::Load(d, xs + i), s, rows, dx, inverse_S));
    const V before = hn::Load(d, transmittances + i);
    V weight = hn::Mul(alpha, before), after = hn::Sub(before, weight);
    const auto channel = hn::Load(di, channels + i);
    V c = ColourAt<kOrder>(d, splat.colour, splat.order, channel, s);

    // A sample whose transmittance would fall too low shows the background by what is left, and takes no more light
    const auto stop = hn::Lt(after, hn::Set(d, T(kMinTransmittance)));
    if (HWY_UNLIKELY(!hn::AllFalse(d, stop))) {
      weight = hn::IfThenElse(stop, before, weight);
      c = hn::IfThenElse(stop, Lookup(d, background, channel), c);
      after = hn::IfThenZeroElse(stop, after);
      if (hn::AllTrue(d, hn::Eq(after, hn::Zero(d)))) tile.retire(list[k]);
    }
    hn::Store(hn::MulAdd(weight, c, hn::Load(d, colours + i)), d, colours + i);
    hn::Store(after, d, transmittances + i);
  }
}

// Adds the background and writes the tile to the image.
template <class T>
void FinishTile(const LensJob<T>& job, LensTile<T>& tile, int64_t samples, const T* background) {
  using V = typename LensTile<T>::V;
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  constexpr int kLanes = LensTile<T>::kLanes;
  for (int64_t i = 0; i < samples; i += kLanes) {
    const V b = Lookup(d, background, hn::Load(di, &tile.channel[i]));
    V c = hn::MulAdd(hn::Load(d, &tile.transmittance[i]), b, hn::Load(d, &tile.colour[i]));
    if (job.out8) {
      const V unit = hn::Min(hn::Max(c, hn::Zero(d)), hn::Set(d, T(1)));
      const V byte = hn::MulAdd(unit, hn::Set(d, T(255)), hn::Set(d, T(0.5)));
      c = hn::BitCast(d, hn::ConvertTo(di, byte));
    }
    hn::Store(c, d, &tile.colour[i]);
  }
  const bool bgr = job.lens->bgr;
  using TI = typename LensTile<T>::TI;
  tile.for_each_run([&](int64_t row, int64_t m, int64_t count, int64_t sample) {
    const int64_t at = row * 3 * job.lens->width_px + m;
    int k = int(m % 3);
    for (int64_t t = 0; t < count; ++t, sample += kLanes) {
      const int64_t to = at + t + (bgr ? 2 - 2 * k : 0);
      k = k == 2 ? 0 : k + 1;
      if (job.out8)
        job.out8[to] = uint8_t(reinterpret_cast<const TI*>(tile.colour.get())[sample]);
      else
        job.out[to] = tile.colour[sample];
    }
  });
}

// See BackwardTile of the dense sensor for the formula; here a sample has one channel.
template <class T>
void BackwardSplat(const LensJob<T>& job, LensTile<T>& tile, int32_t id, T* out, int64_t count) {
  using V = typename LensTile<T>::V;
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  const LensSplat<T> splat(job.splats, id);
  const int order = splat.order;
  SplatSums<Tag<T>> sums(d);
  V g_colour[3 * (kMaxColourOrder + 1)];
  for (int k = 0; k < 3 * (order + 1); ++k) g_colour[k] = hn::Zero(d);
  bool touched = false;
  for (int64_t step = 0; step < count; ++step) {
    const auto vector = tile.list()[step];
    const int64_t i = int64_t(vector) * LensTile<T>::kLanes;
    const auto& rows = tile.rows(vector);
    const V s = hn::Load(d, &tile.s[i]);
    V dx, inverse_S;
    const V power = splat.power(hn::Load(d, &tile.x[i]), s, rows, dx, inverse_S);
    V alpha = Alpha(d, power);
    const V before = hn::Load(d, &tile.transmittance[i]);
    const V after = hn::NegMulAdd(alpha, before, before);
    const auto stop = hn::Lt(after, hn::Set(d, T(kMinTransmittance)));
    const V g = hn::Load(d, &tile.gradient[i]);
    const auto channel = hn::Load(di, &tile.channel[i]);
    if (HWY_UNLIKELY(!hn::AllFalse(d, stop))) {
      // `colour` collects what each sample lets through to the background
      hn::Store(hn::Add(hn::Load(d, &tile.colour[i]), hn::IfThenElseZero(stop, before)), d, &tile.colour[i]);
      if (hn::AllTrue(d, hn::Or(stop, hn::Eq(before, hn::Zero(d))))) tile.retire(vector);
    }
    hn::Store(hn::IfThenZeroElse(stop, after), d, &tile.transmittance[i]);
    alpha = hn::IfThenZeroElse(stop, alpha);
    const auto lit = hn::Gt(alpha, hn::Zero(d));
    if (hn::AllFalse(d, lit)) continue;
    touched = true;

    const V c = order == 0 ? ColourAt<0>(d, splat.colour, 0, channel, s)
                           : ColourAt<-1>(d, splat.colour, order, channel, s);
    const V weight = hn::Mul(alpha, before), v = hn::Mul(g, c);
    const V prefix = hn::MulAdd(weight, v, hn::Load(d, &tile.prefix[i]));
    hn::Store(prefix, d, &tile.prefix[i]);
    const V later = hn::Div(hn::Sub(hn::Load(d, &tile.total[i]), prefix), hn::Sub(hn::Set(d, T(1)), alpha));
    const V g_alpha = hn::MulSub(before, v, later);
    const auto free = hn::And(lit, hn::Lt(power, hn::Set(d, T(kLog2MaxAlpha))));
    const V g_power = hn::IfThenElseZero(free, hn::Mul(hn::Mul(g_alpha, alpha), hn::Set(d, T(kLn2))));
    sums.Add(g_power, hn::Load(d, rows.dy), hn::Mul(dx, inverse_S), s);

    // Colour coefficients, unless the clamp at zero holds (order 0 was clamped, and is masked, at projection)
    V g_c = hn::Mul(g, weight);
    if (order > 0) g_c = hn::IfThenElseZero(hn::Gt(c, hn::Zero(d)), g_c);
    for (int k = 0; k < 3; ++k) {
      V term = hn::IfThenElseZero(hn::RebindMask(d, hn::Eq(channel, hn::Set(di, typename LensTile<T>::TI(k)))), g_c);
      for (int p = 0; p <= order; ++p, term = hn::Mul(term, s))
        g_colour[3 * p + k] = hn::Add(g_colour[3 * p + k], term);
    }
  }
  if (!touched) return;
  sums.Reduce(d, job.splats.splats[id], out);
  for (int k = 0; k < 3 * (order + 1); ++k) out[kSplatFields + k] += hn::GetLane(hn::SumOfLanes(d, g_colour[k]));
}

// Fills what the reverse reads at every sample.
template <class T>
void LoadGradients(const LensJob<T>& job, LensTile<T>& tile, int64_t samples) {
  constexpr int kLanes = LensTile<T>::kLanes;
  for (auto* a : {&tile.gradient, &tile.total, &tile.prefix}) std::fill(a->get(), a->get() + samples, T(0));
  tile.for_each_run([&](int64_t row, int64_t m, int64_t count, int64_t sample) {
    for (int64_t t = 0; t < count; ++t, sample += kLanes) {
      const int64_t from = row * 3 * job.lens->width_px + (m + t) / 3 * 3 + tile.channel[sample];
      tile.gradient[sample] = job.gradient[from];
      tile.total[sample] = job.gradient[from] * job.image[from];
    }
  });
}

template <class T>
void BackgroundGradient(const LensTile<T>& tile, int64_t samples, T* out) {
  for (int64_t i = 0; i < samples; ++i)
    out[tile.channel[i]] += tile.gradient[i] * (tile.colour[i] + tile.transmittance[i]);
}

template <class T>
Counters CompositeLensImpl(const LensJob<T>& job) {
  const Lens& lens = *job.lens;
  const bool backward = job.backward;
  const LensLayout layout(lens, LensTile<T>::kCellsPerPatch);
  const size_t workers = size_t(std::max(job.threads, 1));
  std::vector<TileLists> lists(workers);
  std::vector<Counters> counters(workers);
  std::vector<std::unique_ptr<LensTile<T>>> tiles(workers);
  const int64_t size = pair_gradient_size(job.splats.colour_order);
  alignas(16) const T background[kColourStride] = {job.background[0], job.background[1], job.background[2], 0};

  parallel_for(band_count(lens.height_px), job.threads, [&](int64_t band, int worker) {
    if (!tiles[size_t(worker)]) tiles[size_t(worker)] = std::make_unique<LensTile<T>>(lens, layout, backward);
    LensTile<T>& tile = *tiles[size_t(worker)];
    TileLists& list = lists[size_t(worker)];
    Counters& c = counters[size_t(worker)];
    const int64_t row0 = band * kBandRows, rows = std::min<int64_t>(kBandRows, lens.height_px - row0);
    const Range cells = layout.cells_of_band(lens, row0);
    const int64_t tile_count = (cells.last - cells.first) / layout.cells_per_tile + 1;

    // Tiles that each splat of the band sweeps over
    const int64_t begin = job.bins.band_offsets[band], end = job.bins.band_offsets[band + 1];
    list.build(job.bins.band_splats + begin, end - begin, tile_count, [&](int32_t id) -> Range {
      T low, high;
      if (!columns_of(job.splats.splats[id], T(row0) + T(0.5), T(row0 + rows) - T(0.5), T(layout.shear / 3), low, high))
        return {0, -1};
      const Range touched = layout.cells_of(double(low), double(high));
      const int64_t first = std::max(touched.first, cells.first), last = std::min(touched.last, cells.last);
      if (last < first) return {0, -1};
      return {(first - cells.first) / layout.cells_per_tile, (last - cells.first) / layout.cells_per_tile};
    });
    c.pairs += list.pairs();

    for (int64_t t = 0; t < tile_count; ++t) {
      tile.move_to(row0, cells.first + t * layout.cells_per_tile);
      if (backward) LoadGradients(job, tile, layout.samples());
      for (const int32_t* id = list.begin(t); id != list.end(t) && tile.open > 0; ++id) {
        const int64_t count = tile.find(job.splats.splats[*id]);
        c.evaluations += count * LensTile<T>::kLanes;
        if (!backward) {
          switch (job.splats.orders[*id]) {
            case 0: ForwardSplat<0>(job, tile, background, *id, count); break;
            case 1: ForwardSplat<1>(job, tile, background, *id, count); break;
            case 2: ForwardSplat<2>(job, tile, background, *id, count); break;
            default: ForwardSplat<-1>(job, tile, background, *id, count);
          }
          continue;
        }
        const int64_t own_band = band - rows_of(job.splats.splats[*id], lens.height_px).first / kBandRows;
        BackwardSplat(job, tile, *id, job.pair_gradients + (job.first_pair[*id] + own_band) * size, count);
      }
      if (backward)
        BackgroundGradient(tile, layout.samples(), job.band_background + 3 * band);
      else
        FinishTile(job, tile, layout.samples(), background);
    }
  });

  Counters sum;
  for (size_t w = 0; w < workers; ++w) {
    sum.pairs += counters[w].pairs;
    sum.evaluations += counters[w].evaluations;
    sum.scratch_bytes += lists[w].bytes() + (tiles[w] ? tiles[w]->bytes() : 0);
  }
  return sum;
}

Counters CompositeLensF32(const LensJob<float>& job) { return CompositeLensImpl(job); }
Counters CompositeLensF64(const LensJob<double>& job) { return CompositeLensImpl(job); }

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lfgs {
namespace {

HWY_EXPORT(CompositeLensF32);
HWY_EXPORT(CompositeLensF64);

Counters dispatch(const LensJob<float>& job) { return HWY_DYNAMIC_DISPATCH(CompositeLensF32)(job); }
Counters dispatch(const LensJob<double>& job) { return HWY_DYNAMIC_DISPATCH(CompositeLensF64)(job); }

}  // namespace

template <class T>
Counters composite_lens(const Splats<T>& splats, Bins bins, const Lens& lens, const T* background, T* out,
                        uint8_t* out8, int threads) {
  LensJob<T> job{};
  job.splats = splats, job.bins = bins, job.lens = &lens, job.background = background, job.threads = threads;
  job.out = out, job.out8 = out8;
  return dispatch(job);
}

template <class T>
Counters composite_lens_backward(const Splats<T>& splats, Bins bins, const Lens& lens, const T* background,
                                 const T* image, const T* gradient, const int64_t* first_pair, T* pair_gradients,
                                 T* band_background, int threads) {
  LensJob<T> job{};
  job.splats = splats, job.bins = bins, job.lens = &lens, job.background = background, job.threads = threads;
  job.image = image, job.gradient = gradient, job.first_pair = first_pair;
  job.pair_gradients = pair_gradients, job.band_background = band_background, job.backward = true;
  return dispatch(job);
}

#define LFGS_INSTANTIATE(T)                                                                                        \
  template Counters composite_lens(const Splats<T>&, Bins, const Lens&, const T*, T*, uint8_t*, int);              \
  template Counters composite_lens_backward(const Splats<T>&, Bins, const Lens&, const T*, const T*, const T*,     \
                                            const int64_t*, T*, T*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
#endif
