// The sub-pixels of a panel, sorted by the view that they show (Shi et al. 2025, section 3.1): what the method `sorted`
// draws. There is a list for every (view, tile), view by view; its sub-pixels are in order of column, then row, then
// channel.
#pragma once

#include <cstdint>

#include "scene/lens.h"

namespace lfgs {

// Which view every sub-pixel shows: a table, or the lens where there is none.
struct ViewMap {
  int64_t width_px = 0, height_px = 0, views = 1;
  const int32_t* table = nullptr;  // [H, W, 3] by image channel: 0 .. views - 1, or negative where nothing is shown
  Lens lens;

  int64_t at(int64_t row, int64_t column, int channel) const {
    if (table) return table[(row * width_px + column) * 3 + channel];
    return integer_view(lens.true_phase(row, lens.subpixel_index(row, column, channel)), uint64_t(lens.views));
  }
};

// The size of the tiles that have lists. A sub-pixel's code has 16 bits, so width_px << row_bits must not exceed 2^14.
struct SubpixelTile {
  int width_px = 1, row_bits = 0;

  LFGS_HD int height_px() const { return 1 << row_bits; }
  LFGS_HD int64_t across(int64_t image_width_px) const { return (image_width_px + width_px - 1) / width_px; }
  LFGS_HD int64_t count(int64_t image_width_px, int64_t image_height_px) const {
    return across(image_width_px) * ((image_height_px + height_px() - 1) / height_px());
  }
};

// A list is filled up to whole blocks with kNoSubpixel, the paper's (-1, -1).
constexpr int kSubpixelBlock = 32;
constexpr uint16_t kNoSubpixel = 0xffff;

// A sub-pixel within its tile.
struct Subpixel {
  int column, row, channel;
};
LFGS_HD uint16_t encode_subpixel(const SubpixelTile& tile, const Subpixel& s) {
  return uint16_t(s.column << (tile.row_bits + 2) | s.row << 2 | s.channel);
}
LFGS_HD Subpixel decode_subpixel(const SubpixelTile& tile, uint16_t code) {
  return {code >> (tile.row_bits + 2), code >> 2 & (tile.height_px() - 1), code & 3};
}

// All lists of a panel.
struct SubpixelLists {
  SubpixelTile tile;
  const int64_t* starts = nullptr;  // [views * tiles + 1] into codes, multiples of kSubpixelBlock
  const uint16_t* codes = nullptr;
};

}  // namespace lfgs
