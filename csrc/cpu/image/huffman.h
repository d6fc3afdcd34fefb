// Codes of a block of deflate.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

namespace lfgs {

constexpr int kMostCodeBits = 15;

// Lengths in bits of the codes of a Huffman tree for symbols of these counts, 1..kMostCodeBits; 0 where the count is 0.
// At least two counts are above 0. Where the tree is too deep, the counts are halved, which flattens it, until it is
// not.
template <size_t N>
std::array<uint8_t, N> code_lengths(std::array<uint32_t, N> counts) {
  struct Node {
    uint64_t count;
    int left, right;
  };
  for (;;) {
    std::vector<std::pair<uint32_t, int>> leaves;
    for (size_t s = 0; s < N; s++)
      if (counts[s] > 0) leaves.emplace_back(counts[s], static_cast<int>(s));
    std::sort(leaves.begin(), leaves.end());
    // Leaves, then the nodes above them in the order in which they are made, which is that of their counts
    std::vector<Node> nodes;
    for (const auto& [count, symbol] : leaves) nodes.push_back({count, -1, symbol});
    const int count = static_cast<int>(leaves.size());
    int leaf = 0, inner = count;
    const auto least = [&] {
      const bool is_leaf =
          leaf < count && (inner >= static_cast<int>(nodes.size()) || nodes[leaf].count <= nodes[inner].count);
      return is_leaf ? leaf++ : inner++;
    };
    while (static_cast<int>(nodes.size()) < 2 * count - 1) {
      const int left = least(), right = least();
      nodes.push_back({nodes[left].count + nodes[right].count, left, right});
    }
    std::vector<int> depths(nodes.size(), 0);
    std::array<uint8_t, N> lengths{};
    int deepest = 0;
    for (int node = static_cast<int>(nodes.size()) - 1; node >= 0; node--) {
      if (node >= count) {
        depths[nodes[node].left] = depths[nodes[node].right] = depths[node] + 1;
      } else {
        lengths[nodes[node].right] = static_cast<uint8_t>(depths[node]);
        deepest = std::max(deepest, depths[node]);
      }
    }
    if (deepest <= kMostCodeBits) return lengths;
    for (uint32_t& each : counts) each = (each + 1) / 2;
  }
}

// The canonical codes of these lengths (RFC 1951, section 3.2.2), their first bit lowest, as deflate stores them.
template <size_t N>
std::array<uint16_t, N> codes_of(const std::array<uint8_t, N>& lengths) {
  std::array<int, kMostCodeBits + 2> next{};  // the next code of each length
  for (const uint8_t length : lengths)
    if (length > 0) next[length + 1]++;
  for (int bits = 1; bits <= kMostCodeBits; bits++) next[bits] = (next[bits] + next[bits - 1]) << 1;
  std::array<uint16_t, N> codes{};
  for (size_t s = 0; s < N; s++) {
    int code = lengths[s] > 0 ? next[lengths[s]]++ : 0;
    for (int bit = 0; bit < lengths[s]; bit++, code >>= 1) codes[s] = static_cast<uint16_t>(codes[s] << 1 | (code & 1));
  }
  return codes;
}

}  // namespace lfgs
