// A tile of an ordinary image, and the blending of splats into it and back. Images blend r, g, b and depth,
// composite_features.cpp a chunk of the channels of features; kNumbers says how many numbers these are.

#if defined(LFGS_CPU_IMAGE_TILE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_IMAGE_TILE_INL_H_
#undef LFGS_CPU_IMAGE_TILE_INL_H_
#else
#define LFGS_CPU_IMAGE_TILE_INL_H_
#endif

#include <algorithm>
#include <iterator>

#include "cpu/patches-inl.h"
#include "hwy/highway.h"
#include "math/footprint.h"
#include "math/over-inl.h"
#include "stages/stages.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// One tile of 16 x 16 pixels: the state of its samples, a vector per patch, with the numbers that are blended there.
template <class T, int kNumbers>
struct ImageTile {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  static constexpr int kLanes = int(hn::MaxLanes(D()));
  static constexpr int kColumns = kLanes < 4 ? kLanes : 4, kRows = kLanes / kColumns;
  static constexpr int kSide = kBandRows, kAcross = kSide / kColumns;
  static constexpr int kSamples = kSide * kSide, kPatches = kSamples / kLanes;

  alignas(64) T x[kSamples], y[kSamples];  // pixel centres from the tile's corner
  alignas(64) T value[kNumbers][kSamples], transmittance[kSamples], rest[kSamples];
  alignas(64) T gradient[kNumbers][kSamples], total[kSamples], prefix[kSamples];
  Patches<T, kPatches> patches;
  int64_t image, x0, y0;

  ImageTile() {
    for (int i = 0; i < kSamples; ++i) {
      const int patch = i / kLanes, lane = i % kLanes;
      x[i] = T(patch % kAcross * kColumns + lane % kColumns) + T(0.5);
      y[i] = T(patch / kAcross * kRows + lane / kColumns) + T(0.5);
      patches.x[patch] = T(patch % kAcross * kColumns) + T(0.5) * kColumns;
      patches.y[patch] = T(patch / kAcross * kRows) + T(0.5) * kRows;
      patches.half_x[patch] = T(0.5) * T(kColumns - 1), patches.half_y[patch] = T(0.5) * T(kRows - 1);
    }
  }

  void move_to(int64_t image_, int64_t x0_, int64_t y0_) {
    image = image_, x0 = x0_, y0 = y0_;
    patches.reopen(kPatches);
  }
  void begin_forward() {
    for (auto& number : value) std::fill(std::begin(number), std::end(number), T(0));
    std::fill(std::begin(transmittance), std::end(transmittance), T(1));
  }
  void begin_backward() {
    for (auto& number : gradient) std::fill(std::begin(number), std::end(number), T(0));
    for (auto* a : {total, prefix, transmittance}) std::fill(a, a + kSamples, T(0));
  }

  // Call visit(sample, index of its pixel) for the tile's samples inside the image.
  template <class Visit>
  void for_each_pixel(int64_t width, int64_t height, const Visit& visit) const {
    for (int i = 0; i < kSamples; ++i) {
      const int64_t column = x0 + int64_t(x[i]), row = y0 + int64_t(y[i]);
      if (column < width && row < height) visit(i, (image * height + row) * width + column);
    }
  }
};

// A splat as the samples of a tile read it, with the numbers that it blends.
template <class T, int kNumbers>
struct ImageSplat : SplatTerms<T> {
  using typename SplatTerms<T>::V;
  V number[kNumbers];

  HWY_INLINE ImageSplat(const Splat<T>& s, T u, T v) : SplatTerms<T>(s, u, v) {}
};

// Blend a splat into the patches that find() has marked.
template <class T, int kNumbers>
void ForwardSplat(ImageTile<T, kNumbers>& tile, const ImageSplat<T, kNumbers>& s) {
  using Tile = ImageTile<T, kNumbers>;
  using V = typename Tile::V;
  const Tag<T> d;
  tile.patches.for_each_touched([&](int patch) HWY_ATTR {
    const int i = patch * Tile::kLanes;
    V dx, dy;
    const V alpha = Alpha(d, s.power(hn::Load(d, tile.x + i), hn::Load(d, tile.y + i), dx, dy));
    V weight;
    if (HWY_UNLIKELY(Over(d, alpha, tile.transmittance + i, tile.rest + i, weight))) tile.patches.close(patch);
    for (int k = 0; k < kNumbers; ++k)
      hn::Store(hn::MulAdd(weight, s.number[k], hn::Load(d, tile.value[k] + i)), d, tile.value[k] + i);
  });
}

