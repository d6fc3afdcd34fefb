// Stage composite for the panel, and its backward pass. It reads splats, their lists by band and the lens, and writes
// the image. The backward pass writes the gradients of intersections and of the background. A work item is one band of
// rows. Its tiles are drawn splat by splat (direct_blend-inl.h), or in runs from lattices where the quality allows it
// (direct_lattice-inl.h).
#include <algorithm>
#include <array>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include "base/parallel.h"
#include "cpu/dispatch.h"
#include "cpu/direct/direct_job.h"
#include "cpu/direct/lens_layout.h"
#include "cpu/tile_lists.h"
#include "hwy/cache_control.h"
#include "math/colour_polynomial.h"
#include "math/saturate.h"
#include "stages/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/direct/composite_direct.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"
#include "cpu/direct/direct_blend-inl.h"
#include "cpu/direct/direct_lattice-inl.h"
#include "cpu/direct/direct_tile-inl.h"
#include "math/blend-inl.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// Put the sub-pixels of pixels, drawn in the order of their places, in the order of the channels. `image` begins at
// row0.
template <class U>
void PlacesToChannels(const Lens& lens, int64_t row0, int64_t rows, U* image) {
  if (!lens.has_cells) {
    if (lens.bgr)
      for (int64_t j = 0; j < rows * lens.width_px; ++j) std::swap(image[3 * j], image[3 * j + 2]);
    return;
  }
  for (int64_t row = row0; row < row0 + rows; ++row)
    for (int64_t j = 0; j < lens.width_px; ++j, image += 3) {
      const uint8_t* channels = &lens.cells.channels[row % kCellPeriod][3 * (j % kCellPeriod)];
      const U a = image[0], b = image[1], c = image[2];
      image[channels[0]] = a, image[channels[1]] = b, image[channels[2]] = c;
    }
}

// So many tiles side by side form a run with one lattice. A run may be halved, and the halves again: three levels.
constexpr int kLatticeTiles = 8, kLatticeLevels = 3;
// Lattices are tried on every kProbeRows-th band first. Such a probe is worth it if it draws more than one tile from
// lattices for kLeastFitting that it draws splat by splat. Bands between two that were not do without lattices.
constexpr int64_t kLeastFitting = 3;
constexpr int64_t kAhead = 4;     // so many splats before its turn, a splat is fetched from memory
constexpr int64_t kLookOut = 32;  // splats drawn approximately between two searches for vectors that have stopped

// Common to all bands of an image.
template <class T>
struct DirectScene {
  const DirectJob<T>& job;
  LensLayout layout;
  alignas(16) T background[kColourStride];
  Backdrop<T> backdrop;
  Backdrop<uint8_t> backdrop8;
  // Where lattices are tried, projection leaves the opacity cut at 1/255: a lattice would take a jump at a higher cut
  // for an edge. The cut is raised here, for tiles that are drawn splat by splat.
  TileSplats<T> splats;

  explicit DirectScene(const DirectJob<T>& job_)
      : job(job_),
        layout(*job_.lens, DirectTile<T>::kCellsPerPatch),
        background{job_.background[0], job_.background[1], job_.background[2], 0},
        backdrop(*job_.lens, [&](int c) { return background[c]; }),
        backdrop8(*job_.lens, [&](int c) { return to_byte(background[c]); }),
        splats(job_.splats, job_.quality, job_.quality.lattice > 0 && job_.quality.log2_cut > kLog2MinAlpha,
               job_.threads) {}
};

// Splats by index, nearest first.
struct SplatList {
  const int32_t *begin, *end;
  int64_t size() const { return end - begin; }
  bool empty() const { return begin == end; }
};

// Draw bands, or take their gradients: one worker's memory and counters.
template <class T>
class DirectBands {
 public:
  explicit DirectBands(const DirectScene<T>& scene)
      : scene_(scene),
        job_(scene.job),
        lens_(*scene.job.lens),
        layout_(scene.layout),
        tile_(lens_, layout_, job_.backward, job_.g_offsets != nullptr),
        lattice_(lens_, job_.quality) {}

