// Stage order: sort those splats of an image that are drawn, nearest first by depth, ties by index. Read splats,
// writes their indices and how many they are.
#include <array>
#include <bit>
#include <type_traits>
#include <vector>

#include "base/parallel.h"
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

}  // namespace lfgs
