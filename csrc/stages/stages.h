// The stages of the rasterizer and their reverses. Every buffer belongs to the caller; T is float or double.
//
//   Gaussians + views -> project -> order -> bin -> composite -> image, and back.
//
// An *image* is what one view (Dense) or the whole rig (Lens) shows; it is cut into bands of kBandRows rows. A *pair*
// is a (band, splat) that may touch each other. Layouts are row-major; N Gaussians, I images.
#pragma once

#include <cstdint>

#include "math/compensation.h"
#include "math/projection.h"
#include "math/quality.h"
#include "scene/gaussians.h"
#include "scene/lens.h"
#include "scene/subpixels.h"
#include "scene/view.h"

namespace lfgs {

constexpr int kBandRows = 16;
constexpr int kColourStride = 4;  // r, g, b and padding: what a vector look-up reads

inline int64_t band_count(int64_t height_px) { return (height_px + kBandRows - 1) / kBandRows; }

// Numbers of a pair's gradient, or of a sum over some: see PairGradient.
inline int pair_gradient_size(int colour_order, bool compensated = false) {
  return kSplatFields + 3 * (colour_order + 1) + (compensated ? kCompensationFields : 0);
}

// What they are: those of the splat's fields, of its colours by power of s, and for an anti-aliased lens those of its
// compensation.
template <class T>
struct PairGradient {
  T* numbers;
  int colour_order = 0;

  Splat<T>& splat() const { return *reinterpret_cast<Splat<T>*>(numbers); }
  T* colours() const { return numbers + kSplatFields; }  // [order + 1, 3]
  Compensation<T>& compensation() const {
    return *reinterpret_cast<Compensation<T>*>(colours() + 3 * (colour_order + 1));
  }
};
static_assert(sizeof(Splat<float>) == kSplatFields * sizeof(float));
static_assert(sizeof(Compensation<float>) == kCompensationFields * sizeof(float));

struct Counters {
  int64_t pairs = 0;        // (tile, splat)
  int64_t evaluations = 0;  // samples evaluated, lanes that missed included
  int64_t scratch_bytes = 0;
  // Lens only: tiles drawn by themselves and those of them without splats, samples that stopped before the last splat;
  // tiles drawn from lattices; lattices that were good enough, too coarse for a run that was then halved, given up.
  int64_t tiles = 0, empty_tiles = 0, stopped_samples = 0, lattice_tiles = 0;
  int64_t lattices = 0, split_lattices = 0, refused_lattices = 0;

