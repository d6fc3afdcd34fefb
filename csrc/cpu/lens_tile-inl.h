// Tiles of the lens sensor. A sample is a sub-pixel; a *cell* is a lens, and t counts the sub-pixels of a lens from its
// left edge (the ordinal). Samples at one ordinal of neighbouring lenses show nearly the same view, so a vector holds
// 4 lenses x a few rows at one ordinal, and a splat, which sweeps over the views along a row, meets a short interval of
// ordinals per patch of lenses. Lenses too narrow or too wide for that become cells of one sub-pixel each.

#if defined(LFGS_CPU_LENS_TILE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_LENS_TILE_INL_H_
#undef LFGS_CPU_LENS_TILE_INL_H_
#else
#define LFGS_CPU_LENS_TILE_INL_H_
#endif

#include <algorithm>
#include <cmath>

#include "cpu/lens_layout.h"
#include "hwy/aligned_allocator.h"
#include "hwy/highway.h"
#include "math/blend-inl.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// Per-splat constants of one group of rows.
template <class V>
struct RowTerms {
  V A;   // log2 opacity - tau dy^2
  V M0;  // u0 + c0 dy, from the tile's origin
  V M1;  // du + c1 dy
  V dy;
};

template <class T>
class LensTile {
 public:
  using D = Tag<T>;
  using V = hn::Vec<D>;
  using TI = hn::TFromD<hn::RebindToSigned<D>>;
  static constexpr int kLanes = int(hn::MaxLanes(D()));
  static constexpr int kCellsPerPatch = kLanes < 4 ? kLanes : 4, kRows = kLanes / kCellsPerPatch;
  static constexpr int kDown = kBandRows / kRows;

  // Sample arrays, [patch][ordinal][lane]; see patch_index
  hwy::AlignedFreeUniquePtr<T[]> x, s, colour, transmittance, gradient, total, prefix;
  hwy::AlignedFreeUniquePtr<TI[]> channel;
  int open = 0;  // vectors that still take light

  LensTile(const Lens& lens, const LensLayout& layout, bool backward)
      : lens_(lens), layout_(layout), across_(layout.cells_per_tile / kCellsPerPatch), samples_(layout.samples()) {
    const size_t n = size_t(samples_);
    for (auto* a : {&x, &s, &colour, &transmittance}) *a = hwy::AllocateAligned<T>(n);
    if (backward)
      for (auto* a : {&gradient, &total, &prefix}) *a = hwy::AllocateAligned<T>(n);
    channel = hwy::AllocateAligned<TI>(n);
    patches_ = hwy::AllocateAligned<Patch>(size_t(kDown * across_));
    alignas(64) T rows[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) rows[lane] = T(lane / kCellsPerPatch) + T(0.5);
    std::copy(rows, rows + kLanes, row_of_lane_);
  }

  int64_t bytes() const { return samples_ * int64_t(sizeof(T)) * (gradient ? 8 : 5); }

  // Makes this the tile of cells [cell0, cell0 + cells_per_tile) of the band that starts at row0.
  void move_to(int64_t row0, int64_t cell0) {
    row0_ = row0, cell0_ = cell0;
    x0_ = std::floor(layout_.cell_x(double(cell0) + 0.5 * layout_.cells_per_tile, double(row0) + 0.5 * kBandRows));
    std::fill(transmittance.get(), transmittance.get() + samples_, T(1));
    std::fill(colour.get(), colour.get() + samples_, T(0));
    open = kDown * across_ * layout_.ordinals;
    for (int down = 0; down < kDown; ++down)
      for (int across = 0; across < across_; ++across) place_patch(down, across);
  }

  // Calls visit(first sample, RowTerms, retire) for every vector that the splat may touch. retire() takes the vector
  // out of later walks: no sample of it takes light any more.
  template <class Visit>
  HWY_INLINE void for_each_vector(const Splat<T>& splat, const Visit& visit) {
    const D d;
    const T u = T(double(splat.u0) - x0_), v = T(splat.v0 - T(row0_));
    const Range rows = pixels_within(v - splat.reach_y, v + splat.reach_y, kBandRows);
    if (rows.last < rows.first) return;
    const V lane_rows = hn::Load(d, row_of_lane_);
    const T half = T(0.5) * T(kRows - 1), tan = T(layout_.shear / 3);
    const T spread = layout_.half_patch_px + half * (std::abs(splat.c0 + tan) + std::abs(splat.c1));
    for (int64_t down = rows.first / kRows; down <= rows.last / kRows; ++down) {
      // The footprint around the middle row of the group: centre M0 + s M1, half width w
      const T middle = T(down * kRows) + T(0.5) * T(kRows) - v;
      const T nearest = std::max(T(0), std::abs(middle) - half);
      const T w = std::sqrt(square_reach_x(splat, nearest)) + spread;
      const T M0 = u + splat.c0 * middle, M1 = splat.du + splat.c1 * middle;
      const T slope = layout_.by_lens ? T(1.0 / 3) - T(layout_.s_per_ordinal) * M1 : T(1);
      const T per_slope = T(1) / (std::abs(slope) > T(1e-9) ? slope : T(1e-9));

      RowTerms<V> terms;
      terms.dy = hn::Add(lane_rows, hn::Set(d, T(down * kRows) - v));
      terms.A = hn::NegMulAdd(hn::Mul(hn::Set(d, splat.tau), terms.dy), terms.dy, hn::Set(d, splat.log2_opacity));
      terms.M0 = hn::MulAdd(hn::Set(d, splat.c0), terms.dy, hn::Set(d, u));
      terms.M1 = hn::MulAdd(hn::Set(d, splat.c1), terms.dy, hn::Set(d, splat.du));

      for (int across = 0; across < across_; ++across) {
        // |X + t slope| <= w + what the samples of an ordinal spread
        Patch& patch = patches_[size_t(down * across_ + across)];
        const T X = patch.x - M0 - patch.s * M1, reach = w + std::abs(M1) * patch.half_s;
        const T t1 = (-X - reach) * per_slope, t2 = (-X + reach) * per_slope;
        const T last_ordinal = T(layout_.ordinals - 1);
        const T low = std::ceil(std::max(std::min(t1, t2), T(0))), high = std::floor(std::min(std::max(t1, t2), last_ordinal));
        if (!(low <= high)) continue;
        uint64_t todo = patch.alive & (~0ull << int(low)) & (~0ull >> (63 - int(high)));
        const int64_t first = (down * across_ + across) * layout_.ordinals;
        while (todo) {
          const int t = __builtin_ctzll(todo);
          todo &= todo - 1;
          visit((first + t) * kLanes, terms, [&patch, this, t] {
            patch.alive &= ~(1ull << t);
            --open;
          });
        }
      }
    }
  }

