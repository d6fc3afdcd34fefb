// Stage composite for the panel, and its reverse. A work item is one band of rows.
#include <algorithm>
#include <array>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include "base/parallel.h"
#include "cpu/lens_job.h"
#include "cpu/lens_run.h"
#include "cpu/tile_lists.h"
#include "math/colour_polynomial.h"
#include "pipeline/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/composite_lens.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"
#include "cpu/lens_blend-inl.h"
#include "cpu/lens_lattice-inl.h"
#include "cpu/lens_tile-inl.h"
#include "math/blend-inl.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// From the places of a panel that has the blue left-most to the channels of an image.
template <class U>
void SwapRedBlue(U* rows, int64_t pixels) {
  for (int64_t j = 0; j < pixels; ++j) std::swap(rows[3 * j], rows[3 * j + 2]);
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
              continue;
            }
            switch (lattice->judge(run, job.splats, begin, end, background, level + 1 == kLatticeLevels)) {
              case LensLattice::Verdict::kFits:
                job.out8 ? lattice->write(run, job.out8) : lattice->write(run, job.out);
                break;
              case LensLattice::Verdict::kRefuse:
                draw_tiles(begin, end - begin, own);
                break;
              case LensLattice::Verdict::kSplit: {
                const float fineness = lattice->fineness;
                self(self, begin, end - begin, own, level + 1);
                lattice->fineness = fineness;
              }
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