  Counters& operator+=(const Counters& other) {
    for (auto count : {&Counters::pairs, &Counters::evaluations, &Counters::scratch_bytes, &Counters::tiles,
                       &Counters::empty_tiles, &Counters::stopped_samples, &Counters::lattice_tiles,
                       &Counters::lattices, &Counters::split_lattices, &Counters::refused_lattices})
      this->*count += other.*count;
    return *this;
  }
};

// Cameras of a batch of scenes: scene b is seen by cameras b * cameras_per_scene ...
template <class T>
struct Cameras {
  int64_t scenes = 0, per_scene = 0, width_px = 0, height_px = 0;
  const T* world_to_camera = nullptr;  // [I, 4, 4]
  const T* intrinsics = nullptr;       // [I, 4]: fx, fy, cx, cy
  const T* limits = nullptr;           // [I, 5]: Jacobian clamp, offset in the rig
  bool antialiased = false;            // see View
  int64_t images() const { return scenes * per_scene; }
  template <class R = double>
  LFGS_HD View<R> view(int64_t image) const {
    View<R> view = make_view<R>(world_to_camera + 16 * image, intrinsics + 4 * image, limits + 5 * image);
    view.antialiased = antialiased;
    return view;
  }
};

// What project writes, for I images of N splats.
template <class T>
struct Splats {
  int64_t images = 0, count = 0;
  int colour_order = 0;                      // polynomial order of the colours in s; 0 for Dense
  Splat<T>* splats = nullptr;                // [I, N]
  T* colours = nullptr;                      // [I, N, order + 1, kColourStride]
  int32_t* orders = nullptr;                 // [I, N] order that a splat needs, <= colour_order; null for Dense
  Compensation<T>* compensations = nullptr;  // [N] of an anti-aliased scene; null for others and for Dense
};

// Which splats touch which band, nearest first.
struct Bins {
  int64_t* band_offsets = nullptr;  // [I * bands + 1] into band_splats
  int32_t* band_splats = nullptr;   // [pairs] splat index within the image
};

template <class T>
struct DenseImages {
  T* image = nullptr;  // [I, H, W, 3]
  T* alpha = nullptr;  // [I, H, W]
  T* depth = nullptr;  // [I, H, W] sum of weight * z
};

// --- plan of sorted sub-pixels: count writes how many show each (view, tile), counts [V * tiles]; fill writes the
// codes of SubpixelLists. places [map.views]: the place of each view among the V that have lists, or -1.
void plan_sorted_count(const ViewMap& map, const SubpixelTile& tile, const int32_t* places, int64_t views,
                       int32_t* counts, int threads);
void plan_sorted_fill(const ViewMap& map, const SubpixelTile& tile, const int32_t* places, int64_t views,
                      const int64_t* starts, uint16_t* codes, int threads);

// --- project; project_dense writes colours whole, zeros where nothing is drawn
template <class T>
void project_dense(const Gaussians<const T>& gaussians, const Cameras<T>& cameras, const Splats<T>& out, int threads);

// The rig is the view of its centre camera plus the lens; returns the largest estimated error of a colour polynomial.
// float: a splat's order is the smallest whose dropped Chebyshev coefficients sum to <= tolerance.
template <class T>
double project_lens(const Gaussians<const T>& gaussians, const View<double>& rig, const Lens& lens,
                    const Quality& quality, double tolerance, const Splats<T>& out, int threads);

template <class T>
void project_dense_backward(const Gaussians<const T>& gaussians, const Cameras<T>& cameras, const Splats<T>& splats,
                            const int64_t* first_pair, const T* pair_gradients, const Gaussians<T>& out,
                            T* g_world_to_camera, int threads);
template <class T>
void project_lens_backward(const Gaussians<const T>& gaussians, const View<double>& rig, const Lens& lens,
                           const Splats<T>& splats, const int64_t* first_pair, const T* pair_gradients,
                           const Gaussians<T>& out, int threads);

// --- order: by depth, ties by index; drawn[i] of image i's splats are drawn and stand first in order[i].
template <class T>
void order(const Splats<T>& splats, int32_t* order, int64_t* drawn, int threads);

// --- bin: count fills band_offsets and returns the number of pairs; fill writes band_splats.
template <class T>
int64_t bin_count(const Splats<T>& splats, const int32_t* order, const int64_t* drawn, int64_t height_px, Bins bins,
                  int threads);
template <class T>
void bin_fill(const Splats<T>& splats, const int32_t* order, const int64_t* drawn, int64_t height_px, Bins bins,
              int threads);
// Where the gradients of each splat's pairs start, splat-major: first_pair [I, N].
template <class T>
void first_pairs(const Splats<T>& splats, int64_t height_px, Bins bins, int64_t* first_pair, int threads);

// --- composite
template <class T>
Counters composite_dense(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const T* background,
                         DenseImages<T> out, int threads);
template <class T>
Counters composite_dense_backward(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const T* background,
                                  DenseImages<const T> images, DenseImages<const T> gradients,
                                  const int64_t* first_pair, T* pair_gradients, T* band_background, int threads);

// One channel of one sample a sub-pixel, each view by its own camera: image i is the i-th view of the lists. Writes
// to out, or where that is null to out8 as round(255 clamp(c, 0, 1)), ties to even; background [3].
template <class T>
Counters composite_sorted(const Splats<T>& splats, Bins bins, const Cameras<T>& cameras, const SubpixelLists& lists,
                          const T* background, T* out, uint8_t* out8, int threads);

// Likewise, every sub-pixel by the camera of its own view of a rig.
template <class T>
Counters composite_lens(const Splats<T>& splats, Bins bins, const Lens& lens, const Quality& quality,
                        const T* background, T* out, uint8_t* out8, int threads);
template <class T>
Counters composite_lens_backward(const Splats<T>& splats, Bins bins, const Lens& lens, const T* background,
                                 const T* image, const T* gradient, const int64_t* first_pair, T* pair_gradients,
                                 T* band_background, int threads);

}  // namespace lfgs
