#pragma once

#include <cuda_runtime.h>

#include <algorithm>
#include <numeric>
#include <vector>

namespace cub {

struct DeviceRadixSort {
  template <class K, class V, class N>
  static cudaError_t SortPairs(void* temporary, size_t& bytes, const K* keys, K* sorted_keys, const V* values,
                               V* sorted_values, N count, int begin = 0, int end = 8 * sizeof(K), cudaStream_t = 0) {
    if (!temporary) return bytes = 256, cudaSuccess;
    const K mask = K((end - begin == int(8 * sizeof(K)) ? K(~K(0)) : K((K(1) << (end - begin)) - 1)) << begin);
    std::vector<N> place(count);
    std::iota(place.begin(), place.end(), N(0));
    std::stable_sort(place.begin(), place.end(), [&](N a, N b) { return (keys[a] & mask) < (keys[b] & mask); });
    std::vector<K> k(keys, keys + count);
    std::vector<V> v(values, values + count);
    for (N i = 0; i < count; ++i) sorted_keys[i] = k[place[i]], sorted_values[i] = v[place[i]];
    return cudaSuccess;
  }
};

}  // namespace cub
