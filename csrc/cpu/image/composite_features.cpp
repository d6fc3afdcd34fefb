// Composite of the features of Gaussians in ordinary images, its backward pass, and the median depth. Weights are those
// of composite_images, bit for bit. Each pass blends a chunk of channels, so that tiles stay in the cache whatever the
// number of channels; it lists and evaluates the splats anew.
#include <algorithm>
#include <vector>

#include "cpu/dispatch.h"
#include "cpu/gaussian_io.h"
#include "stages/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/image/composite_features.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"
#include "cpu/image/image_tile-inl.h"

#ifndef LFGS_COMPOSITE_FEATURES_ONCE
#define LFGS_COMPOSITE_FEATURES_ONCE
namespace lfgs {
// One pass: the channels from `first` on, of which `used` are there; or the median depth.
enum class FeaturesPass { kForward, kBackward, kMedianDepth };
template <class T>
struct FeaturesJob {
  FeaturesPass pass;
  Splats<T> splats;
  Bins bins;
  int64_t width_px, height_px;
  Features<T> features;
  int64_t first, used;
  T* out;  // [I, H, W, D], or the median depth [I, H, W]
  const int64_t* first_intersection;
  T* intersection_gradients;  // [intersections, kSplatFields + kFeatureChunk]
  int threads;
};
constexpr int kFeatureGradient = kSplatFields + kFeatureChunk;
}  // namespace lfgs
#endif

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// A splat's channels of this pass, and zeros up to the width of a chunk.
template <class T, int kNumbers>
HWY_INLINE void LoadChannels(const FeaturesJob<T>& job, int64_t image, int64_t splat, ImageSplat<T, kNumbers>& s) {
  const Tag<T> d;
  const T* row = job.features.row(image, job.splats.count, splat) + job.first;
  for (int k = 0; k < kNumbers; ++k) s.number[k] = hn::Set(d, k < job.used ? row[k] : T(0));
}

// Load the gradients of the image at every sample, and the total (math/over-inl.h).
template <class T, int kNumbers>
void BeginChannelsBackward(const FeaturesJob<T>& job, ImageTile<T, kNumbers>& tile) {
  tile.begin_backward();
  tile.for_each_pixel(job.width_px, job.height_px, [&](int i, int64_t pixel) {
    const int64_t at = pixel * job.features.channels + job.first;
    T total = 0;
    for (int64_t k = 0; k < job.used; ++k) {
      const T g = tile.gradient[k][i] = job.features.image_gradient[at + k];
      total += g * job.features.image[at + k];
    }
    tile.total[i] = total;
    tile.transmittance[i] = 1;
  });
}

// One band of one image in one pass.
template <class T, int kNumbers>
void CompositeChannels(const FeaturesJob<T>& job, int64_t item, TileLists& lists, ImageTile<T, kNumbers>& tile,
                       Counters& counters) {
  const bool backward = job.pass == FeaturesPass::kBackward;
  const auto begin = [&] { backward ? BeginChannelsBackward(job, tile) : tile.begin_forward(); };
  const auto visit = [&](const Splat<T>& splat, int64_t index, T u, T v) HWY_ATTR {
    ImageSplat<T, kNumbers> s(splat, u, v);
    LoadChannels(job, tile.image, index - tile.image * job.splats.count, s);
    if (!backward) {
      ForwardSplat(tile, s);
      return;
    }
    const IntersectionGradient<T> out{job.intersection_gradients +
                                      IntersectionOf(job, item, splat, index) * kFeatureGradient};
    T* g_numbers[kNumbers];
    for (int k = 0; k < kNumbers; ++k) g_numbers[k] = out.colours() + k;
    BackwardSplat<false>(tile, s, splat, out.splat(), g_numbers);
  };
  ForEachTile(job, item, lists, tile, counters, begin, visit, [&] {
    if (backward) return;
    tile.for_each_pixel(job.width_px, job.height_px, [&](int i, int64_t pixel) {
      T* out = job.out + pixel * job.features.channels + job.first;
      for (int64_t k = 0; k < job.used; ++k) out[k] = tile.value[k][i];
    });
  });
}

// Take the depth of a splat where more than half of the light reaches it, and it adds some to the pixel.
template <class T>
void MedianSplat(ImageTile<T, 1>& tile, const ImageSplat<T, 1>& s) {
  using Tile = ImageTile<T, 1>;
  const Tag<T> d;
  const auto half = hn::Set(d, T(0.5));
  tile.patches.for_each_touched([&](int patch) HWY_ATTR {
    const int i = patch * Tile::kLanes;
    typename Tile::V dx, dy, weight;
    const auto alpha = Alpha(d, s.power(hn::Load(d, tile.x + i), hn::Load(d, tile.y + i), dx, dy));
    const auto before = hn::Load(d, tile.transmittance + i);
    Over(d, alpha, tile.transmittance + i, tile.rest + i, weight);
    const auto taken = hn::And(hn::Gt(before, half), hn::Gt(weight, hn::Zero(d)));
    hn::Store(hn::IfThenElse(taken, s.number[0], hn::Load(d, tile.value[0] + i)), d, tile.value[0] + i);
    if (hn::AllTrue(d, hn::Le(hn::Load(d, tile.transmittance + i), half))) tile.patches.close(patch);
  });
}

