// Which tiles of its image a splat may touch, for ordinary cameras.
#pragma once

#include "cuda/stages/stages.h"
#include "math/footprint.h"

namespace lfgs::cuda {

// The rows of tiles of its image that a splat may touch, and the tiles in each of them.
struct TileRows {
  const Splat<float>& splat;
  const Image& image;
  int first = 0, last = -1;

  __device__ TileRows(const Splat<float>& splat, const Image& image) : splat(splat), image(image) {
    const Range rows = footprint_rows(splat, image.height_px);
    if (rows.last < rows.first) return;
    first = int(rows.first) / image.tile.height_px, last = int(rows.last) / image.tile.height_px;
  }

  // The number of tiles that it may touch in a row, of which `tile` receives the first.
  __device__ int tiles_in(int row, int& tile) const {
    const int width = image.tile.width_px, height = image.tile.height_px;
    const float top = float(row * height) + 0.5f;
    float low, high;
    if (!footprint_columns(splat, top, top + float(height - 1), 0.f, low, high)) return 0;
    const Range columns = pixels_within(low, high, image.width_px);
    if (columns.last < columns.first) return 0;
    tile = row * ((int(image.width_px) + width - 1) / width) + int(columns.first) / width;
    return int(columns.last) / width - int(columns.first) / width + 1;
  }
};

}  // namespace lfgs::cuda