  // Draw a band, or take its gradients. Return whether lattices were worth trying, if they were tried.
  bool draw(int64_t band, bool try_lattices) {
    band_ = band, row0_ = band * kBandRows, rows_ = std::min<int64_t>(kBandRows, lens_.height_px - row0_);
    const int64_t* offsets = job_.bins.band_offsets + band;
    const SplatList splats = {job_.bins.band_splats + offsets[0], job_.bins.band_splats + offsets[1]};
    const Range cells = layout_.cells_of_band(lens_, row0_);
    const Counters before = counters_;
    if (try_lattices) {
      lattice_.start_band();
      draw_runs(splats, cells, 0);
    } else {
      draw_tiles(splats, cells);
    }
    if (!job_.backward) {
      const int64_t first = row0_ * 3 * lens_.width_px;
      job_.out8 ? PlacesToChannels(lens_, row0_, rows_, job_.out8 + first)
                : PlacesToChannels(lens_, row0_, rows_, job_.out + first);
    }
    return kLeastFitting * (counters_.lattice_tiles - before.lattice_tiles) > counters_.tiles - before.tiles;
  }

  Counters counters() const {
    Counters out = counters_;
    out.evaluations += lattice_.evaluations();
    out.scratch_bytes = tile_.bytes() + lattice_.bytes() + tiles_.bytes();
    for (const TileLists& runs : runs_) out.scratch_bytes += runs.bytes();
    return out;
  }

 private:
  // Lists which splats may touch each `width` of the cells. uncut: with the opacity cut at 1/255, as lattices take
  // them.
  void list(TileLists& out, SplatList splats, Range cells, int64_t width, bool uncut) {
    auto listed_splat = [&](int32_t id) -> const Splat<T>& {
      return uncut ? job_.splats.splats[id] : scene_.splats[id].splat;
    };
    auto tile_range = [&](int32_t id) -> Range {
      T low, high;
      const Splat<T>& splat = listed_splat(id);
      if (!footprint_columns(splat, T(row0_) + T(0.5), T(row0_ + rows_) - T(0.5), T(layout_.shear / 3), low, high))
        return {0, -1};
      const Range touched = layout_.cell_range(double(low), double(high));
      const int64_t first = std::max(touched.first, cells.first), last = std::min(touched.last, cells.last);
      if (last < first) return {0, -1};
      return {(first - cells.first) / width, (last - cells.first) / width};
    };
    out.build(splats.begin, splats.size(), (cells.last - cells.first) / width + 1, tile_range,
              [&](int32_t id) { hwy::Prefetch(&listed_splat(id)); });
    counters_.intersections += out.intersections();
  }

  int64_t tiles_in(Range cells) const { return (cells.last - cells.first) / layout_.cells_per_tile + 1; }

  void draw_empty(const LensRun& run, Range cells) {
    counters_.empty_tiles += tiles_in(cells);
    job_.out8 ? scene_.backdrop8.draw(run, lens_.width_px, job_.out8)
              : scene_.backdrop.draw(run, lens_.width_px, job_.out);
  }

  // Draw cells in runs, each from a lattice if it can be. A run that needs a much finer lattice is halved: that is the
  // next level.
  void draw_runs(SplatList splats, Range cells, int level) {
    TileLists& lists = runs_[size_t(level)];
    const int64_t width = (kLatticeTiles >> level) * layout_.cells_per_tile;
    list(lists, splats, cells, width, true);
    for (int64_t cell = cells.first, t = 0; cell <= cells.last; cell += width, ++t) {
      const LensRun run(lens_, layout_, row0_, cell, width);
      const SplatList own = {lists.begin(t), lists.end(t)};
      const Range own_cells = {cell, std::min(cell + width - 1, cells.last)};
      if (run.samples() == 0) continue;
      if (own.empty())
        draw_empty(run, own_cells);
      else
        draw_run(run, own, own_cells, level);
    }
  }

