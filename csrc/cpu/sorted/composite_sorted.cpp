// Stage composite for sub-pixels sorted by view, where each view is an ordinary camera. Read splats and lists of
// sub-pixels, write the image. A work item is a group of bands of one view. A tile has only a few samples of the view.
// They are loaded in batches, with patches of one vector each, and splats are blended into a batch nearest first. The
// lists run along the columns, so that a patch is compact.
#include <algorithm>
#include <numeric>
#include <vector>

#include "base/error.h"
#include "cpu/dispatch.h"
#include "math/saturate.h"
#include "stages/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/sorted/composite_sorted.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/cache_control.h"
#include "hwy/highway.h"
#include "cpu/patches-inl.h"
#include "math/over-inl.h"

#ifndef LFGS_COMPOSITE_SORTED_ONCE
#define LFGS_COMPOSITE_SORTED_ONCE
namespace lfgs {
// Bands of a work item. The splats that they share are read from memory once. The lines of the image, which all views
// write to, still fit a large cache.
constexpr int64_t kBandsPerItem = 8;

template <class T>
struct SortedJob {
  Splats<T> splats;
  Bins bins;
  SubpixelLists lists;
  int64_t width_px, height_px;
  const T* background;  // [3]
  T* out;               // [H, W, 3], or null
  uint8_t* out8;        // or its bytes; one of the two is null
  int threads;
};
}  // namespace lfgs
#endif

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// Some sub-pixels of one view and tile, and their state. Codes that only fill a block up repeat the sub-pixel
// before, and are not stored.
template <class T>
struct SubpixelBatch {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  using TI = hn::TFromD<hn::RebindToSigned<D>>;
  static constexpr int kLanes = int(hn::MaxLanes(D())), kSamples = 256, kPatches = kSamples / kLanes;
  static_assert(kSamples % kSubpixelBlock == 0 && kSubpixelBlock % kLanes == 0);

  alignas(64) T x[kSamples], y[kSamples];  // from the tile's corner
  alignas(64) TI channel[kSamples];
  alignas(64) T value[kSamples], transmittance[kSamples], rest[kSamples];
  int64_t place[kSamples];  // in the image, or -1
  int count = 0;
  Patches<T, kPatches> patches;

  // Load `count_` samples, which are whole blocks; (x0, y0) is the tile's corner.
  void load(const SubpixelTile& tile, const uint16_t* codes, int count_, int64_t x0, int64_t y0, int64_t width_px) {
    count = count_;
    Subpixel s{};  // the tile's corner, if a list has no sub-pixel: its map changed after counting
    for (int i = 0; i < count; ++i) {
      const bool shown = codes[i] != kNoSubpixel;
      if (shown) s = decode_subpixel(tile, codes[i]);
      x[i] = T(s.column) + T(0.5), y[i] = T(s.row) + T(0.5), channel[i] = TI(s.channel);
      place[i] = shown ? ((y0 + s.row) * width_px + x0 + s.column) * 3 + s.channel : -1;
    }
    std::fill(value, value + count, T(0));
    std::fill(transmittance, transmittance + count, T(1));

    // The box of each patch; the samples are in order of columns
    const D d;
    for (int p = 0; p < count / kLanes; ++p) {
      const V rows = hn::Load(d, y + p * kLanes);
      const T first = x[p * kLanes], last = x[(p + 1) * kLanes - 1];
      const T top = hn::GetLane(hn::MinOfLanes(d, rows)), bottom = hn::GetLane(hn::MaxOfLanes(d, rows));
      patches.x[p] = (first + last) / 2, patches.half_x[p] = (last - first) / 2;
      patches.y[p] = (top + bottom) / 2, patches.half_y[p] = (bottom - top) / 2;
    }
    patches.reopen(count / kLanes);
  }

  // Blend a splat into the patches that find() has marked.
  HWY_INLINE void add(const SplatTerms<T>& s, const T* colour) {
    const D d;
    const hn::RebindToSigned<D> di;
    patches.for_each_touched([&](int patch) HWY_ATTR {
      const int i = patch * kLanes;
      V dx, dy, weight;
      const V alpha = Alpha(d, s.power(hn::Load(d, x + i), hn::Load(d, y + i), dx, dy));
      if (HWY_UNLIKELY(Over(d, alpha, transmittance + i, rest + i, weight))) patches.close(patch);
      const V own = Lookup(d, colour, hn::Load(di, channel + i));
      hn::Store(hn::MulAdd(weight, own, hn::Load(d, value + i)), d, value + i);
    });
  }

  // Add the background and write to the image.
  void store(const SortedJob<T>& job) const {
    for (int i = 0; i < count; ++i) {
      if (place[i] < 0) continue;
      const T left = transmittance[i] > 0 ? transmittance[i] : rest[i];
      const T c = value[i] + left * job.background[channel[i]];
      if (job.out8)
        job.out8[place[i]] = to_byte(c);
      else
        job.out[place[i]] = c;
    }
  }
};

