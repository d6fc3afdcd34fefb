// Crop a photo. A pass over all pixels finds the object. Then a thread makes a pixel of the result, resized first along
// rows, then along columns.
#include "cuda/photo/photo.h"

#include <algorithm>

#include "cuda/common/launch.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int64_t kMostRows = 65535;  // of a grid

// The box is found by maxima alone, which begin at zero. They are the distance of its top edge from the bottom of the
// photo, its bottom edge, and likewise for left and right. The last says whether a value was out of range.
enum Found { kFromBottom, kBottom, kFromRight, kRight, kOutside };

// The square round the box, in whole pixels; it may reach beyond the photo.
struct Square {
  int64_t top, left, side;

  __device__ explicit Square(const Photo& photo) {
    const unsigned* found = photo.found;
    const int64_t upper = photo.height - found[kFromBottom], lower = found[kBottom];
    const int64_t low = photo.width - found[kFromRight], high = found[kRight];
    side = max(int64_t(2), int64_t(rint(double(max(lower - upper, high - low)) * (1 + 2 * photo.margin))));
    top = (upper + lower - side) >> 1, left = (low + high - side) >> 1;  // rounded down
  }
};

// The pixels of the square that one of the result's is made of: a triangle as wide as that, at least a pixel.
struct Triangle {
  double centre, reach;
  int64_t first, last;

  __device__ Triangle(int64_t index, int64_t side, int size_px) {
    const double scale = double(side) / size_px;
    centre = (double(index) + 0.5) * scale, reach = fmax(scale, 1.0);
    first = max(int64_t(0), int64_t(floor(centre - reach))), last = min(side - 1, int64_t(ceil(centre + reach)));
  }
  __device__ float weight(int64_t pixel) const {
    return fmaxf(0.f, 1 - fabsf(float((double(pixel) + 0.5 - centre) / reach)));
  }
};

// Call add(pixel, weight) for those that lie in the photo, from `start` to `end` of it; what lies beyond is zero.
template <class Add>
__device__ void for_each_weight(const Triangle& triangle, int64_t origin, int64_t end, const Add& add) {
  float sum = 0;
  for (int64_t k = triangle.first; k <= triangle.last; ++k) sum += triangle.weight(k);
  for (int64_t k = triangle.first; k <= triangle.last; ++k)
    if (origin + k >= 0 && origin + k < end) add(origin + k, triangle.weight(k) / sum);
}

__device__ inline float4 read_pixel(const Photo& photo, int64_t i) {
  if (photo.floats) return reinterpret_cast<const float4*>(photo.floats)[i];
  const uint32_t word = reinterpret_cast<const uint32_t*>(photo.bytes)[i];
  return make_float4(float(word & 255), float(word >> 8 & 255), float(word >> 16 & 255), float(word >> 24));
}
__device__ inline bool in_range(float v) { return v >= 0 && v <= 1; }

__global__ void __launch_bounds__(kThreads) find_kernel(Photo photo) {
  __shared__ unsigned found[kFoundNumbers];
  if (threadIdx.x < kFoundNumbers) found[threadIdx.x] = 0;
  __syncthreads();
  for (int64_t row = blockIdx.x; row < photo.height; row += gridDim.x) {
    for (int64_t column = threadIdx.x; column < photo.width; column += kThreads) {
      const float4 p = read_pixel(photo, row * photo.width + column);
      if (photo.floats && !(in_range(p.x) && in_range(p.y) && in_range(p.z) && in_range(p.w)))
        atomicMax(&found[kOutside], 1u);
      if (!(p.w >= photo.opaque)) continue;
      const unsigned numbers[4] = {unsigned(photo.height - row), unsigned(row + 1), unsigned(photo.width - column),
                                   unsigned(column + 1)};
      for (int k = 0; k < 4; ++k)
        if (numbers[k] > found[k]) atomicMax(&found[k], numbers[k]);
    }
  }
  __syncthreads();
  if (threadIdx.x < kFoundNumbers && found[threadIdx.x]) atomicMax(&photo.found[threadIdx.x], found[threadIdx.x]);
}

__global__ void check_kernel(Photo photo) {
  photo.checks[0] = photo.found[kOutside] == 0, photo.checks[1] = photo.found[kBottom] > 0;
}

__global__ void __launch_bounds__(kThreads) across_kernel(Photo photo, int size_px, float4* narrow) {
  const int64_t column = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (column >= size_px) return;
  const Square square(photo);
  const Triangle triangle(column, square.side, size_px);
  const float per_unit = photo.floats ? 1 : 255;
  for (int64_t row = blockIdx.y; row < photo.height; row += gridDim.y) {
    if (row < square.top || row >= square.top + square.side) continue;
    float4 sum = make_float4(0, 0, 0, 0);
    for_each_weight(triangle, square.left, photo.width, [&](int64_t pixel, float weight) {
      const float4 p = read_pixel(photo, row * photo.width + pixel);
      const float alpha = p.w / per_unit, covering = weight * alpha;
      sum.x += covering * (p.x / per_unit), sum.y += covering * (p.y / per_unit), sum.z += covering * (p.z / per_unit);
      sum.w += covering;
    });
    narrow[row * size_px + column] = sum;
  }
}

__global__ void __launch_bounds__(kThreads) down_kernel(Photo photo, int size_px, const float4* narrow, float* out) {
  const int64_t column = int64_t(blockIdx.x) * kThreads + threadIdx.x, row = blockIdx.y;
  if (column >= size_px) return;
  const Square square(photo);
  float4 sum = make_float4(0, 0, 0, 0);
  for_each_weight(Triangle(row, square.side, size_px), square.top, photo.height, [&](int64_t pixel, float weight) {
    const float4 p = narrow[pixel * size_px + column];
    sum.x += weight * p.x, sum.y += weight * p.y, sum.z += weight * p.z, sum.w += weight * p.w;
  });
  const int64_t step = int64_t(size_px) * size_px, i = row * size_px + column;
  out[i] = sum.x, out[i + step] = sum.y, out[i + 2 * step] = sum.z, out[i + 3 * step] = sum.w;
}

}  // namespace

void find_object(const Photo& photo, Stream stream) {
  check(cudaMemsetAsync(photo.found, 0, kFoundNumbers * sizeof(unsigned), cudaStream_t(stream)), "crop: clear");
  const unsigned blocks = unsigned(std::min<int64_t>(photo.height, resident_blocks(find_kernel, kThreads, 0)));
  find_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(photo);
  check_launch("crop: find");
  check_kernel<<<1, 1, 0, cudaStream_t(stream)>>>(photo);
  check_launch("crop: check");
}

void crop_object(const Photo& photo, int size_px, float* narrow, float* out, Stream stream) {
  require(size_px > 0 && size_px <= kMostRows,
          "crop takes sizes of 1 to " + std::to_string(kMostRows) + " px, got " + std::to_string(size_px));
  const unsigned across = unsigned(blocks_for(size_px, kThreads));
  const dim3 blocks(across, unsigned(std::min(photo.height, kMostRows)));
  across_kernel<<<blocks, kThreads, 0, cudaStream_t(stream)>>>(photo, size_px, reinterpret_cast<float4*>(narrow));
  check_launch("crop: across");
  const dim3 square_blocks(across, unsigned(size_px));
  down_kernel<<<square_blocks, kThreads, 0, cudaStream_t(stream)>>>(photo, size_px,
                                                                    reinterpret_cast<const float4*>(narrow), out);
  check_launch("crop: down");
}

}  // namespace lfgs::cuda