  // Draw a run from a lattice, in halves, or tile by tile, as the lattice judges. Lattices exist in float only.
  void draw_run(const LensRun& run, SplatList splats, Range cells, int level) {
    if constexpr (sizeof(T) == 4) {
      const bool last = level + 1 == kLatticeLevels;
      switch (lattice_.judge(run, job_.splats, splats.begin, splats.end, scene_.background, last)) {
        case DirectLattice::Verdict::kFits:
          job_.out8 ? lattice_.write(run, job_.out8) : lattice_.write(run, job_.out);
          ++counters_.lattices, counters_.lattice_tiles += tiles_in(cells);
          break;
        case DirectLattice::Verdict::kRefuse:
          ++counters_.refused_lattices;
          draw_tiles(splats, cells);
          break;
        case DirectLattice::Verdict::kSplit: {
          ++counters_.split_lattices;
          // The runs that follow begin with what this run has taught, not with what its halves need
          const float fineness = lattice_.fineness;
          draw_runs(splats, cells, level + 1);
          lattice_.fineness = fineness;
        }
      }
    }
  }

  void draw_tiles(SplatList splats, Range cells) {
    list(tiles_, splats, cells, layout_.cells_per_tile, false);
    for (int64_t cell = cells.first, t = 0; cell <= cells.last; cell += layout_.cells_per_tile, ++t)
      draw_tile(cell, {tiles_.begin(t), tiles_.end(t)});
  }

  void draw_tile(int64_t cell0, SplatList splats) {
    // Begin the tile, if there is anything to draw
    if (splats.empty() && !job_.backward)
      return draw_empty(LensRun(lens_, layout_, row0_, cell0, layout_.cells_per_tile), {cell0, cell0});
    ++counters_.tiles;
    tile_.move_to(row0_, cell0), blended_ = 0;
    if (job_.backward) LoadGradients(job_, tile_, layout_.samples());

    // Splats, nearest first, while a sample takes light
    for (const int32_t* id = splats.begin; id != splats.end && tile_.open > 0; ++id) {
      if (splats.end - id > kAhead) {
        hwy::Prefetch(&scene_.splats[id[kAhead]]);
        hwy::Prefetch(colours(job_.splats, id[kAhead]));
        hwy::Prefetch(&job_.splats.orders[id[kAhead]]);
      }
      const TileSplat<T>& splat = scene_.splats[*id];
      if constexpr (sizeof(T) == 4) {
        if (approximate_ && draw_approximately(*id, splat)) continue;
      }
      const int64_t count = tile_.find(splat.splat);
      counters_.evaluations += count * DirectTile<T>::kLanes;
      if (!job_.backward) {
        Forward(job_, tile_, scene_.background, *id, splat, count);
        continue;
      }

      // The gradient of this intersection: intersections of a splat are numbered by its bands
      const int64_t own_band = band_ - footprint_rows(job_.splats.splats[*id], lens_.height_px).first / kBandRows;
      const int64_t intersection = job_.first_intersection[*id] + own_band;
      const int order = job_.splats.colour_order;
      const IntersectionGradient<T> out{
          job_.intersection_gradients + intersection * intersection_gradient_size(order, compensated_), order};
      if (job_.g_offsets)
        compensated_ ? BackwardSplat<true, true>(job_, tile_, *id, out)
                     : BackwardSplat<false, true>(job_, tile_, *id, out);
      else
        compensated_ ? BackwardSplat<true, false>(job_, tile_, *id, out)
                     : BackwardSplat<false, false>(job_, tile_, *id, out);
    }
    if (job_.backward) BackgroundGradient(tile_, layout_.samples(), job_.band_background + 3 * band_);
    if (job_.g_offsets) StoreOffsetGradients(job_, tile_);
    if (!job_.backward) counters_.stopped_samples += FinishTile(job_, tile_, layout_.samples(), scene_.background);
  }

  // Blend a splat by an approximate footprint if one is near enough; return whether.
  bool draw_approximately(int32_t id, const TileSplat<float>& splat) {
    const float cut = float(job_.quality.sample_cut());
    if (ApproximateFootprint<true>::fits(splat.root))
      return blend(id, splat.splat, ApproximateFootprint<true>(splat.root, cut));
    if (ApproximateFootprint<false>::fits(splat.root))
      return blend(id, splat.splat, ApproximateFootprint<false>(splat.root, cut));
    return false;
  }

  // Blend a splat by this footprint. Return true, as draw_approximately does.
  template <class Footprint>
  bool blend(int32_t id, const Splat<float>& splat, const Footprint& footprint) {
    const int64_t count = tile_.find(splat, footprint.units());
    counters_.evaluations += count * DirectTile<T>::kLanes;
    with_order(job_.splats.orders[id],
               [&](auto order) { ApproximateSplat<Footprint, order>(job_, tile_, id, footprint); });
    if (++blended_ % kLookOut == 0) tile_.retire_below(float(job_.quality.darkest()));
    return true;
  }

