// The stages of the rasterizer and their backward passes. Every buffer belongs to the caller; T is float or double.
//
//   Gaussians + cameras -> project -> order -> bin -> composite -> image, and back.
//
// An *image* is the picture of one camera (ordinary images, `sorted`), or of the whole panel (`direct`). It is cut into
// bands of kBandRows rows. An *intersection* is a band and a splat that may touch it. Layouts are row-major; there are
// N Gaussians and I images.
#pragma once

#include <cstdint>

#include "math/compensation.h"
#include "math/gradient_sums.h"
#include "math/projection.h"
#include "math/quality.h"
#include "scene/gaussians.h"
#include "scene/lens.h"
#include "scene/subpixels.h"
#include "scene/camera.h"

namespace lfgs {

constexpr int kBandRows = 16;
constexpr int kColourStride = 4;  // r, g, b and padding, since a vector look-up reads four numbers

inline int64_t band_count(int64_t height_px) { return (height_px + kBandRows - 1) / kBandRows; }

// How many numbers the gradient of an intersection has, see IntersectionGradient.
inline int intersection_gradient_size(int colour_order, bool compensated = false) {
  return kSplatFields + 3 * (colour_order + 1) + (compensated ? kCompensationFields : 0);
}
// The same for ordinary images. absolute: with the sums over samples of |gradient| of u0 and of v0 behind the others
// (Ye et al., "AbsGS", 2024).
inline int image_intersection_gradient_size(bool absolute) {
  return intersection_gradient_size(0) + (absolute ? 2 : 0);
}

// The gradient of an intersection, or a sum over intersections. It holds the gradients of a splat from a band's
// samples: of the splat's numbers, its colours by power of s and, on a panel, its compensation.
template <class T>
struct IntersectionGradient {
  T* numbers;
  int colour_order = 0;

  Splat<T>& splat() const { return *reinterpret_cast<Splat<T>*>(numbers); }
  T* colours() const { return numbers + kSplatFields; }  // [order + 1, 3]
  T* absolute() const { return numbers + intersection_gradient_size(0); }
  Compensation<T>& compensation() const {
    return *reinterpret_cast<Compensation<T>*>(colours() + 3 * (colour_order + 1));
  }
};
static_assert(sizeof(Splat<float>) == kSplatFields * sizeof(float));
static_assert(sizeof(Compensation<float>) == kCompensationFields * sizeof(float));

// The counts of composite, for statistics.
struct Counters {
  int64_t intersections = 0;  // (tile, splat)
  int64_t evaluations = 0;    // samples at which a splat was evaluated, with the lanes that it missed
  int64_t scratch_bytes = 0;
  // Of `direct` only. Tiles drawn splat by splat, tiles without splats, samples that stopped before the last splat, and
  // tiles drawn from lattices. Lattices that fitted, lattices whose run was halved, and runs without any that fits.
  int64_t tiles = 0, empty_tiles = 0, stopped_samples = 0, lattice_tiles = 0;
  int64_t lattices = 0, split_lattices = 0, refused_lattices = 0;