// Add the gradient of an intersection from the pixels of this tile: of the splat to `out`, of the numbers that it
// blends to g_numbers, and with kAbsolute the sums of absolute gradients of its place to g_absolute. math/over-inl.h
// has the formula.
template <bool kAbsolute, class T, int kNumbers>
void BackwardSplat(ImageTile<T, kNumbers>& tile, const ImageSplat<T, kNumbers>& s, const Splat<T>& splat, Splat<T>& out,
                   T* const (&g_numbers)[kNumbers], T* g_absolute = nullptr) {
  using Tile = ImageTile<T, kNumbers>;
  using V = typename Tile::V;
  const Tag<T> d;
  SplatSums<Tag<T>> sums(d);
  V absolute_u = hn::Zero(d), absolute_v = hn::Zero(d);
  V g_number[kNumbers];
  for (auto& g : g_number) g = hn::Zero(d);
  tile.patches.for_each_touched([&](int patch) HWY_ATTR {
    const int i = patch * Tile::kLanes;
    V dx, dy;
    const V power = s.power(hn::Load(d, tile.x + i), hn::Load(d, tile.y + i), dx, dy);
    V alpha = Alpha(d, power);
    V before;
    if (HWY_UNLIKELY(hn::AllTrue(d, OverAgain(d, alpha, tile.transmittance + i, before)))) tile.patches.close(patch);

    // Gradients of the numbers, then of alpha and the exponent
    const V weight = hn::Mul(alpha, before);
    V v = hn::Zero(d);
    for (int k = 0; k < kNumbers; ++k) {
      const V g = hn::Load(d, tile.gradient[k] + i);
      v = hn::MulAdd(g, s.number[k], v);
      g_number[k] = hn::MulAdd(g, weight, g_number[k]);
    }
    const V g_alpha = OverBackward<true>(d, alpha, before, weight, v, tile.total + i, tile.prefix + i);
    const auto free = hn::And(hn::Gt(alpha, hn::Zero(d)), hn::Lt(power, hn::Set(d, T(kLog2MaxAlpha))));
    const V g = ExponentBackward(d, g_alpha, alpha, free), e = hn::Mul(dx, s.inverse_S);
    sums.Add(g, dy, e);
    if constexpr (kAbsolute) {
      const V twice = hn::Add(g, g), g_u = hn::Mul(twice, e);
      const V g_v = hn::NegMulAdd(hn::Set(d, splat.c0), g_u, hn::Mul(hn::Set(d, splat.tau), hn::Mul(twice, dy)));
      absolute_u = hn::Add(absolute_u, hn::Abs(g_u)), absolute_v = hn::Add(absolute_v, hn::Abs(g_v));
    }
  });

  // Sums over the lanes
  sums.Reduce(d, splat, out);
  for (int k = 0; k < kNumbers; ++k) *g_numbers[k] += hn::GetLane(hn::SumOfLanes(d, g_number[k]));
  if constexpr (kAbsolute) {
    g_absolute[0] += hn::GetLane(hn::SumOfLanes(d, absolute_u));
    g_absolute[1] += hn::GetLane(hn::SumOfLanes(d, absolute_v));
  }
}

// Go over the tiles of one band of one image, and over the splats of each, nearest first, while the tile has open
// patches. begin() starts the tile; visit(splat, index of the splat, u, v) takes a splat that may touch it, (u, v) from
// the tile's corner; finish() ends it. A work item is a band of an image.
template <class Job, class Tile, class Begin, class Visit, class Finish>
HWY_INLINE void ForEachTile(const Job& job, int64_t item, TileLists& lists, Tile& tile, Counters& counters,
                            const Begin& begin, const Visit& visit, const Finish& finish) {
  const auto* all = job.splats.splats;
  using T = decltype(all->u0);
  const int64_t bands = band_count(job.height_px), image = item / bands, band = item % bands, y0 = band * kBandRows;
  const int64_t tiles = (job.width_px + Tile::kSide - 1) / Tile::kSide;
  ListSplats(job, image, band, Tile::kSide, lists);
  counters.intersections += lists.intersections();
  for (int64_t t = 0; t < tiles; ++t) {
    tile.move_to(image, t * Tile::kSide, y0);
    begin();
    for (const int32_t* id = lists.begin(t); id != lists.end(t) && !tile.patches.closed(); ++id) {
      const int64_t index = image * job.splats.count + *id;
      const Splat<T>& splat = all[index];
      const T u = splat.u0 - T(tile.x0), v = splat.v0 - T(y0);
      const int found = tile.patches.find(splat, u, v);
      if (found == 0) continue;
      counters.evaluations += found * Tile::kLanes;
      visit(splat, index, u, v);
    }
    finish();
  }
}

// The number of the intersection of a splat and a band: those of a splat are numbered by its bands.
template <class Job, class T>
HWY_INLINE int64_t IntersectionOf(const Job& job, int64_t item, const Splat<T>& splat, int64_t index) {
  const int64_t band = item % band_count(job.height_px);
  return job.first_intersection[index] + band - footprint_rows(splat, job.height_px).first / kBandRows;
}

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_IMAGE_TILE_INL_H_