// Draw the sub-pixels of one view in one band.
template <class T>
void CompositeBand(const SortedJob<T>& job, int64_t image, int64_t band, TileLists& lists, SubpixelBatch<T>& batch,
                   Counters& counters) {
  const SubpixelTile& tile = job.lists.tile;
  const int64_t bands = band_count(job.height_px), item = image * bands + band, y0 = band * kBandRows;
  const int64_t tiles = tile.across(job.width_px);
  const int64_t* starts = job.lists.starts + item * tiles;
  if (starts[0] == starts[tiles]) return;
  const Splat<T>* splats = job.splats.splats + image * job.splats.count;
  const T* colours = job.splats.colours + image * job.splats.count * kColourStride;
  const int64_t begin = job.bins.band_offsets[item], end = job.bins.band_offsets[item + 1];
  // The splats lie anywhere in memory. Ask for all at once, rather than wait for one after the other.
  for (int64_t k = begin; k < end; ++k) hwy::Prefetch(splats + job.bins.band_splats[k]);
  ListSplats(job, image, band, tile.width_px, lists);
  counters.intersections += lists.intersections();

  // Tile by tile and batch by batch, splats nearest first
  for (int64_t t = 0; t < tiles; ++t) {
    const int64_t x0 = t * tile.width_px;
    for (int64_t first = starts[t]; first < starts[t + 1]; first += batch.kSamples) {
      batch.load(tile, job.lists.codes + first, int(std::min<int64_t>(batch.kSamples, starts[t + 1] - first)), x0, y0,
                 job.width_px);
      for (const int32_t* id = lists.begin(t); id != lists.end(t) && !batch.patches.closed(); ++id) {
        const Splat<T>& splat = splats[*id];
        const T u = splat.u0 - T(x0), v = splat.v0 - T(y0);
        const int found = batch.patches.find(splat, u, v);
        if (found == 0) continue;
        counters.evaluations += found * batch.kLanes;
        batch.add(SplatTerms<T>(splat, u, v), colours + *id * kColourStride);
      }
      batch.store(job);
    }
  }
}

// The groups of bands by their intersections, most first, the upper of equals first. So the last work items are small,
// and threads end together.
template <class T>
std::vector<int64_t> HeaviestFirst(const SortedJob<T>& job) {
  const int64_t bands = band_count(job.height_px), groups = (bands + kBandsPerItem - 1) / kBandsPerItem;
  std::vector<int64_t> weights(size_t(groups), 0), order(size_t(groups), 0);
  for (int64_t item = 0; item < job.splats.images * bands; ++item)
    weights[size_t(item % bands / kBandsPerItem)] += job.bins.band_offsets[item + 1] - job.bins.band_offsets[item];
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(), [&](int64_t a, int64_t b) {
    const int64_t of_a = weights[size_t(a)], of_b = weights[size_t(b)];
    return of_a != of_b ? of_a > of_b : a < b;
  });
  return order;
}

template <class T>
Counters CompositeSorted(const SortedJob<T>& job) {
  const std::vector<int64_t> groups = HeaviestFirst(job);
  const int64_t views = job.splats.images, bands = band_count(job.height_px);
  // All views of a group of bands before the next, for they write to the same lines of the image
  Counters sum = CompositeItems<SubpixelBatch<T>>(
      int64_t(groups.size()) * views, job.threads,
      [&](int64_t item, TileLists& lists, SubpixelBatch<T>& batch, Counters& counters) {
        const int64_t first = groups[size_t(item / views)] * kBandsPerItem;
        for (int64_t band = first; band < std::min(first + kBandsPerItem, bands); ++band)
          CompositeBand(job, item % views, band, lists, batch, counters);
      });
  sum.scratch_bytes += int64_t(2 * groups.size() * sizeof(int64_t));
  return sum;
}

LFGS_FOR_EVERY_TARGET(CompositeSorted, SortedJob)

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lfgs {
namespace {

LFGS_DISPATCH(CompositeSorted, SortedJob)

}  // namespace

template <class T>
Counters composite_sorted(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const SubpixelLists& lists,
                          const T* background, T* out, uint8_t* out8, int threads) {
  require(lists.tile.height_px() == kBandRows, "on the CPU the tiles of sorted sub-pixels are as high as a band");
  return dispatch(
      SortedJob<T>{splats, bins, lists, cameras.width_px, cameras.height_px, background, out, out8, threads});
}

#define LFGS_INSTANTIATE(T)                                                                                         \
  template Counters composite_sorted(const Splats<T>&, Bins, const Cameras<T>&, const SubpixelLists&, const T*, T*, \
                                     uint8_t*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
#endif
