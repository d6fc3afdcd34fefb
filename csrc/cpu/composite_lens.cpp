// Stage composite for the panel, and its reverse. A work item is one band of rows.
#include <algorithm>
#include <array>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include "base/parallel.h"
#include "cpu/lens_run.h"
#include "cpu/tile_lists.h"
#include "math/colour_polynomial.h"
#include "pipeline/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/composite_lens.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"
#include "cpu/lens_lattice-inl.h"
#include "cpu/lens_splat-inl.h"
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
  Quality quality;
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

// Blends a splat over the `count` vectors that it may touch. Never inlined: what is constant stays in registers.
template <class Footprint, int kOrder, class T>
HWY_NOINLINE void ForwardSplat(const LensJob<T>& job, LensTile<T>& tile, const T* background, int32_t id,
                               const Footprint& shape, int64_t count) {
  constexpr int kLanes = LensTile<T>::kLanes, kStep = 4;  // vectors at once: they share the look-out for what stops
  using V = typename LensTile<T>::V;
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  const Footprint footprint = shape;
  const T *xs = tile.x.get(), *ss = tile.s.get(), *colour = colour_of(job.splats, id);
  T *colours = tile.colour.get(), *transmittances = tile.transmittance.get();
  const int order = job.splats.orders[id];
  const V least_after = hn::Set(d, T(job.quality.stop));
  const bool ends_early = job.quality.ends_early();

  auto blend = [&](auto vectors, const uint16_t* list) {
    V weights[vectors], afters[vectors], least = least_after;
    for (int n = 0; n < vectors; ++n) {
      const int64_t i = int64_t(list[n]) * kLanes;
      const V before = hn::Load(d, transmittances + i);
      weights[n] = footprint.weight(hn::Load(d, xs + i), hn::Load(d, ss + i), tile.rows(list[n]), before);
      afters[n] = hn::Sub(before, weights[n]);
      least = hn::Min(least, afters[n]);
    }
    const bool stops = !hn::AllFalse(d, hn::Lt(least, least_after));
    for (int n = 0; n < vectors; ++n) {
      const int64_t i = int64_t(list[n]) * kLanes;
      const auto channel = hn::Load(di, &tile.channel[i]);
      V weight = weights[n], after = afters[n], c = ColourAt<kOrder>(d, colour, order, channel, hn::Load(d, ss + i));

      // A sample whose transmittance would fall too low shows the background by what is left, and takes no more light
      if (HWY_UNLIKELY(stops)) {
        const auto stop = hn::Lt(after, least_after);
        weight = hn::IfThenElse(stop, hn::Load(d, transmittances + i), weight);
        if (!ends_early) c = hn::IfThenElse(stop, Lookup(d, background, channel), c);
        after = hn::IfThenZeroElse(stop, after);
        if (hn::AllTrue(d, hn::Eq(after, hn::Zero(d)))) tile.retire(list[n]);
      }
      hn::Store(hn::MulAdd(weight, c, hn::Load(d, colours + i)), d, colours + i);
      hn::Store(after, d, transmittances + i);
    }
  };
  const uint16_t *list = tile.list(), *end = list + count;
  for (; list + kStep <= end; list += kStep) blend(std::integral_constant<int, kStep>(), list);
  for (; list < end; ++list) blend(std::integral_constant<int, 1>(), list);
}

// The same, by the cheapest code that is right for the splat.
template <class T>
void Forward(const LensJob<T>& job, LensTile<T>& tile, const T* background, int32_t id, int64_t count) {
  const Splat<T>& splat = job.splats.splats[id];
  auto draw = [&](const auto& footprint) {
    switch (job.splats.orders[id]) {
      case 0: return ForwardSplat<std::decay_t<decltype(footprint)>, 0>(job, tile, background, id, footprint, count);
      case 1: return ForwardSplat<std::decay_t<decltype(footprint)>, 1>(job, tile, background, id, footprint, count);
      case 2: return ForwardSplat<std::decay_t<decltype(footprint)>, 2>(job, tile, background, id, footprint, count);
      default: return ForwardSplat<std::decay_t<decltype(footprint)>, -1>(job, tile, background, id, footprint, count);
    }
  };
  with_footprint(splat, job.quality, draw);
}