  // Calls visit(row, first sub-pixel, count, first sample) for every run of sub-pixels: one cell of one row. Sub-pixel
  // k of the run is the sample first + k * kLanes.
  template <class Visit>
  void for_each_run(const Visit& visit) const {
    for (int64_t r = 0; r < kBandRows && row0_ + r < lens_.height_px; ++r)
      for (int64_t c = 0; c < layout_.cells_per_tile; ++c) {
        const int64_t row = row0_ + r;
        const int64_t start = layout_.cell_start(lens_, row, cell0_ + c);
        const int64_t stop = std::min(layout_.cell_start(lens_, row, cell0_ + c + 1), 3 * lens_.width_px);
        const int64_t begin = std::max<int64_t>(start, 0);
        if (begin >= stop) continue;
        const int64_t patch = r / kRows * across_ + c / kCellsPerPatch;
        const int64_t lane = r % kRows * kCellsPerPatch + c % kCellsPerPatch;
        visit(row, begin, stop - begin, (patch * layout_.ordinals + begin - start) * kLanes + lane);
      }
  }

 private:
  struct Patch {
    T x, s, half_s;  // centre and half spread of its samples at ordinal 0: pixels from the tile's origin, offset
    uint64_t alive;  // bit per ordinal
  };

  void place_patch(int down, int across) {
    const int64_t index = down * across_ + across;
    T s_low = T(2), s_high = T(-2);
    for (int lane = 0; lane < kLanes; ++lane) {
      const int64_t row = row0_ + down * kRows + lane / kCellsPerPatch;
      const int64_t cell = cell0_ + across * kCellsPerPatch + lane % kCellsPerPatch;
      const int64_t start = layout_.cell_start(lens_, row, cell);
      const int64_t count = std::min<int64_t>(layout_.cell_start(lens_, row, cell + 1) - start, layout_.ordinals);
      int64_t sample = index * layout_.ordinals * kLanes + lane;
      for (int64_t t = 0; t < layout_.ordinals; ++t, sample += kLanes) {
        // Lanes without a sub-pixel of the panel stand where no splat reaches
        const int64_t m = start + t;
        const bool real = t < count && m >= 0 && m < 3 * lens_.width_px && row < lens_.height_px;
        const int64_t j = m >= 0 ? m / 3 : 0, k = real ? m - 3 * j : 0;
        x[sample] = real ? T(double(j) + 0.5 - x0_) : T(1e9);
        const double coordinate = camera_coordinate(lens_, lens_.phase_at(row, m));
        s[sample] = real ? T(layout_.s_start + layout_.s_step * coordinate) : T(0);
        channel[sample] = TI(lens_.bgr ? 2 - k : k);
        if (real) s_low = std::min(s_low, s[sample]), s_high = std::max(s_high, s[sample]);
      }
    }
    Patch& patch = patches_[size_t(index)];
    patch.alive = ~0ull >> (64 - layout_.ordinals);
    const double cell = double(cell0_ + across * kCellsPerPatch) + 0.5 * (kCellsPerPatch - 1);
    patch.x = T(layout_.cell_x(cell, double(row0_ + down * kRows) + 0.5 * (kRows - 1)) - x0_);
    patch.s = layout_.by_lens ? T(layout_.s_of_ordinal_0) : T(0.5) * (s_low + s_high);
    patch.half_s = layout_.by_lens ? T(layout_.half_s) : std::max(T(0), T(0.5) * (s_high - s_low)) + T(1e-6);
  }

  const Lens& lens_;
  const LensLayout& layout_;
  int64_t across_, samples_;
  int64_t row0_ = 0, cell0_ = 0;
  double x0_ = 0;  // tile origin, pixels
  alignas(64) T row_of_lane_[kLanes];
  hwy::AlignedFreeUniquePtr<Patch[]> patches_;
};

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_LENS_TILE_INL_H_
