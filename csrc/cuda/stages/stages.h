// The stages and their backward passes on a CUDA device: the same as the CPU's stages (stages/stages.h), with device
// pointers and a stream. They run in the order in which they stand here. Nothing allocates or waits; the caller asks
// for the sizes of temporary storage first.
#pragma once

#include <cstdint>
#include <vector>

#include "base/config.h"
#include "math/gradient_sums.h"
#include "stages/stages.h"

namespace lfgs::cuda {

using Stream = void*;  // cudaStream_t

// The architectures that this build was compiled for, ascending, as CMake numbers them (75, 90, 120). "native" gives
// the architecture of the machine that compiled it.
std::vector<int> architectures();

// The size of the tiles that have lists on the device: pixels across and down.
struct TileSize {
  int width_px, height_px;
};
constexpr TileSize kImageTile{16, 16}, kDirectTile{32, 16};

LFGS_HD int64_t tile_count(TileSize tile, int64_t width_px, int64_t height_px) {
  return ((width_px + tile.width_px - 1) / tile.width_px) * ((height_px + tile.height_px - 1) / tile.height_px);
}

// The images that are drawn together, and their tiles.
struct Image {
  int64_t count, width_px, height_px;  // of images, all of one size
  TileSize tile;
};

// --- project. It also writes the keys for sorting, [I * N]. A key is the number of the image above kDepthBits bits of
// the positive depth; ~0 where nothing is drawn. (Here and below I images have N Gaussians each.)
constexpr int kDepthBits = 31;
constexpr int64_t kMostImages = 65535;  // CUDA's limit for blocks of a launch along y
void project_images(const Gaussians<const float>& gaussians, const Cameras<float>& cameras, const Splats<float>& out,
                    uint64_t* keys, Stream stream);
// error receives the largest estimated error of a colour polynomial (one float, zeroed by the caller).
void project_direct(const Gaussians<const float>& gaussians, const Camera<double>& rig, const Lens& lens,
                    double tolerance, const Splats<float>& out, uint64_t* keys, float* error, Stream stream);

// --- order. Write the indices [I * N] sorted by key. Raise when 32 bits do not hold an index.
size_t order_bytes(int64_t items);
void order(int64_t items, int64_t images, const uint64_t* keys, uint64_t* sorted_keys, uint32_t* indices,
           void* temporary, size_t temporary_bytes, Stream stream);

// --- bin. bin_count writes how many (tile, splat) intersections each splat has, counts [I * N], and how many there are
// of all, `intersections` (one number). It does not need the order, so that the host may learn the latter while the
// device sorts.
size_t count_bytes(int64_t items);
void bin_count(const Splats<float>& splats, const Image& image, uint32_t* counts, int64_t* intersections,
               void* temporary, size_t temporary_bytes, Stream stream);
// Buffers of bin_fill, a number per intersection. The index of an intersection is its place in splat-major order: those
// of the i-th sorted splat are [ends[i - 1], ends[i]). After bin_fill only the sorted ones are of use.
//
// Where the host does not wait for the number of intersections, `count` is the capacity of the buffers. The device has
// the number at `total`. If that is larger, some intersections are missing: whoever reads the images has to look.
struct Intersections {
  int64_t count;
  uint32_t *tiles, *sorted_tiles;      // tile of each intersection; of each sorted intersection
  uint32_t *indices, *sorted_indices;  // 0, 1, 2, ...; the intersection of each sorted intersection
  uint32_t *splats, *sorted_splats;    // splat of each intersection; of each sorted intersection
  const int64_t* total = nullptr;      // null: `count` is their number
};
// The splat of the k-th intersection in the order of `ranges`.
LFGS_HD uint32_t sorted_splat(const Intersections& intersections, int64_t k) { return intersections.sorted_splats[k]; }
// The intersections of one splat, [first, last).
struct IntersectionRange {
  uint32_t first, last;
};
// bin_fill writes the intersections, nearest first within a tile, and intersection_ranges [I * N]. ends [I * N] is the
// running sum of the counts of the sorted splats. ranges [I * tiles, 2] receives the first and the end of each tile's
// intersections. The caller zeroes it, for empty tiles are left alone. fill_bytes raises when 32 bits do not hold an
// intersection.
size_t fill_bytes(int64_t items, int64_t intersections);
void bin_fill(const Splats<float>& splats, const Image& image, const uint32_t* indices, const uint32_t* counts,
              int64_t* ends, const Intersections& intersections, int64_t* ranges,
              IntersectionRange* intersection_ranges, void* temporary, size_t temporary_bytes, Stream stream);

// --- composite. Read the intersections of every tile, `ranges`, and write the images.
void composite_images(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                      const Intersections& intersections, const float* background, Images<float> out, Stream stream);
// Features and the median depth, see stages/stages.h.
void composite_features(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                        const Intersections& intersections, const Features<float>& features, float* out, Stream stream);
void composite_median_depth(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                            const Intersections& intersections, float* out, Stream stream);
void composite_direct(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                      const Intersections& intersections, const Lens& lens, const float* background, float* out,
                      Stream stream);

// --- the backward passes. One block writes each intersection in a fixed order, and sums run in the order of
// intersections. So every run gives the same bits. intersection_gradients is [intersections, numbers of a
// intersection]; tile_background is [I * tiles, 3].
//
// The numbers of an intersection are, for ordinary images, the first kImageFootprintSums of FootprintSum, then the
// gradients of depth, r, g and b. With absolute gradients, the sums of |gradient| of u0 and of v0 over the samples
// follow (Ye et al., "AbsGS", 2024). For a panel they are all of FootprintSum, the gradients of r, g, b for each power
// of s, and with compensation the gradients of D.
constexpr int kImageSums = kAbsoluteSum, kAbsoluteImageSums = kSplatSums;
constexpr int kDirectSums = kDirectFootprintSums;
// Gradients of alpha and of depth may be null: zero everywhere.
void composite_images_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                               const Intersections& intersections, Images<const float> images,
                               Images<const float> gradients, bool absolute, float* intersection_gradients,
                               float* tile_background, Stream stream);
