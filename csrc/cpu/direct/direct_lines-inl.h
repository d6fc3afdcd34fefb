// Write the bytes of a lens tile to the image. In a tile the samples of one lens column lie side by side, in the image
// those of one cell and row. So blocks of 16 lens columns are transposed first, and then copied 16 sub-pixels at a
// time.

#if defined(LFGS_CPU_DIRECT_LINES_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_DIRECT_LINES_INL_H_
#undef LFGS_CPU_DIRECT_LINES_INL_H_
#else
#define LFGS_CPU_DIRECT_LINES_INL_H_
#endif

#include <algorithm>
#include <cstring>

#include "cpu/direct/direct_tile-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

template <class T>
class DirectLines {
 public:
  static constexpr int kLanes = DirectTile<T>::kLanes, kLine = 16;

  // Whether that is quicker than copying byte by byte. It is not where cells have few lens columns, or vectors a single
  // lane.
  static constexpr bool pays(int lens_columns) { return kLanes >= 4 && lens_columns >= kLine / 2; }

  // Transpose `samples`, [patch][lens_column][lane], into `lines`, which holds four bytes a sample.
  DirectLines(const DirectTile<T>& tile, const uint8_t* samples, uint8_t* lines)
      : tile_(tile), lines_(lines), blocks_((tile.lens_columns() + kLine - 1) / kLine) {
    for (int64_t p = 0; p < tile.patches(); ++p)
      for (int64_t b = 0; b < blocks_; ++b)
        turn(samples + (p * tile.lens_columns() + b * kLine) * kLanes, lines + (p * blocks_ + b) * kBlock);
  }

  // Copy the transposed samples to an image whose rows are `stride` bytes long.
  void write(uint8_t* image, int64_t stride) const {
    const uint8_t* lines = lines_;
    const int64_t of_patch = blocks_ * kBlock;
    tile_.for_each_run([&](const auto& run) {
      const uint8_t* from = lines + run.patch * of_patch + run.lens_column / kLine * kBlock + run.lane * kLine;
      uint8_t* to = image + run.row * stride + run.first;
      int64_t left = run.count;
      for (int64_t place = run.lens_column % kLine; left > 0; from += kBlock, place = 0) {
        const int64_t count = std::min<int64_t>(left, kLine - place);
        // A line may be copied whole as long as it stays within the tile: the next run overwrites what is too much
        if (HWY_LIKELY(place == 0 && run.first + run.count - left + kLine <= run.tile_end))
          std::memcpy(to, from, kLine);
        else
          std::memcpy(to, from + place, size_t(count));
        to += count, left -= count;
      }
    });
  }

 private:
  static constexpr int kBlock = kLine * kLanes;  // bytes of a block, [lane][lens_column]

  // Transpose [16 lens_columns][lane] to [lane][16 lens_columns]. Interleaving the first half of the bytes with the
  // second moves the highest bit of their index to its end. Four times move all four bits of the lens column behind the
  // bits of the lane. A block that reaches beyond the last lens column has samples of the next patch there, which are
  // never copied.
  static HWY_INLINE void turn(const uint8_t* HWY_RESTRICT from, uint8_t* HWY_RESTRICT to) {
    if constexpr (kLanes >= 4) {
      const hn::FixedTag<uint8_t, kBlock / kLanes> d;
      hn::Vec<decltype(d)> v[kLanes], w[kLanes];
      for (int i = 0; i < kLanes; ++i) v[i] = hn::LoadU(d, from + kLine * i);
      for (int bit = 0; bit < 4; ++bit) {
        for (int i = 0; i < kLanes / 2; ++i) {
          w[2 * i] = hn::InterleaveLower(d, v[i], v[i + kLanes / 2]);
          w[2 * i + 1] = hn::InterleaveUpper(d, v[i], v[i + kLanes / 2]);
        }
        for (int i = 0; i < kLanes; ++i) v[i] = w[i];
      }
      for (int i = 0; i < kLanes; ++i) hn::StoreU(v[i], d, to + kLine * i);
    }
  }

  const DirectTile<T>& tile_;
  uint8_t* lines_;
  int64_t blocks_;
};

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_DIRECT_LINES_INL_H_