  const DirectScene<T>& scene_;
  const DirectJob<T>& job_;
  const Lens& lens_;
  const LensLayout& layout_;
  const bool compensated_ = job_.splats.compensations != nullptr;
  const bool approximate_ = job_.quality.approximate() && !compensated_;  // approximate footprints have no compensation
  int64_t band_ = 0, row0_ = 0, rows_ = 0;
  DirectTile<T> tile_;
  DirectLattice lattice_;
  int64_t blended_ = 0;  // splats of this tile that were drawn approximately
  TileLists tiles_;
  std::array<TileLists, kLatticeLevels> runs_;
  Counters counters_;
};

template <class T>
Counters CompositeDirect(DirectJob<T> job) {
  if (!DirectLattice::knows(*job.lens)) job.quality.lattice = 0;
  const DirectScene<T> scene(job);

  // Every worker has memory of its own, from its first band on
  std::vector<std::unique_ptr<DirectBands<T>>> workers(size_t(std::max(job.threads, 1)));
  auto draw = [&](int64_t band, int worker, bool try_lattices) {
    auto& bands = workers[size_t(worker)];
    if (!bands) bands = std::make_unique<DirectBands<T>>(scene);
    return bands->draw(band, try_lattices);
  };

  // Probes for lattices first, then the bands between them; or all bands as they come
  const int64_t bands = band_count(job.lens->height_px);
  if (job.quality.lattice > 0) {
    std::vector<uint8_t> worth(size_t((bands - 1) / kProbeRows + 1));
    parallel_for(int64_t(worth.size()), job.threads,
                 [&](int64_t probe, int worker) { worth[size_t(probe)] = draw(probe * kProbeRows, worker, true); });
    parallel_for(bands, job.threads, [&](int64_t band, int worker) {
      const size_t above = size_t(band / kProbeRows), below = std::min(above + 1, worth.size() - 1);
      if (band % kProbeRows != 0) draw(band, worker, worth[above] || worth[below]);
    });
  } else {
    parallel_for(bands, job.threads, [&](int64_t band, int worker) { draw(band, worker, false); });
  }

  // Counters of all workers
  Counters sum;
  sum.scratch_bytes = scene.splats.bytes();
  for (const auto& bands : workers)
    if (bands) sum += bands->counters();
  return sum;
}

LFGS_FOR_EVERY_TARGET(CompositeDirect, DirectJob)

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lfgs {
namespace {

LFGS_DISPATCH(CompositeDirect, DirectJob)

}  // namespace

template <class T>
Counters composite_direct(const Splats<T>& splats, Bins bins, const Lens& lens, const Quality& quality,
                          const T* background, T* out, uint8_t* out8, int threads) {
  DirectJob<T> job{};
  job.splats = splats, job.bins = bins, job.lens = &lens, job.background = background, job.threads = threads;
  job.quality = quality, job.out = out, job.out8 = out8;
  return dispatch(job);
}

template <class T>
Counters composite_direct_backward(const Splats<T>& splats, Bins bins, const Lens& lens, const T* background,
                                   const T* image, const T* gradient, const int64_t* first_intersection,
                                   T* intersection_gradients, T* band_background, T* g_offsets, int threads) {
  DirectJob<T> job{};
  job.splats = splats, job.bins = bins, job.lens = &lens, job.background = background, job.threads = threads;
  job.image = image, job.gradient = gradient, job.first_intersection = first_intersection;
  job.intersection_gradients = intersection_gradients, job.band_background = band_background, job.backward = true;
  job.g_offsets = g_offsets;
  return dispatch(job);
}

#define LFGS_INSTANTIATE(T)                                                                                       \
  template Counters composite_direct(const Splats<T>&, Bins, const Lens&, const Quality&, const T*, T*, uint8_t*, \
                                     int);                                                                        \
  template Counters composite_direct_backward(const Splats<T>&, Bins, const Lens&, const T*, const T*, const T*,  \
                                              const int64_t*, T*, T*, T*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
#endif