// Add up the intersections of each splat: sums [I, N, kSplatSums], the numbers of an intersection, all zero where a
// splat has none. Numbers behind them are left alone.
void sum_intersections(int64_t splats, const IntersectionRange* intersection_ranges, bool absolute,
                       const float* intersection_gradients, float* sums, Stream stream);
// The backward pass of composite_features, kFeatureChunk channels at a time: g_features [I, N, D], and sums [I, N,
// kSplatSums], of which the first kImageFootprintSums are written and all others zero. The caller lends
// intersection_gradients [intersections, kFeatureSums].
constexpr int kFeatureSums = kImageFootprintSums + kFeatureChunk;
void composite_features_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                                 const Intersections& intersections, const IntersectionRange* intersection_ranges,
                                 const Features<float>& features, float* intersection_gradients, float* sums,
                                 float* g_features, Stream stream);
// Where the sums of a chunk of channels go: the footprint's numbers are added to `sums`, and the gradients of `used`
// channels from `first` on are written to g_features.
struct FeatureSums {
  float *sums, *g_features;
  int64_t channels, first;
  int used;
};
// Add up the intersections of each splat, of `width` (4 or kFeatureChunk) channels.
void sum_feature_intersections(int64_t splats, const IntersectionRange* intersection_ranges,
                               const float* intersection_gradients, int width, const FeatureSums& out, Stream stream);
// From the sums of all splats. All of out is overwritten. screen [I, N, 2], or null, receives the gradients of the
// splats' places, u0 and v0 in pixels. With `absolute` it is [I, N, 4], with the absolute gradients behind.
// camera_partials [I, camera_blocks(N), 12], or null, receives gradients of the rows of [R|t], which the caller sums
// over the blocks; of rolling shutters it is [.., 18], with those of the turn and the way behind. With `optics` the
// last axis has kCameraOptics more, the gradients of intrinsics and limits.
int64_t camera_blocks(int64_t gaussians);
void project_images_backward(const Gaussians<const float>& gaussians, const Cameras<float>& cameras, const float* sums,
                             const Gaussians<float>& out, float* screen, bool absolute, float* camera_partials,
                             bool optics, Stream stream);

// tile_lens [tiles, kLensSums], or null, receives the sums over a tile of the gradients g of the normalized offsets s
// of sub-pixels. They are the sums of g by row and column modulo kCellPeriod and by channel, then of g times the row
// and of g times the column. rig_partials [rig_blocks(N), kRigNumbers], or null, receives the gradients of the rig (see
// RigGradient::number()), which the caller sums over the blocks.
constexpr int kPlaceSums = 3 * kCellPeriod * kCellPeriod, kLensSums = kPlaceSums + 2;
int64_t rig_blocks(int64_t gaussians);
void composite_direct_backward(const Splats<float>& splats, const Image& image, const int64_t* ranges,
                               const Intersections& intersections, const Lens& lens, const float* pixels,
                               const float* gradient, float* intersection_gradients, float* tile_background,
                               float* tile_lens, Stream stream);
void project_direct_backward(const Gaussians<const float>& gaussians, const Camera<double>& rig,
                             const Splats<float>& splats, const IntersectionRange* intersection_ranges,
                             const float* intersection_gradients, const Gaussians<float>& out, double* rig_partials,
                             Stream stream);

}  // namespace lfgs::cuda