  Counters& operator+=(const Counters& other) {
    for (auto count : {&Counters::intersections, &Counters::evaluations, &Counters::scratch_bytes, &Counters::tiles,
                       &Counters::empty_tiles, &Counters::stopped_samples, &Counters::lattice_tiles,
                       &Counters::lattices, &Counters::split_lattices, &Counters::refused_lattices})
      this->*count += other.*count;
    return *this;
  }
};

// Cameras of a batch of scenes: scene b is seen by the cameras [b * per_scene, (b + 1) * per_scene).
template <class T>
struct Cameras {
  int64_t scenes = 0, per_scene = 0, width_px = 0, height_px = 0;
  const T* world_to_camera = nullptr;  // [I, 4, 4]; of rolling shutters [I, 6, 4]: then the turn and the way, 0 each
  const T* intrinsics = nullptr;       // [I, 4]: fx, fy, cx, cy
  const T* limits = nullptr;           // [I, 5], see make_camera
  CameraModel model = CameraModel::kPinhole;
  bool antialiased = false;  // see Camera, as the next two
  double aperture = 0, inverse_zero_depth = 0;
  Shutter shutter = Shutter::kGlobal;
  int64_t images() const { return scenes * per_scene; }
  bool rolls() const { return shutter != Shutter::kGlobal; }
  LFGS_HD int pose_numbers() const { return shutter == Shutter::kGlobal ? 16 : 24; }
  template <class R = double>
  LFGS_HD Camera<R> camera(int64_t image) const {
    const T* pose = world_to_camera + pose_numbers() * image;
    Camera<R> camera = make_camera<R>(pose, intrinsics + 4 * image, limits + 5 * image, model);
    camera.antialiased = antialiased;
    camera.aperture = R(aperture), camera.inverse_zero_depth = R(inverse_zero_depth);
    if (shutter != Shutter::kGlobal) {
      camera.shutter = shutter;
      camera.turn = {pose[16], pose[17], pose[18]}, camera.way = {pose[20], pose[21], pose[22]};
      const int64_t parts = shutter == Shutter::kRows ? height_px : width_px;
      camera.read_per_px = 1 / R(parts > 1 ? parts - 1 : 1);
    }
    return camera;
  }
  bool compensated() const { return antialiased || aperture > 0; }
  // Whether projection needs double precision: cameras that are no pinholes or roll, and compensated opacities.
  bool exact() const { return compensated() || model != CameraModel::kPinhole || rolls(); }
};

// The output of project, for I images of N splats.
template <class T>
struct Splats {
  int64_t images = 0, count = 0;
  int colour_order = 0;                      // polynomial order of the colours in s; 0 for images
  Splat<T>* splats = nullptr;                // [I, N]
  T* colours = nullptr;                      // [I, N, order + 1, kColourStride]; see also math/colour_circle.h
  int32_t* orders = nullptr;                 // [I, N] of each, <= colour_order; or kCircleOrder; null for images
  Compensation<T>* compensations = nullptr;  // [N] if opacities are compensated; null else and for images
};

// Which splats touch which band, nearest first.
struct Bins {
  int64_t* band_offsets = nullptr;  // [I * bands + 1] into band_splats
  int32_t* band_splats = nullptr;   // [intersections] splat index within the image
};

// The output of composite_images.
template <class T>
struct Images {
  T* image = nullptr;  // [I, H, W, 3]
  T* alpha = nullptr;  // [I, H, W]
  T* depth = nullptr;  // [I, H, W] sum of weight * z
};

// Numbers of Gaussians that are blended as colours are, and the images of them.
template <class T>
struct Features {
  int64_t channels = 0;               // D, of each Gaussian
  int64_t images_per_row = 1;         // consecutive images that share their rows: the cameras of a scene, or 1
  const T* values = nullptr;          // [I / images_per_row, N, D]
  const T* image = nullptr;           // [I, H, W, D], of the backward pass
  const T* image_gradient = nullptr;  // likewise

