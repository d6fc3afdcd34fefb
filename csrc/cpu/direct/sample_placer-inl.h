// Place the samples of one patch of a tile: the x of each sub-pixel, its offset s and its channel.

#if defined(LFGS_CPU_SAMPLE_PLACER_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_SAMPLE_PLACER_INL_H_
#undef LFGS_CPU_SAMPLE_PLACER_INL_H_
#else
#define LFGS_CPU_SAMPLE_PLACER_INL_H_
#endif

#include <algorithm>
#include <vector>

#include "cpu/direct/lens_layout.h"
#include "hwy/highway.h"
#include "math/blend-inl.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

template <class T>
class SamplePlacer {
 public:
  using D = Tag<T>;
  using V = hn::Vec<D>;
  using TI = hn::TFromD<hn::RebindToSigned<D>>;
  static constexpr int kLanes = int(hn::MaxLanes(D()));

  // The cell in a row of one lane: its sub-pixel at lens column 0, its own first sub-pixel, and the first of the next
  // cell.
  struct LaneCell {
    int64_t row, anchor, start, next_start;
  };
  // Offsets of the samples on the panel, and phases of the lanes, from the lowest to the highest.
  struct Spread {
    T s_low, s_high;
    double first_phase, last_phase;
  };

  SamplePlacer(const Lens& lens, const LensLayout& layout) : lens_(lens), layout_(layout) {
    if (!lens.has_cells) return;
    for (int row = 0; row < kCellPeriod; ++row)
      for (int m = 0; m < kRowPeriod + layout.lens_columns; ++m)
        cells_.push_back({lens.phase_x * uint64_t(m) + lens.cells.phases[row][m % kRowPeriod],
                          lens.cells.channels[row][m % kRowPeriod]});
  }

  // Write x, from the pixel x0 on, s and channel of a patch: [lens_column][lane].
  template <bool kCells>
  Spread place(const LaneCell (&lane_cells)[kLanes], int64_t x0, T* x, T* s, TI* channel) const {
    const D d;
    const hn::RebindToSigned<D> di;

    // Per lane: where the cell starts, and which of its lens columns are sub-pixels of the panel
    alignas(64) TI outside[kLanes], ends[kLanes], places[kLanes];
    alignas(64) T columns[kLanes];
    alignas(64) uint64_t phases[kLanes];
    double first_phase = 1e30, last_phase = 0;
    [[maybe_unused]] const CellRow* cells[kLanes] = {};
    constexpr uint64_t kAbove = uint64_t(3) << 32;  // keeps numbers positive for cells that begin left of the panel
    const int64_t left = int64_t(kAbove / 3) + x0, width = 3 * lens_.width_px;
    for (int lane = 0; lane < kLanes; ++lane) {
      const LaneCell& cell = lane_cells[lane];
      const int64_t all = cell.row < lens_.height_px ? width : 0;
      const uint64_t above = uint64_t(cell.anchor) + kAbove, pixel = above / 3;
      outside[lane] = TI(std::max<int64_t>(cell.start, 0) - cell.anchor - 1);
      ends[lane] = TI(std::min(cell.next_start, all) - cell.anchor);
      places[lane] = TI(above - 3 * pixel), columns[lane] = T(int32_t(int64_t(pixel) - left)) + T(0.5);
      phases[lane] = lens_.phase_at(cell.row, cell.anchor);
      const double phase = double(phases[lane]);
      first_phase = std::min(first_phase, phase), last_phase = std::max(last_phase, phase);
      if constexpr (kCells) {
        const int64_t within = int64_t(above % kRowPeriod);
        cells[lane] = &cells_[size_t(cell.row % kCellPeriod * (kRowPeriod + layout_.lens_columns) + within)];
        phases[lane] -= lens_.phase_x * uint64_t(within);
      }
    }

    // Lens column by lens column, all lanes at once
    V column = hn::Load(d, columns), s_low = hn::Set(d, T(2)), s_high = hn::Set(d, T(-2));
    auto place = hn::Load(di, places);
    const auto before = hn::Load(di, outside), end = hn::Load(di, ends), two = hn::Set(di, TI(2));
    for (int t = 0; t < layout_.lens_columns; ++t, x += kLanes, s += kLanes, channel += kLanes) {
      const auto lens_column = hn::Set(di, TI(t));
      // Rebind the masks one by one: with one lane on ARM, GCC 12 takes the rebound conjunction for false
      const auto shown =
          hn::And(hn::RebindMask(d, hn::Gt(lens_column, before)), hn::RebindMask(d, hn::Lt(lens_column, end)));
      alignas(64) uint64_t in_cells[kLanes];
      alignas(64) TI channels[kLanes];
      if constexpr (kCells)
        for (int lane = 0; lane < kLanes; ++lane)
          in_cells[lane] = phases[lane] + cells[lane][t].phase, channels[lane] = TI(cells[lane][t].channel);
      const V offset = next_offsets(kCells ? in_cells : phases);
      s_low = hn::Min(s_low, hn::IfThenElse(shown, offset, s_low));
      s_high = hn::Max(s_high, hn::IfThenElse(shown, offset, s_high));

      // A lane without a sub-pixel of the panel stands where no splat reaches
      hn::Store(hn::IfThenElse(shown, column, hn::Set(d, T(1e9))), d, x);
      hn::Store(offset, d, s);
      hn::Store(kCells ? hn::Load(di, channels) : lens_.bgr ? hn::Sub(two, place) : place, di, channel);
      const auto last = hn::Eq(place, two);
      place = hn::IfThenZeroElse(last, hn::Add(place, hn::Set(di, TI(1))));
      column = hn::Add(column, hn::IfThenElseZero(hn::RebindMask(d, last), hn::Set(d, T(1))));
    }
    return {hn::GetLane(hn::MinOfLanes(d, s_low)), hn::GetLane(hn::MaxOfLanes(d, s_high)), first_phase, last_phase};
  }

