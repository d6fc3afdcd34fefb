// Sorts the splats of a light-field frame by depth, stably: least significant digit first, one pass over them a digit
// (Adinets & Merrill 2022, "Onesweep"). CUB's tiles are made for many more keys: a quarter of a million of them keep
// but a quarter of a large GPU busy, and each of its passes clears memory of its own.
#pragma once

#include "cuda/stages.h"

namespace lfgs::cuda {

constexpr int kDigits = 256, kPasses = 4;

// What the passes tell each other; cleared before each sort.
struct DepthSort {
  unsigned* next_tile = nullptr;  // [kPasses]
  unsigned* counts = nullptr;     // [kPasses, kDigits]: keys with each digit
  uint64_t* words = nullptr;      // [tiles, kDigits]: keys of a tile with the digit, or of all tiles up to it
};
int64_t depth_sort_tiles(int64_t items);

// Sorts keys, and writes which items they are; with spare room for both.
void sort_by_depth(const DepthSort& sort, int64_t items, uint32_t* keys, uint32_t* order, uint32_t* spare_keys,
                   uint32_t* spare_order, Stream stream);

}  // namespace lfgs::cuda