// Adds the background and writes the tile to the image, a sub-pixel by its place in the pixel.
template <class T>
void FinishTile(const LensJob<T>& job, LensTile<T>& tile, int64_t samples, const T* background) {
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  const hn::RebindToUnsigned<Tag<T>> du;
  const hn::Rebind<uint8_t, Tag<T>> d8;
  constexpr int kLanes = LensTile<T>::kLanes;
  uint8_t* bytes = reinterpret_cast<uint8_t*>(tile.transmittance.get());  // read no more once they are written
  for (int64_t i = 0; i < samples; i += kLanes) {
    const auto b = Lookup(d, background, hn::Load(di, &tile.channel[i]));
    const auto c = hn::MulAdd(hn::Load(d, &tile.transmittance[i]), b, hn::Load(d, &tile.colour[i]));
    if (job.out8) {
      const auto unit = hn::Min(hn::Max(c, hn::Zero(d)), hn::Set(d, T(1)));
      const auto rounded = hn::ConvertTo(di, hn::MulAdd(unit, hn::Set(d, T(255)), hn::Set(d, T(0.5))));
      hn::Store(hn::TruncateTo(d8, hn::BitCast(du, rounded)), d8, bytes + i);
    } else {
      hn::Store(c, d, &tile.colour[i]);
    }
  }
  auto write = [&](const auto* from, auto* image) {
    tile.for_each_run([&](int64_t row, int64_t m, int64_t count, int64_t sample) {
      auto* to = image + row * 3 * job.lens->width_px + m;
      for (int64_t t = 0; t < count; ++t) to[t] = from[sample + t * kLanes];
    });
  };
  job.out8 ? write(bytes, job.out8) : write(tile.colour.get(), job.out);
}

// From the places of a panel that has the blue left-most to the channels of an image.
template <class U>
void SwapRedBlue(U* rows, int64_t pixels) {
  for (int64_t j = 0; j < pixels; ++j) std::swap(rows[3 * j], rows[3 * j + 2]);
}

