// Stage composite for ordinary images, and its backward pass. It reads splats and their lists by band, and writes
// colour, alpha and depth. The backward pass writes the gradients of intersections and of the background. A work item
// is one band of one image. A band has tiles, and a tile has patches of one vector each (4 columns, as many rows as
// fit). Splats are blended into a tile nearest first.
#include "cpu/dispatch.h"
#include "stages/stages.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "cpu/image/composite_images.cpp"
#include "hwy/foreach_target.h"  // IWYU pragma: keep
#include "hwy/highway.h"
#include "cpu/image/image_tile-inl.h"

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

constexpr int kColourNumbers = 4;  // r, g, b, depth
template <class T>
using ColourTile = ImageTile<T, kColourNumbers>;

// Add the background and write colour, alpha and depth.
template <class T>
void FinishForward(const ImagesJob<T>& job, const ColourTile<T>& tile) {
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
void BeginBackward(const ImagesJob<T>& job, ColourTile<T>& tile, T* g_background) {
  tile.begin_backward();
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
void CompositeBand(const ImagesJob<T>& job, int64_t item, TileLists& lists, ColourTile<T>& tile, Counters& counters) {
  const auto begin = [&] {
    if (job.backward)
      BeginBackward(job, tile, job.band_background + 3 * item);
    else
      tile.begin_forward();
  };
  const auto visit = [&](const Splat<T>& splat, int64_t index, T u, T v) HWY_ATTR {
    const Tag<T> d;
    ImageSplat<T, kColourNumbers> s(splat, u, v);
    for (int k = 0; k < 3; ++k) s.number[k] = hn::Set(d, job.splats.colours[index * kColourStride + k]);
    s.number[3] = hn::Set(d, splat.depth);
    if (!job.backward) {
      ForwardSplat(tile, s);
      return;
    }
    const IntersectionGradient<T> out{job.intersection_gradients + IntersectionOf(job, item, splat, index) *
                                                                       image_intersection_gradient_size(job.absolute)};
    T* const g_numbers[] = {out.colours(), out.colours() + 1, out.colours() + 2, &out.splat().depth};
    if (job.absolute)
      BackwardSplat<true>(tile, s, splat, out.splat(), g_numbers, out.absolute());
    else
      BackwardSplat<false>(tile, s, splat, out.splat(), g_numbers);
  };
  ForEachTile(job, item, lists, tile, counters, begin, visit, [&] {
    if (!job.backward) FinishForward(job, tile);
  });
}

template <class T>
Counters CompositeImages(const ImagesJob<T>& job) {
  return CompositeItems<ColourTile<T>>(job.splats.images * band_count(job.height_px), job.threads,
                                       [&](int64_t item, TileLists& lists, ColourTile<T>& tile, Counters& counters) {
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