template <class T>
void CompositeMedian(const FeaturesJob<T>& job, int64_t item, TileLists& lists, ImageTile<T, 1>& tile,
                     Counters& counters) {
  const auto visit = [&](const Splat<T>& splat, int64_t, T u, T v) HWY_ATTR {
    ImageSplat<T, 1> s(splat, u, v);
    s.number[0] = hn::Set(Tag<T>(), splat.depth);
    MedianSplat(tile, s);
  };
  ForEachTile(
      job, item, lists, tile, counters, [&] { tile.begin_forward(); }, visit,
      [&] {
        tile.for_each_pixel(job.width_px, job.height_px,
                            [&](int i, int64_t pixel) { job.out[pixel] = tile.value[0][i]; });
      });
}

template <class T>
Counters CompositeFeatures(const FeaturesJob<T>& job) {
  const int64_t items = job.splats.images * band_count(job.height_px);
  if (job.pass == FeaturesPass::kMedianDepth)
    return CompositeItems<ImageTile<T, 1>>(items, job.threads, [&](int64_t item, auto& lists, auto& tile, auto& count) {
      CompositeMedian(job, item, lists, tile, count);
    });
  const auto draw = [&](int64_t item, auto& lists, auto& tile, auto& counters) {
    CompositeChannels(job, item, lists, tile, counters);
  };
  if (job.used <= 4) return CompositeItems<ImageTile<T, 4>>(items, job.threads, draw);
  return CompositeItems<ImageTile<T, kFeatureChunk>>(items, job.threads, draw);
}

LFGS_FOR_EVERY_TARGET(CompositeFeatures, FeaturesJob)

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lfgs {
namespace {

LFGS_DISPATCH(CompositeFeatures, FeaturesJob)

template <class T>
FeaturesJob<T> job_of(FeaturesPass pass, const Splats<T>& splats, Bins bins, int64_t width_px, int64_t height_px,
                      int threads) {
  FeaturesJob<T> job{};
  job.pass = pass, job.splats = splats, job.bins = bins, job.threads = threads;
  job.width_px = width_px, job.height_px = height_px;
  return job;
}

// Sum up the intersections of each splat after one pass: add to the splat's sums, and write its channels' gradients.
template <class T>
void sum_channels(const FeaturesJob<T>& job, T* sums, T* g_features) {
  const int64_t all = job.splats.images * job.splats.count;
  parallel_for((all + kGrain - 1) / kGrain, job.threads, [&](int64_t item, int) {
    double sum[kFeatureGradient];
    T of_pass[kSplatSums];
    for (int64_t i = item * kGrain; i < std::min(all, (item + 1) * kGrain); ++i) {
      sum_intersections(job.splats.splats[i], job.height_px, job.first_intersection[i], kFeatureGradient,
                        job.intersection_gradients, sum);
      const IntersectionGradient<double> gradient{sum};
      write_sums(gradient, false, of_pass);
      for (int k = 0; k < kDepthSum; ++k) {
        T& total = sums[i * kSplatSums + k];
        total = saturated<T>(double(total) + double(of_pass[k]));
      }
      T* out = g_features + i * job.features.channels + job.first;
      for (int64_t k = 0; k < job.used; ++k) out[k] = saturated<T>(gradient.colours()[k]);
    }
  });
}

}  // namespace

template <class T>
Counters composite_features(const Splats<T>& splats, Bins bins, int64_t width_px, int64_t height_px,
                            const Features<T>& features, T* out, int threads) {
  FeaturesJob<T> job = job_of(FeaturesPass::kForward, splats, bins, width_px, height_px, threads);
  job.features = features, job.out = out;
  Counters counters;
  for (; job.first < features.channels; job.first += kFeatureChunk) {
    job.used = std::min<int64_t>(kFeatureChunk, features.channels - job.first);
    counters += dispatch(job);
  }
  return counters;
}

template <class T>
Counters composite_median_depth(const Splats<T>& splats, Bins bins, int64_t width_px, int64_t height_px, T* out,
                                int threads) {
  FeaturesJob<T> job = job_of(FeaturesPass::kMedianDepth, splats, bins, width_px, height_px, threads);
  job.out = out;
  return dispatch(job);
}

template <class T>
Counters composite_features_backward(const Splats<T>& splats, Bins bins, int64_t width_px, int64_t height_px,
                                     const Features<T>& features, int64_t intersections,
                                     const int64_t* first_intersection, T* intersection_gradients, T* sums,
                                     T* g_features, int threads) {
  FeaturesJob<T> job = job_of(FeaturesPass::kBackward, splats, bins, width_px, height_px, threads);
  job.features = features;
  job.first_intersection = first_intersection, job.intersection_gradients = intersection_gradients;
  std::fill_n(sums, splats.images * splats.count * kSplatSums, T(0));
  Counters counters;
  for (; job.first < features.channels; job.first += kFeatureChunk) {
    job.used = std::min<int64_t>(kFeatureChunk, features.channels - job.first);
    std::fill_n(intersection_gradients, intersections * kFeatureGradient, T(0));
    counters += dispatch(job);
    sum_channels(job, sums, g_features);
  }
  return counters;
}

#define LFGS_INSTANTIATE(T)                                                                                            \
  template Counters composite_features(const Splats<T>&, Bins, int64_t, int64_t, const Features<T>&, T*, int);         \
  template Counters composite_median_depth(const Splats<T>&, Bins, int64_t, int64_t, T*, int);                         \
  template Counters composite_features_backward(const Splats<T>&, Bins, int64_t, int64_t, const Features<T>&, int64_t, \
                                                const int64_t*, T*, T*, T*, int);
LFGS_INSTANTIATE(float)
LFGS_INSTANTIATE(double)

}  // namespace lfgs
#endif