// See BackwardTile of the dense sensor for the formula; here a sample has one channel.
template <class T>
void BackwardSplat(const LensJob<T>& job, LensTile<T>& tile, int32_t id, T* out, int64_t count) {
  using V = typename LensTile<T>::V;
  const Tag<T> d;
  const hn::RebindToSigned<Tag<T>> di;
  const Splat<T>& splat = job.splats.splats[id];
  const ExactFootprint<T> footprint(splat, T(kLog2MinAlpha));
  const T* colour = colour_of(job.splats, id);
  const int order = job.splats.orders[id];
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
    const V power = footprint.power(hn::Load(d, &tile.x[i]), s, rows, dx, inverse_S);
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

    const V c = order == 0 ? ColourAt<0>(d, colour, 0, channel, s)
                           : ColourAt<-1>(d, colour, order, channel, s);
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
  sums.Reduce(d, splat, out);
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

constexpr int kLatticeTiles = 8, kLatticeLevels = 3;  // side by side on one lattice; how often these are halved, less 1

template <class T>
Counters CompositeLensImpl(const LensJob<T>& job) {
  const Lens& lens = *job.lens;
  const bool backward = job.backward;
  const LensLayout layout(lens, LensTile<T>::kCellsPerPatch);
  const size_t workers = size_t(std::max(job.threads, 1));
  std::vector<TileLists> lists(workers);
  std::vector<Counters> counters(workers);
  std::vector<std::unique_ptr<LensTile<T>>> tiles(workers);
  std::vector<std::unique_ptr<LensLattice>> lattices(workers);
  std::vector<std::array<TileLists, kLatticeLevels>> run_lists(workers);
  const int64_t size = pair_gradient_size(job.splats.colour_order);
  alignas(16) const T background[kColourStride] = {job.background[0], job.background[1], job.background[2], 0};

  T behind[3];
  uint8_t behind8[3];
  for (int place = 0; place < 3; ++place) {
    behind[place] = background[lens.bgr ? 2 - place : place];
    behind8[place] = uint8_t(std::clamp(behind[place], T(0), T(1)) * 255 + T(0.5));
  }
  const Backdrop<T> backdrop(behind, lens.width_px);
  const Backdrop<uint8_t> backdrop8(behind8, lens.width_px);

  // A lattice has no use for jumps at a raised opacity cut: only what is drawn without it is cut
  const bool raised = job.quality.lattice > 0 && job.quality.log2_cut > kLog2MinAlpha;
  auto splat_of = [&](int32_t id, bool exact) {
    Splat<T> splat = job.splats.splats[id];
    if (raised && !exact) raise_cut(splat, T(job.quality.log2_cut));
    return splat;
  };

  parallel_for(band_count(lens.height_px), job.threads, [&](int64_t band, int worker) {
    if (!tiles[size_t(worker)]) tiles[size_t(worker)] = std::make_unique<LensTile<T>>(lens, layout, backward);
    LensTile<T>& tile = *tiles[size_t(worker)];
    TileLists& list = lists[size_t(worker)];
    Counters& c = counters[size_t(worker)];
    const int64_t row0 = band * kBandRows, rows = std::min<int64_t>(kBandRows, lens.height_px - row0);
    const Range cells = layout.cells_of_band(lens, row0);

    // Lists of the splats that sweep over each of some runs of cells, `width` wide
    auto list_runs = [&](TileLists& out, const int32_t* ids, int64_t count, Range cells, int64_t width, bool exact) {
      out.build(ids, count, (cells.last - cells.first) / width + 1, [&](int32_t id) -> Range {
        T low, high;
        if (!columns_of(splat_of(id, exact), T(row0) + T(0.5), T(row0 + rows) - T(0.5), T(layout.shear / 3), low,
                        high))
          return {0, -1};
        const Range touched = layout.cells_of(double(low), double(high));
        const int64_t first = std::max(touched.first, cells.first), last = std::min(touched.last, cells.last);
        if (last < first) return {0, -1};
        return {(first - cells.first) / width, (last - cells.first) / width};
      });
      c.pairs += out.pairs();
    };
    auto draw_empty = [&](const LensRun& run) {
      job.out8 ? backdrop8.draw(run, lens.width_px, job.out8) : backdrop.draw(run, lens.width_px, job.out);
    };
    auto draw_tile = [&](int64_t cell0, const int32_t* begin, const int32_t* end) {
      if (begin == end && !backward) return draw_empty(LensRun(lens, layout, row0, cell0, layout.cells_per_tile));
      tile.move_to(row0, cell0);
      if (backward) LoadGradients(job, tile, layout.samples());
      for (const int32_t* id = begin; id != end && tile.open > 0; ++id) {
        const int64_t count = tile.find(splat_of(*id, false));
        c.evaluations += count * LensTile<T>::kLanes;
        if (!backward) {
          Forward(job, tile, background, *id, count);
          continue;
        }
        const int64_t own_band = band - rows_of(job.splats.splats[*id], lens.height_px).first / kBandRows;
        BackwardSplat(job, tile, *id, job.pair_gradients + (job.first_pair[*id] + own_band) * size, count);
      }
      if (backward)
        BackgroundGradient(tile, layout.samples(), job.band_background + 3 * band);
      else
        FinishTile(job, tile, layout.samples(), background);
    };
    auto draw_tiles = [&](const int32_t* ids, int64_t count, Range cells) {
      list_runs(list, ids, count, cells, layout.cells_per_tile, false);
      for (int64_t cell = cells.first, t = 0; cell <= cells.last; cell += layout.cells_per_tile, ++t)
        draw_tile(cell, list.begin(t), list.end(t));
    };

    const int32_t* ids = job.bins.band_splats + job.bins.band_offsets[band];
    const int64_t count = job.bins.band_offsets[band + 1] - job.bins.band_offsets[band];
    if constexpr (sizeof(T) == 4) {
      if (job.quality.lattice > 0) {
        auto& lattice = lattices[size_t(worker)];
        if (!lattice) lattice = std::make_unique<LensLattice>(lens, job.quality);
        lattice->start_band();
        // Runs that want a much finer lattice are halved first
        auto draw_runs = [&](auto& self, const int32_t* ids, int64_t count, Range cells, int level) -> void {
          TileLists& runs = run_lists[size_t(worker)][size_t(level)];
          const int64_t width = (kLatticeTiles >> level) * layout.cells_per_tile;
          list_runs(runs, ids, count, cells, width, true);
          for (int64_t cell = cells.first, t = 0; cell <= cells.last; cell += width, ++t) {
            const LensRun run(lens, layout, row0, cell, width);
            const Range own = {cell, std::min(cell + width - 1, cells.last)};
            const int32_t *begin = runs.begin(t), *end = runs.end(t);
            if (run.samples() == 0) continue;
            if (begin == end) {
              draw_empty(run);
            } else if (const bool last = level + 1 == kLatticeLevels;
                       lattice->fits(run, job.splats, begin, end, background, last)) {
              job.out8 ? lattice->write(run, job.out8) : lattice->write(run, job.out);
            } else if (last) {
              draw_tiles(begin, end - begin, own);
            } else {
              const float fineness = lattice->fineness;
              self(self, begin, end - begin, own, level + 1);
              lattice->fineness = fineness;
            }
          }
        };
        draw_runs(draw_runs, ids, count, cells, 0);
      }
    }
    if (!(job.quality.lattice > 0)) draw_tiles(ids, count, cells);
    if (!backward && lens.bgr) {
      const int64_t first = row0 * 3 * lens.width_px, pixels = rows * lens.width_px;
      job.out8 ? SwapRedBlue(job.out8 + first, pixels) : SwapRedBlue(job.out + first, pixels);
    }
  });

  Counters sum;
  for (size_t w = 0; w < workers; ++w) {
    sum.pairs += counters[w].pairs;
    sum.evaluations += counters[w].evaluations + (lattices[w] ? lattices[w]->evaluations() : 0);
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
Counters composite_lens(const Splats<T>& splats, Bins bins, const Lens& lens, const Quality& quality,
                        const T* background, T* out, uint8_t* out8, int threads) {
  LensJob<T> job{};
  job.quality = quality, job.splats = splats, job.bins = bins, job.lens = &lens, job.background = background, job.threads = threads;
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
  template Counters composite_lens(const Splats<T>&, Bins, const Lens&, const Quality&, const T*, T*, uint8_t*, int); \
  template Counters composite_lens_backward(const Splats<T>&, Bins, const Lens&, const T*, const T*, const T*,     \
                                            const int64_t*, T*, T*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
#endif
