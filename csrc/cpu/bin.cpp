// Stages order and bin. Stage order sorts the drawn splats of each image nearest first, ties by index; it writes their
// indices and their number. Stage bin lists for every band the splats whose rows touch it, nearest first: it reads
// splats and their order, and writes Bins. It also numbers the intersections for the backward pass.
#include <algorithm>
#include <array>
#include <bit>
#include <type_traits>
#include <vector>

#include "base/parallel.h"
#include "math/footprint.h"
#include "stages/stages.h"

namespace lfgs {
namespace {

template <class T>
using Bits = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;

// Stable radix sort of (key, index), from the lowest digit up. Depths are positive, so their bits sort like the
// numbers.
template <class Key>
void radix_sort(std::vector<std::pair<Key, int32_t>>& items) {
  constexpr int kBits = 11, kBuckets = 1 << kBits;
  std::vector<std::pair<Key, int32_t>> other(items.size());
  for (unsigned shift = 0; shift < 8 * sizeof(Key); shift += kBits) {
    std::array<size_t, kBuckets + 1> start{};
    for (auto& item : items) ++start[(item.first >> shift & (kBuckets - 1)) + 1];
    for (int b = 0; b < kBuckets; ++b) start[b + 1] += start[b];
    for (auto& item : items) other[start[item.first >> shift & (kBuckets - 1)]++] = item;
    items.swap(other);
  }
}

// The bands that a splat touches; none where last < first.
struct Bands {
  int32_t first, last;
};

template <class T>
Bands splat_bands(const Splat<T>& splat, int64_t height_px) {
  Range rows = footprint_rows(splat, height_px);
  if (rows.last < rows.first) return {0, -1};
  return {int32_t(rows.first / kBandRows), int32_t(rows.last / kBandRows)};
}

// Work items: every image, cut into as many groups of bands as there are threads. Each group reads the whole order,
// which is cheap, and so needs no second pass to keep the lists sorted.
template <class T, class Visit>
void for_each_band(const Splats<T>& splats, const int32_t* order, const int64_t* drawn, int64_t height_px, int threads,
                   const Visit& visit) {
  const int64_t bands = band_count(height_px);
  const int64_t groups = splats.images >= threads ? 1 : std::min<int64_t>(threads, bands);
  parallel_for(splats.images * groups, threads, [&](int64_t item, int) {
    const int64_t image = item / groups, group = item % groups;
    const int64_t begin = bands * group / groups, end = bands * (group + 1) / groups;
    const Splat<T>* s = splats.splats + image * splats.count;
    const int32_t* sorted = order + image * splats.count;

    // First the bands of every splat, in the order of memory, so that the walk by depth reads only a few bytes of each
    std::vector<Bands> ranges(size_t(splats.count));
    for (int64_t i = 0; i < splats.count; ++i) {
      const Bands b = splat_bands(s[i], height_px);
      ranges[size_t(i)] = {std::max(b.first, int32_t(begin)), std::min(b.last, int32_t(end - 1))};
    }
    for (int64_t k = 0; k < drawn[image]; ++k) {
      const Bands b = ranges[size_t(sorted[k])];
      for (int64_t band = b.first; band <= b.last; ++band) visit(image * bands + band, sorted[k]);
    }
  });
}

}  // namespace

template <class T>
void order(const Splats<T>& splats, int32_t* order, int64_t* drawn, int threads) {
  parallel_for(splats.images, threads, [&](int64_t image, int) {
    const Splat<T>* s = splats.splats + image * splats.count;
    std::vector<std::pair<Bits<T>, int32_t>> items;
    items.reserve(size_t(splats.count));
    for (int64_t i = 0; i < splats.count; ++i)
      if (s[i].reach_y >= 0) items.emplace_back(std::bit_cast<Bits<T>>(s[i].depth), int32_t(i));
    radix_sort(items);
    int32_t* out = order + image * splats.count;
    for (size_t k = 0; k < items.size(); ++k) out[k] = items[k].second;
    drawn[image] = int64_t(items.size());
  });
}

template void order(const Splats<float>&, int32_t*, int64_t*, int);
template void order(const Splats<double>&, int32_t*, int64_t*, int);

template <class T>
int64_t bin_count(const Splats<T>& splats, const int32_t* order, const int64_t* drawn, int64_t height_px, Bins bins,
                  int threads) {
  const int64_t total = splats.images * band_count(height_px);
  std::fill(bins.band_offsets, bins.band_offsets + total + 1, 0);
  for_each_band(splats, order, drawn, height_px, threads,
                [&](int64_t band, int32_t) { ++bins.band_offsets[band + 1]; });
  for (int64_t band = 0; band < total; ++band) bins.band_offsets[band + 1] += bins.band_offsets[band];
  return bins.band_offsets[total];
}

template <class T>
void bin_fill(const Splats<T>& splats, const int32_t* order, const int64_t* drawn, int64_t height_px, Bins bins,
              int threads) {
  const int64_t total = splats.images * band_count(height_px);
  std::vector<int64_t> next(bins.band_offsets, bins.band_offsets + total);
  for_each_band(splats, order, drawn, height_px, threads,
                [&](int64_t band, int32_t splat) { bins.band_splats[next[band]++] = splat; });
}

template <class T>
void first_intersections(const Splats<T>& splats, int64_t height_px, Bins bins, int64_t* first_intersection,
                         int threads) {
  const int64_t bands = band_count(height_px);
  parallel_for(splats.images, threads, [&](int64_t image, int) {
    int64_t next = bins.band_offsets[image * bands];
    for (int64_t i = image * splats.count; i < (image + 1) * splats.count; ++i) {
      const Bands b = splat_bands(splats.splats[i], height_px);
      first_intersection[i] = next;
      next += b.last - b.first + 1;
    }
  });
}

#define LFGS_INSTANTIATE(T)                                                                         \
  template int64_t bin_count(const Splats<T>&, const int32_t*, const int64_t*, int64_t, Bins, int); \
  template void bin_fill(const Splats<T>&, const int32_t*, const int64_t*, int64_t, Bins, int);     \
  template void first_intersections(const Splats<T>&, int64_t, Bins, int64_t*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
