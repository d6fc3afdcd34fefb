// Stage composite for ordinary images, and its backward pass. It reads splats and their lists by band, and writes
// colour, alpha and depth. The backward pass writes the gradients of intersections and of the background. A work item
// is one band of one image. A band has tiles, and a tile has patches of one vector each (4 columns, as many rows as
// fit). Splats are blended into a tile nearest first.
#include <algorithm>
#include <iterator>

#include "cpu/dispatch.h"
#include "stages/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/image/composite_images.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"
#include "cpu/patches-inl.h"
#include "math/over-inl.h"

#ifndef LFGS_COMPOSITE_IMAGES_ONCE
#define LFGS_COMPOSITE_IMAGES_ONCE
namespace lfgs {
// Inputs of both directions; the backward pass also reads the output of the forward pass.
template <class T>
struct ImagesJob {
  Splats<T> splats;
  Bins bins;
  int64_t width_px, height_px;
  const T* background;  // [I, 3]
  Images<T> out;
  Images<const T> images, gradients;
  const int64_t* first_intersection;
  T *intersection_gradients, *band_background;
  bool absolute;  // the backward pass also sums up absolute gradients of the splats' places
  bool backward;  // the direction; intersection_gradients cannot tell, for it is also null where no splat is drawn
  int threads;
};
}  // namespace lfgs
#endif

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// One tile of 16 x 16 pixels: the state of its samples, a vector per patch.
template <class T>
struct ImageTile {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  static constexpr int kLanes = int(hn::MaxLanes(D()));
  static constexpr int kColumns = kLanes < 4 ? kLanes : 4, kRows = kLanes / kColumns;
  static constexpr int kSide = kBandRows, kAcross = kSide / kColumns;
  static constexpr int kSamples = kSide * kSide, kPatches = kSamples / kLanes;

  alignas(64) T x[kSamples], y[kSamples];                                     // pixel centres from the tile's corner
  alignas(64) T value[4][kSamples], transmittance[kSamples], rest[kSamples];  // r, g, b, depth
  alignas(64) T gradient[4][kSamples], total[kSamples], prefix[kSamples];
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

  // Call visit(sample, index of its pixel) for the tile's samples inside the image.
  template <class Visit>
  void for_each_pixel(int64_t width, int64_t height, const Visit& visit) const {
    for (int i = 0; i < kSamples; ++i) {
      const int64_t column = x0 + int64_t(x[i]), row = y0 + int64_t(y[i]);
      if (column < width && row < height) visit(i, (image * height + row) * width + column);
    }
  }
};

// A splat as the samples of a tile read it.
template <class T>
struct ImageSplat : SplatTerms<T> {
  using typename SplatTerms<T>::V;
  V channel[4];  // r, g, b, depth

  HWY_INLINE ImageSplat(const Splat<T>& s, const T* colour, T u, T v) : SplatTerms<T>(s, u, v) {
    const Tag<T> d;
    channel[0] = hn::Set(d, colour[0]), channel[1] = hn::Set(d, colour[1]), channel[2] = hn::Set(d, colour[2]);
    channel[3] = hn::Set(d, s.depth);
  }
};

// Blend a splat into the patches that find() has marked.
template <class T>
void ForwardSplat(ImageTile<T>& tile, const ImageSplat<T>& s) {
  using Tile = ImageTile<T>;
  using V = typename Tile::V;
  const Tag<T> d;
  tile.patches.for_each_touched([&](int patch) HWY_ATTR {
    const int i = patch * Tile::kLanes;
    V dx, dy;
    const V alpha = Alpha(d, s.power(hn::Load(d, tile.x + i), hn::Load(d, tile.y + i), dx, dy));
    V weight;
    if (HWY_UNLIKELY(Over(d, alpha, tile.transmittance + i, tile.rest + i, weight))) tile.patches.close(patch);
    for (int k = 0; k < 4; ++k)
      hn::Store(hn::MulAdd(weight, s.channel[k], hn::Load(d, tile.value[k] + i)), d, tile.value[k] + i);
  });
}

