// Bytes of a lens tile, turned from vectors of an ordinal into runs of sub-pixels 16 at a time and copied to the image.

#if defined(LFGS_CPU_LENS_LINES_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_LENS_LINES_INL_H_
#undef LFGS_CPU_LENS_LINES_INL_H_
#else
#define LFGS_CPU_LENS_LINES_INL_H_
#endif

#include <algorithm>
#include <cstring>

#include "cpu/lens/lens_tile-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

template <class T>
class LensLines {
 public:
  static constexpr int kLanes = LensTile<T>::kLanes, kLine = 16;

  // Lines of a few ordinals, or of a single lane, are as quickly read where they are.
  static constexpr bool pays(int ordinals) { return kLanes >= 4 && ordinals >= kLine / 2; }

  // samples: [patch][ordinal][lane], lines: room for four bytes a sample.
  LensLines(const LensTile<T>& tile, const uint8_t* samples, uint8_t* lines)
      : tile_(tile), lines_(lines), blocks_((tile.ordinals() + kLine - 1) / kLine) {
    for (int64_t p = 0; p < tile.patches(); ++p)
      for (int64_t b = 0; b < blocks_; ++b)
        turn(samples + (p * tile.ordinals() + b * kLine) * kLanes, lines + (p * blocks_ + b) * kBlock);
  }

  // Rows of the image are `stride` bytes.
  void write(uint8_t* image, int64_t stride) const {
    const uint8_t* lines = lines_;
    const int64_t of_patch = blocks_ * kBlock;
    tile_.for_each_run([&](const auto& run) {
      const uint8_t* from = lines + run.patch * of_patch + run.ordinal / kLine * kBlock + run.lane * kLine;
      uint8_t* to = image + run.row * stride + run.first;
      int64_t left = run.count;
      for (int64_t place = run.ordinal % kLine; left > 0; from += kBlock, place = 0) {
        const int64_t count = std::min<int64_t>(left, kLine - place);
        // What is too much is of the next run, which writes over it
        if (HWY_LIKELY(place == 0 && run.first + run.count - left + kLine <= run.tile_end))
          std::memcpy(to, from, kLine);
        else
          std::memcpy(to, from + place, size_t(count));
        to += count, left -= count;
      }
    });
  }

 private:
  static constexpr int kBlock = kLine * kLanes;  // [lane][ordinal]

  // [16 ordinals][lane] -> [lane][16 ordinals]: a riffle of the two halves moves a bit of the ordinal behind those of
  // the lane. What lies behind the last ordinal is of the next patch, and never copied.
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

  const LensTile<T>& tile_;
  uint8_t* lines_;
  int64_t blocks_;
};

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_LENS_LINES_INL_H_