  LFGS_HD const T* row(int64_t image, int64_t count, int64_t splat) const {
    return values + (image / images_per_row * count + splat) * channels;
  }
};

// The gradient of a splat of an ordinary image, summed over its intersections: kSplatSums numbers. It is also the
// gradient of the splats for torch, and so of their shape. On a CUDA device the first six are those of FootprintSum.
enum SplatSum : int {
  kPlaceSum,                  // u0, v0
  kShapeSum = kPlaceSum + 2,  // log2 opacity, tau, c0, S0
  kDepthSum = kShapeSum + 4,
  kColourSum,                     // r, g, b
  kAbsoluteSum = kColourSum + 3,  // |gradient| of u0 and of v0 over the samples (Ye et al., "AbsGS", 2024)
  kSplatSums = kAbsoluteSum + 2
};
static_assert(kSplatSums == kSplatFields && int(kDepthSum) == int(kImageFootprintSums));

// --- plan: lists the sub-pixels of `sorted`. count writes how many are in each (view, tile), counts [V * tiles]; fill
// writes the codes of SubpixelLists. places [map.views] has the index of each view among the V with lists, or -1.
void plan_sorted_count(const ViewMap& map, const SubpixelTile& tile, const int32_t* places, int64_t views,
                       int32_t* counts, int threads);
void plan_sorted_fill(const ViewMap& map, const SubpixelTile& tile, const int32_t* places, int64_t views,
                      const int64_t* starts, uint16_t* codes, int threads);

// --- project: Gaussians to splats. project_images writes colours of all, zeros where a splat is not drawn.
template <class T>
void project_images(const Gaussians<const T>& gaussians, const Cameras<T>& cameras, const Splats<T>& out, int threads);

// The rig is a Camera with a sweep, the lens tells the size of the panel. Where a polynomial of the order might err by
// more than the tolerance, the colour is on a circle if its numbers fit. In float a splat's order is the smallest
// whose dropped Chebyshev coefficients sum to <= tolerance; in double nothing is dropped. Return a bound of the error
// of the colours.
template <class T>
double project_direct(const Gaussians<const T>& gaussians, const Camera<double>& rig, const Lens& lens,
                      const Quality& quality, double tolerance, const Splats<T>& out, int threads);

// screen [I, N, 2], or null, receives the gradients of the splats' centres, u0 and v0 in pixels, 0 where nothing is
// drawn. With absolute gradients it is [I, N, 4], and these come last. first_intersection may be null: then
// intersection_gradients are the sums [I, N, kSplatSums] of sum_intersections. g_optics [I, kCameraOptics], or null,
// receives the gradients of intrinsics and limits.
template <class T>
void project_images_backward(const Gaussians<const T>& gaussians, const Cameras<T>& cameras, const Splats<T>& splats,
                             const int64_t* first_intersection, const T* intersection_gradients,
                             const Gaussians<T>& out, T* screen, bool absolute, T* g_world_to_camera, T* g_optics,
                             int threads);
// g_rig [kRigNumbers], or null, receives the gradients of the rig, see RigGradient::number().
template <class T>
void project_direct_backward(const Gaussians<const T>& gaussians, const Camera<double>& rig, const Lens& lens,
                             const Splats<T>& splats, const int64_t* first_intersection,
                             const T* intersection_gradients, const Gaussians<T>& out, double* g_rig, int threads);

// --- order: sorts by depth, nearest first, ties by index. drawn[i] of the splats of image i are drawn; order[i] begins
// with them, and only they count.
template <class T>
void order(const Splats<T>& splats, int32_t* order, int64_t* drawn, int threads);

// --- bin: lists the splats of each band. count fills band_offsets and returns the number of intersections; fill writes
// band_splats.
template <class T>
int64_t bin_count(const Splats<T>& splats, const int32_t* order, const int64_t* drawn, int64_t height_px, Bins bins,
                  int threads);
template <class T>
void bin_fill(const Splats<T>& splats, const int32_t* order, const int64_t* drawn, int64_t height_px, Bins bins,
              int threads);
// For the backward pass, whose intersections are in order of splats, then bands: the number of each splat's first
// intersection, first_intersection [I, N].
template <class T>
void first_intersections(const Splats<T>& splats, int64_t height_px, Bins bins, int64_t* first_intersection,
                         int threads);

// --- composite: blends splats into samples. The backward pass writes the gradients of intersections, and that of the
// background by band. Gradients of alpha and of depth of ordinary images may be null: zero everywhere.
template <class T>
Counters composite_images(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const T* background,
                          Images<T> out, int threads);
template <class T>
Counters composite_images_backward(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const T* background,
                                   Images<const T> images, Images<const T> gradients, bool absolute,
                                   const int64_t* first_intersection, T* intersection_gradients, T* band_background,
                                   int threads);

// Blend D numbers of each Gaussian by the weights that composite_images gives to its splats: out [I, H, W, D].
template <class T>
Counters composite_features(const Splats<T>& splats, Bins bins, int64_t width_px, int64_t height_px,
                            const Features<T>& features, T* out, int threads);
// The depth of the first splat of each pixel after which less than half of the light is left, or of the last: [I, H,
// W], 0 where there is none (Huang et al., "2D Gaussian Splatting", 2024).
template <class T>
Counters composite_median_depth(const Splats<T>& splats, Bins bins, int64_t width_px, int64_t height_px, T* out,
                                int threads);
// The backward pass of composite_features: g_features [I, N, D], and sums [I, N, kSplatSums], of which the first six
// are written and all others zero. The caller lends intersection_gradients [intersections, kSplatFields +
// kFeatureChunk].
constexpr int kFeatureChunk = 16;  // channels that are blended at a time
template <class T>
Counters composite_features_backward(const Splats<T>& splats, Bins bins, int64_t width_px, int64_t height_px,
                                     const Features<T>& features, int64_t intersections,
                                     const int64_t* first_intersection, T* intersection_gradients, T* sums,
                                     T* g_features, int threads);
// Sum up the gradients of composite_images_backward over the intersections of each splat: sums [I, N, kSplatSums].
template <class T>
void sum_intersections(const Splats<T>& splats, int64_t height_px, const int64_t* first_intersection,
                       const T* intersection_gradients, bool absolute, T* sums, int threads);

// Draw each sub-pixel by the camera of its view, one channel of one sample: image i is the i-th view of the lists.
// Write to out, or where that is null to out8 as round(255 clamp(c, 0, 1)), ties to even; background [3].
template <class T>
Counters composite_sorted(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const SubpixelLists& lists,
                          const T* background, T* out, uint8_t* out8, int threads);

// The same for a rig: the camera of each sub-pixel follows from the lens. g_offsets [H, W, 3], or null, receives the
// gradient of the normalized offset s of each sub-pixel's camera, by image channel.
template <class T>
Counters composite_direct(const Splats<T>& splats, Bins bins, const Lens& lens, const Quality& quality,
                          const T* background, T* out, uint8_t* out8, int threads);
template <class T>
Counters composite_direct_backward(const Splats<T>& splats, Bins bins, const Lens& lens, const T* background,
                                   const T* image, const T* gradient, const int64_t* first_intersection,
                                   T* intersection_gradients, T* band_background, T* g_offsets, int threads);

}  // namespace lfgs
