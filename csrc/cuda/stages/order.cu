// Stage order on the device: reads the keys (image, depth) that project wrote, and writes the splats' indices in their
// order. It is one stable radix sort for all images.
#include <cub/device/device_radix_sort.cuh>

#include <bit>

#include "cuda/common/check.h"
#include "cuda/common/count_up.cuh"
#include "cuda/stages/stages.h"

namespace lfgs::cuda {
// The temporary storage also holds the unsorted indices, at its end.
size_t order_bytes(int64_t items) {
  size_t bytes = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, (uint64_t*)nullptr, (uint64_t*)nullptr, (uint32_t*)nullptr,
                                        (uint32_t*)nullptr, items),
        "order: size of the sort");
  return (bytes + 255) / 256 * 256 + size_t(items) * sizeof(uint32_t);
}

void order(int64_t items, int64_t images, const uint64_t* keys, uint64_t* sorted_keys, uint32_t* indices,
           void* temporary, size_t temporary_bytes, Stream stream) {
  if (items == 0) return;
  require(items < int64_t(1) << 32, "more than 2^32 Gaussians in all images: render fewer images at a time");
  size_t bytes = temporary_bytes - size_t(items) * sizeof(uint32_t);
  uint32_t* unsorted = reinterpret_cast<uint32_t*>(static_cast<char*>(temporary) + bytes);
  count_up(items, unsorted, cudaStream_t(stream));
  // Splats that are not drawn have all bits of their keys set. Sorting by one bit more than image numbers need puts
  // them last
  const int end_bit = kDepthBits + int(std::bit_width(uint64_t(images)));
  check(cub::DeviceRadixSort::SortPairs(temporary, bytes, keys, sorted_keys, unsorted, indices, items, 0, end_bit,
                                        cudaStream_t(stream)),
        "order");
}

}  // namespace lfgs::cuda