// Add to `out` the gradient of an intersection, from the pixels of this tile. math/over-inl.h has the formula.
template <bool kAbsolute, class T>
void BackwardSplat(ImageTile<T>& tile, const ImageSplat<T>& s, const Splat<T>& splat,
                   const IntersectionGradient<T>& out) {
  using Tile = ImageTile<T>;
  using V = typename Tile::V;
  const Tag<T> d;
  SplatSums<Tag<T>> sums(d);
  V absolute_u = hn::Zero(d), absolute_v = hn::Zero(d);
  V g_channel[4] = {hn::Zero(d), hn::Zero(d), hn::Zero(d), hn::Zero(d)};
  tile.patches.for_each_touched([&](int patch) HWY_ATTR {
    const int i = patch * Tile::kLanes;
    V dx, dy;
    const V power = s.power(hn::Load(d, tile.x + i), hn::Load(d, tile.y + i), dx, dy);
    V alpha = Alpha(d, power);
    V before;
    if (HWY_UNLIKELY(hn::AllTrue(d, OverAgain(d, alpha, tile.transmittance + i, before)))) tile.patches.close(patch);

    // Gradients of colours and depth, then of alpha and the exponent
    const V weight = hn::Mul(alpha, before);
    V v = hn::Zero(d);
    for (int k = 0; k < 4; ++k) {
      const V g = hn::Load(d, tile.gradient[k] + i);
      v = hn::MulAdd(g, s.channel[k], v);
      g_channel[k] = hn::MulAdd(g, weight, g_channel[k]);
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
  sums.Reduce(d, splat, out.splat());
  out.splat().depth += hn::GetLane(hn::SumOfLanes(d, g_channel[3]));
  for (int k = 0; k < 3; ++k) out.colours()[k] += hn::GetLane(hn::SumOfLanes(d, g_channel[k]));
  if constexpr (kAbsolute) {
    out.absolute()[0] += hn::GetLane(hn::SumOfLanes(d, absolute_u));
    out.absolute()[1] += hn::GetLane(hn::SumOfLanes(d, absolute_v));
  }
}

template <class T>
void BeginForward(ImageTile<T>& tile) {
  for (auto& channel : tile.value) std::fill(std::begin(channel), std::end(channel), T(0));
  std::fill(std::begin(tile.transmittance), std::end(tile.transmittance), T(1));
}

// Add the background and write colour, alpha and depth.
template <class T>
void FinishForward(const ImagesJob<T>& job, const ImageTile<T>& tile) {
  const T* background = job.background + 3 * tile.image;
  tile.for_each_pixel(job.width_px, job.height_px, [&](int i, int64_t pixel) {
    const T rest = tile.transmittance[i] > 0 ? tile.transmittance[i] : tile.rest[i];
    for (int k = 0; k < 3; ++k) job.out.image[3 * pixel + k] = tile.value[k][i] + rest * background[k];
    job.out.alpha[pixel] = 1 - rest;
    job.out.depth[pixel] = tile.value[3][i];
  });
}

// Load the inputs of the backward pass at every sample: the gradients of colour and depth, and the total
// (math/over-inl.h). Add the gradient of the background to g_background.
template <class T>
void BeginBackward(const ImagesJob<T>& job, ImageTile<T>& tile, T* g_background) {
  for (auto& channel : tile.gradient) std::fill(std::begin(channel), std::end(channel), T(0));
  for (auto* a : {tile.total, tile.prefix, tile.transmittance}) std::fill(a, a + tile.kSamples, T(0));
  tile.for_each_pixel(job.width_px, job.height_px, [&](int i, int64_t pixel) {
    const T rest = 1 - job.images.alpha[pixel];
    tile.gradient[3][i] = job.gradients.depth ? job.gradients.depth[pixel] : T(0);
    const T g_alpha = job.gradients.alpha ? job.gradients.alpha[pixel] : T(0);
    T total = tile.gradient[3][i] * job.images.depth[pixel] - g_alpha * rest;
    for (int k = 0; k < 3; ++k) {
      const T g = tile.gradient[k][i] = job.gradients.image[3 * pixel + k];
      total += g * job.images.image[3 * pixel + k];
      g_background[k] += g * rest;
    }
    tile.total[i] = total;
    tile.transmittance[i] = 1;
  });
}

// Draw one band of one image, or take its gradients, tile by tile.
template <class T>
void CompositeBand(const ImagesJob<T>& job, int64_t item, TileLists& lists, ImageTile<T>& tile, Counters& counters) {
  using Tile = ImageTile<T>;
  const int64_t bands = band_count(job.height_px), image = item / bands, band = item % bands, y0 = band * kBandRows;
  const int64_t tiles = (job.width_px + Tile::kSide - 1) / Tile::kSide;
  const Splat<T>* splats = job.splats.splats + image * job.splats.count;
  ListSplats(job, image, band, Tile::kSide, lists);
  counters.intersections += lists.intersections();

  // Tile by tile, splats nearest first
  for (int64_t t = 0; t < tiles; ++t) {
    tile.move_to(image, t * Tile::kSide, y0);
    if (job.backward)
      BeginBackward(job, tile, job.band_background + 3 * item);
    else
      BeginForward(tile);
    for (const int32_t* id = lists.begin(t); id != lists.end(t) && !tile.patches.closed(); ++id) {
      const Splat<T>& splat = splats[*id];
      const T u = splat.u0 - T(tile.x0), v = splat.v0 - T(y0);
      const int found = tile.patches.find(splat, u, v);
      if (found == 0) continue;
      counters.evaluations += found * Tile::kLanes;
      const int64_t index = image * job.splats.count + *id;
      const ImageSplat<T> s(splat, job.splats.colours + index * kColourStride, u, v);
      if (!job.backward) {
        ForwardSplat(tile, s);
        continue;
      }

      // The gradient of this intersection: intersections of a splat are numbered by its bands
      const int64_t own_band = band - footprint_rows(splat, job.height_px).first / kBandRows;
      const int64_t intersection = job.first_intersection[index] + own_band;
      const IntersectionGradient<T> out{job.intersection_gradients +
                                        intersection * image_intersection_gradient_size(job.absolute)};
      if (job.absolute)
        BackwardSplat<true>(tile, s, splat, out);
      else
        BackwardSplat<false>(tile, s, splat, out);
    }
    if (!job.backward) FinishForward(job, tile);
  }
}

template <class T>
Counters CompositeImages(const ImagesJob<T>& job) {
  return CompositeItems<ImageTile<T>>(job.splats.images * band_count(job.height_px), job.threads,
                                      [&](int64_t item, TileLists& lists, ImageTile<T>& tile, Counters& counters) {
                                        CompositeBand(job, item, lists, tile, counters);
                                      });
}

LFGS_FOR_EVERY_TARGET(CompositeImages, ImagesJob)

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lfgs {
namespace {

LFGS_DISPATCH(CompositeImages, ImagesJob)

}  // namespace

template <class T>
Counters composite_images(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const T* background,
                          Images<T> out, int threads) {
  ImagesJob<T> job{};
  job.splats = splats, job.bins = bins, job.background = background, job.out = out, job.threads = threads;
  job.width_px = cameras.width_px, job.height_px = cameras.height_px;
  return dispatch(job);
}

template <class T>
Counters composite_images_backward(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const T* background,
                                   Images<const T> images, Images<const T> gradients, bool absolute,
                                   const int64_t* first_intersection, T* intersection_gradients, T* band_background,
                                   int threads) {
  ImagesJob<T> job{};
  job.splats = splats, job.bins = bins, job.background = background, job.threads = threads;
  job.images = images, job.gradients = gradients, job.absolute = absolute, job.first_intersection = first_intersection;
  job.intersection_gradients = intersection_gradients, job.band_background = band_background, job.backward = true;
  job.width_px = cameras.width_px, job.height_px = cameras.height_px;
  return dispatch(job);
}

#define LFGS_INSTANTIATE(T)                                                                                         \
  template Counters composite_images(const Splats<T>&, Bins, const Cameras<T>&, const T*, Images<T>, int);          \
  template Counters composite_images_backward(const Splats<T>&, Bins, const Cameras<T>&, const T*, Images<const T>, \
                                              Images<const T>, bool, const int64_t*, T*, T*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
#endif