 private:
  // A sub-pixel in a row of a panel with cells, counted from the start of a period. `phase` is relative to the phase of
  // stripe 0.
  struct CellRow {
    uint64_t phase;
    int64_t channel;
  };

  // Return the offsets s of the samples at these phases, exact but for the last rounding. Move the phases to the next
  // sub-pixel.
  HWY_INLINE V next_offsets(uint64_t* HWY_RESTRICT phases) const {
    const D d;
    if constexpr (kLanes == 1) {
      const uint64_t phase = *phases;
      *phases += lens_.phase_x;
      return hn::Set(d, T(layout_.s_start + layout_.s_step * camera_coordinate(lens_, phase)));
    } else {
      // camera_coordinate for half a vector at a time, in integers: the view, or for continuous cameras x / views in
      // units of 2^-31
      const hn::RebindToSigned<D> di;
      const hn::RepartitionToWide<hn::RebindToUnsigned<D>> d64;
      const hn::RebindToUnsigned<D> d32;
      const auto views = hn::BitCast(d32, hn::Set(d64, uint64_t(lens_.views)));
      auto next = [&](uint64_t* at) {
        const auto phase = hn::Load(d64, at), high = hn::ShiftRight<32>(phase);
        hn::Store(hn::Add(phase, hn::Set(d64, lens_.phase_x)), d64, at);
        if (lens_.continuous) return hn::BitCast(d32, hn::ShiftRight<1>(high));
        const auto carry = hn::ShiftRight<32>(hn::MulEven(hn::BitCast(d32, phase), views));
        return hn::BitCast(d32, hn::ShiftRight<32>(hn::Add(hn::MulEven(hn::BitCast(d32, high), views), carry)));
      };
      const auto low = next(phases), integers = hn::ConcatEven(d32, next(phases + kLanes / 2), low);
      const double unit = lens_.continuous ? double(lens_.views) / 2147483648.0 : 1, half = lens_.continuous ? 0 : 0.5;
      return hn::MulAdd(hn::ConvertTo(d, hn::BitCast(di, integers)), hn::Set(d, T(layout_.s_step * unit)),
                        hn::Set(d, T(layout_.s_start + layout_.s_step * half)));
    }
  }

  const Lens& lens_;
  const LensLayout& layout_;
  std::vector<CellRow> cells_;  // [kCellPeriod][kRowPeriod + lens_columns]
};

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_SAMPLE_PLACER_INL_H_
