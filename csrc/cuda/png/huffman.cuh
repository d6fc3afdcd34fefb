// The codes of one deflate block, from how often each symbol stands in it (RFC 1951, section 3.2).
#pragma once

#include <cuda_runtime.h>

#include "cuda/png/png.h"

namespace lfgs::cuda {

constexpr int kMostCodeBits = 15;  // RFC 1951, 3.2.7
constexpr int kEndOfBlock = 256;

// The shared memory in which one block, of more threads than symbols, makes the codes.
struct CodeTable {
  uint32_t counts[kDeflateSymbols];
  int sorted[kDeflateSymbols];  // the symbols that stand there, from the rarest on
  int used;
  // Nodes of the tree: the leaves in the order of `sorted`, then the joined nodes in the order of their making. The
  // weights of both ascend
  unsigned long long weights[2 * kDeflateSymbols];
  short parents[2 * kDeflateSymbols], depths[2 * kDeflateSymbols];
  int of_length[kMostCodeBits + 1];  // how many codes have so many bits
  int lengths[kDeflateSymbols];      // 0: the symbol does not stand there
};

// Join the two lightest nodes until one is left (Huffman 1952): of leaves and of joined nodes the next one is the
// lightest.
__device__ inline void join_nodes(CodeTable& table) {
  const int leaves = table.used, nodes = 2 * leaves - 1;
  int leaf = 0, joined = leaves;
  for (int node = leaves; node < nodes; ++node) {
    unsigned long long weight = 0;
    for (int k = 0; k < 2; ++k) {
      const bool is_leaf = joined == node || leaf < leaves && table.weights[leaf] <= table.weights[joined];
      const int child = is_leaf ? leaf++ : joined++;
      table.parents[child] = short(node), weight += table.weights[child];
    }
    table.weights[node] = weight;
  }
  table.depths[nodes - 1] = 0;
  for (int node = nodes - 2; node >= 0; --node) table.depths[node] = table.depths[table.parents[node]] + 1;
}

// Count the codes of each length, and shorten the codes that are too long. Each takes half of the place of a code with
// fewer bits, which gets a bit more. The sum of 2^-length is 1 before and after.
__device__ inline void limit_lengths(CodeTable& table) {
  for (int& count : table.of_length) count = 0;
  int left = -(1 << kMostCodeBits);  // the sum minus 1, in units of the longest code
  for (int leaf = 0; leaf < table.used; ++leaf) {
    const int length = min(int(table.depths[leaf]), kMostCodeBits);
    ++table.of_length[length], left += 1 << (kMostCodeBits - length);
  }
  for (; left > 0; --left) {
    int length = kMostCodeBits - 1;
    while (table.of_length[length] == 0) --length;
    --table.of_length[length], table.of_length[length + 1] += 2, --table.of_length[kMostCodeBits];
  }
}

// Make the codes from table.counts, by all threads of a block. At least two symbols must have a count.
__device__ inline void make_codes(CodeTable& table, uint32_t* codes) {
  const int symbol = threadIdx.x;
  const bool is_symbol = symbol < kDeflateSymbols, stands = is_symbol && table.counts[symbol] > 0;
  if (symbol == 0) table.used = 0;
  __syncthreads();
  if (stands) {
    int rank = 0;
    const uint32_t own = table.counts[symbol];
    for (int other = 0; other < kDeflateSymbols; ++other) {
      const uint32_t count = table.counts[other];
      rank += count > 0 && (count < own || count == own && other < symbol);
    }
    table.sorted[rank] = symbol, table.weights[rank] = own;
    atomicAdd(&table.used, 1);
  }
  if (is_symbol) table.lengths[symbol] = 0;
  __syncthreads();
  if (symbol == 0) {
    join_nodes(table);
    limit_lengths(table);
    for (int length = kMostCodeBits, place = 0; length > 0; --length)  // the rarest have the longest
      for (int k = 0; k < table.of_length[length]; ++k) table.lengths[table.sorted[place++]] = length;
  }
  __syncthreads();
  if (!is_symbol) return;

  // Codes of one length follow each other in the order of the symbols, behind those of fewer bits (RFC 1951, 3.2.2)
  const int length = table.lengths[symbol];
  unsigned code = 0;
  for (int shorter = 1; shorter < length; ++shorter) code = (code + table.of_length[shorter]) << 1;
  for (int other = 0; other < symbol; ++other) code += table.lengths[other] == length;
  codes[symbol] = length == 0 ? 0 : __brev(code) >> (32 - length) | unsigned(length) << 16;
}

}  // namespace lfgs::cuda
