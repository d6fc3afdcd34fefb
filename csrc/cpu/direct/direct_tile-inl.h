// A tile of the panel: the positions and the state of its samples, and which of them a splat may touch. It is laid out
// by LensLayout, and direct_blend-inl.h blends splats into it.
//
// A sample is a sub-pixel; a *cell* is a lens, and the lens column t counts the sub-pixels of a lens from its left
// edge. Samples at one lens column of neighbouring lenses show nearly the same view. So a vector holds 4 lenses x a few
// rows at one lens column. A splat sweeps over the views along a row, and meets a short interval of lens columns per
// patch of lenses. Lenses too narrow or too wide for that become cells of one sub-pixel each.

#if defined(LFGS_CPU_DIRECT_TILE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_DIRECT_TILE_INL_H_
#undef LFGS_CPU_DIRECT_TILE_INL_H_
#else
#define LFGS_CPU_DIRECT_TILE_INL_H_
#endif

#include <algorithm>
#include <cmath>
#include <vector>

#include "cpu/direct/lens_layout.h"
#include "cpu/direct/sample_placer-inl.h"
#include "hwy/aligned_allocator.h"
#include "hwy/highway.h"
#include "math/blend-inl.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// The terms of a splat's exponent that depend on the row, for one group of rows. A group is the rows of a vector, with
// a number for each lane.
template <class T, int kLanes>
struct RowTerms {
  alignas(64) T A[kLanes];   // log2 opacity - tau dy^2
  alignas(64) T M0[kLanes];  // u0 + c0 dy, from the tile's origin
  alignas(64) T M1[kLanes];  // du + c1 dy
  alignas(64) T dy[kLanes];
};

// RowTerms in registers, for loops over the vectors of one group of rows.
template <class D>
struct RowVectors {
  hn::Vec<D> A, M0, M1;

  template <class Rows>
  HWY_INLINE explicit RowVectors(const Rows& rows)
      : A(hn::Load(D(), rows.A)), M0(hn::Load(D(), rows.M0)), M1(hn::Load(D(), rows.M1)) {}
};

// Read a term of RowTerms or of RowVectors.
template <class D>
HWY_INLINE hn::Vec<D> Term(D d, const hn::TFromD<D>* term) {
  return hn::Load(d, term);
}
template <class D>
HWY_INLINE hn::Vec<D> Term(D, hn::Vec<D> term) {
  return term;
}

// The units that a footprint wants RowTerms in: A becomes power * (A + level), and M0 and M1 are multiplied by `place`.
template <class T>
struct RowUnits {
  T power = 1, level = 0, place = 1;
};

template <class T>
class DirectTile {
 public:
  using D = Tag<T>;
  using V = hn::Vec<D>;
  using TI = hn::TFromD<hn::RebindToSigned<D>>;
  static constexpr int kLanes = int(hn::MaxLanes(D()));
  static constexpr int kCellsPerPatch = kLanes < 4 ? kLanes : 4, kRows = kLanes / kCellsPerPatch;
  static constexpr int kDown = kBandRows / kRows;
  using Rows = RowTerms<T, kLanes>;
  using Placer = SamplePlacer<T>;

  // Sample arrays, [patch][lens_column][lane]; a *vector* is one (patch, lens column)
  hwy::AlignedFreeUniquePtr<T[]> x, s, colour, transmittance, gradient, total, prefix, g_offset;
  hwy::AlignedFreeUniquePtr<TI[]> channel;
  int open = 0;  // vectors that still take light

  // offsets: whether the gradients of the samples' offsets s are wanted, in the backward pass.
  DirectTile(const Lens& lens, const LensLayout& layout, bool backward, bool offsets)
      : lens_(lens),
        layout_(layout),
        placer_(lens, layout),
        across_(layout.cells_per_tile / kCellsPerPatch),
        stride_(int64_t(row_stride(layout))),
        patches_(kDown * across_),
        samples_(layout.samples()) {
    // Memory
    const size_t n = size_t(samples_), vectors = n / kLanes;
    for (auto* a : {&x, &s, &colour, &transmittance}) *a = hwy::AllocateAligned<T>(n);
    if (backward)
      for (auto* a : {&gradient, &total, &prefix}) *a = hwy::AllocateAligned<T>(n);
    if (offsets) g_offset = hwy::AllocateAligned<T>(n);
    channel = hwy::AllocateAligned<TI>(n);
    padded_ = (patches_ + kLanes - 1) / kLanes * kLanes;
    for (auto* a : {&patch_row_, &patch_sample_, &patch_x_, &patch_s_, &patch_half_s_})
      *a = hwy::AllocateAligned<T>(size_t(padded_));
    for (auto* a : {&first_sample_, &count_}) *a = hwy::AllocateAligned<TI>(size_t(padded_));
    list_ = hwy::AllocateAligned<uint16_t>(vectors + 64);
    alive_.resize(vectors), row_of_vector_.resize(vectors);
    starts_.resize(size_t(place(kBandRows, 0)));
    if (layout.lead) anchors_.resize(starts_.size());

    // The rows of vectors, patches and lanes; what pads the patches to whole vectors is out of reach
    for (size_t v = 0; v < vectors; ++v) row_of_vector_[v] = uint8_t(v / size_t(layout.lens_columns * across_));
    for (int64_t p = 0; p < padded_; ++p) {
      const bool real = p < patches_;
      patch_row_[p] = real ? T(first_row(p / across_)) + middle_row() + T(0.5) : T(1e9);
      patch_sample_[p] = T(p * layout.lens_columns * kLanes);
      patch_x_[p] = patch_s_[p] = patch_half_s_[p] = T(0);
    }
    for (int lane = 0; lane < kLanes; ++lane) row_of_lane_[lane] = T(lane / kCellsPerPatch * stride_) + T(0.5);
  }

  int64_t bytes() const {
    return samples_ * int64_t(sizeof(T)) * ((gradient ? 8 : 5) + (g_offset ? 1 : 0)) + int64_t(sizeof(*this)) +
           samples_ / kLanes * 6;
  }

  // Make this the tile of cells [cell0, cell0 + cells_per_tile) of the band that starts at row0.
  void move_to(int64_t row0, int64_t cell0) {
    row0_ = row0, cell0_ = cell0;
    x0_ = std::floor(layout_.cell_x(double(cell0) + 0.5 * layout_.cells_per_tile, double(row0) + 0.5 * kBandRows));

    // Nothing is drawn yet
    std::fill(transmittance.get(), transmittance.get() + samples_, T(1));
    std::fill(colour.get(), colour.get() + samples_, T(0));
    std::fill(alive_.begin(), alive_.end(), uint8_t(1));
    open = int(alive_.size());

    // Where cells begin in each row
    for (int64_t r = 0; r < kBandRows; ++r)
      for (int64_t c = 0; c <= layout_.cells_per_tile; ++c) {
        start(r, c) = layout_.cell_start(lens_, row0 + r, cell0 + c);
        if (layout_.lead)
          anchors_[size_t(place(r, c))] = layout_.first_stripe(lens_, row0 + r, cell0 + c) - layout_.lead;
      }

    // Samples
    for (int64_t patch = 0; patch < patches_; ++patch)
      lens_.has_cells ? place_patch<true>(patch) : place_patch<false>(patch);
  }

  // Find the vectors that the splat may touch: the first sample of each is list()[0 .. result), and the
  // rows of each are filled.
  HWY_INLINE int64_t find(const Splat<T>& splat, const RowUnits<T>& units = {}) {
    const D d;
    const T u = T(double(splat.u0) - x0_), v = splat.v0 - T(row0_);

    // The groups of rows that it reaches, and their patches
    const T block = T(kRows * stride_), margin = T(0.01);
    const T top = (v - splat.reach_y - T(0.5) - margin) / block, bottom = (v + splat.reach_y - T(0.5) + margin) / block;
    const int64_t first_down = stride_ * int64_t(std::min(std::max(top, T(0)), T(kDown)));
    const int64_t end_down = stride_ * int64_t(std::min(std::max(bottom + T(1), T(0)), T(kDown)));
    first_ = std::min<int64_t>(first_down, kDown), end_ = std::min<int64_t>(end_down, kDown);
    fill_rows(splat, u, v, units);

    // A patch at a time, which lens columns t may be touched. At lens column t the samples lie X + t slope right of the
    // splat, in the middle row of the patch. The splat may touch them where |X + t slope| <= reach
    const T half = middle_row();
    const T spread = layout_.half_patch_px + half * (std::abs(splat.c0 + T(layout_.shear / 3)) + std::abs(splat.c1));
    const T left = splat.S0 - splat.S1 + splat.S2, right = splat.S0 + splat.S1 + splat.S2;
    const V widest = hn::Set(d, std::max(left, right)), zero = hn::Zero(d);
    const hn::RebindToSigned<D> di;
    for (int64_t p = first_ * across_ / kLanes * kLanes; p < end_ * across_; p += kLanes) {
      // Half width w of the splat in the nearest row, and what the samples spread
      const V middle = hn::Sub(hn::Load(d, &patch_row_[p]), hn::Set(d, v));
      const V nearest = hn::Max(hn::Sub(hn::Abs(middle), hn::Set(d, half)), zero);
      const V exponent = hn::NegMulAdd(hn::Mul(hn::Set(d, splat.tau), nearest), nearest,
                                       hn::Set(d, exponent_left(splat, T(0)) + T(1e-3)));
      const V w = hn::Add(hn::Sqrt(hn::Max(hn::Mul(exponent, widest), zero)), hn::Set(d, spread));

      // Distance at lens column 0, its change per lens column, and the reach
      const V M0 = hn::MulAdd(hn::Set(d, splat.c0), middle, hn::Set(d, u));
      const V M1 = hn::MulAdd(hn::Set(d, splat.c1), middle, hn::Set(d, splat.du));
      V slope = hn::NegMulAdd(hn::Set(d, T(layout_.s_per_column)), M1, hn::Set(d, T(layout_.x_per_column)));
      const V tiny = hn::Set(d, T(1e-6));
      slope = hn::IfThenElse(hn::Lt(hn::Abs(slope), tiny), tiny, slope);
      const V X = hn::NegMulAdd(hn::Load(d, &patch_s_[p]), M1, hn::Sub(hn::Load(d, &patch_x_[p]), M0));
      const V reach = hn::MulAdd(hn::Abs(M1), hn::Load(d, &patch_half_s_[p]), w);

      // The interval of lens columns, empty where the rows do not meet
      const V per_slope = hn::Div(hn::Set(d, T(1)), slope);
      const V t1 = hn::Mul(hn::Neg(hn::Add(X, reach)), per_slope), t2 = hn::Mul(hn::Sub(reach, X), per_slope);
      const V low = hn::Ceil(hn::Max(hn::Min(t1, t2), zero));
      const V high = hn::Floor(hn::Min(hn::Max(t1, t2), hn::Set(d, T(layout_.lens_columns - 1))));
      V count = hn::Max(hn::Sub(hn::Add(high, hn::Set(d, T(1))), low), zero);
      count = hn::IfThenElseZero(hn::Ge(exponent, zero), count);
      const V first =
          hn::MulAdd(hn::Min(low, hn::Set(d, T(64))), hn::Set(d, T(kLanes)), hn::Load(d, &patch_sample_[p]));
      hn::Store(hn::ConvertTo(di, first), di, &first_sample_[p]);
      hn::Store(hn::ConvertTo(di, count), di, &count_[p]);
    }
    return fill_list();
  }

  const uint16_t* list() const { return list_.get(); }
  // The rows of a vector, by its first sample.
  const Rows& rows(uint16_t sample) const { return rows_[row_of_vector_[sample / kLanes]]; }
  // Call visit(rows, begin, end) for every group of rows in which find() has listed vectors.
  template <class Visit>
  HWY_INLINE void for_each_group(const Visit& visit) const {
    const uint16_t* begin = list_.get();
    for (int down = 0; down < kDown; ++down) {
      const uint16_t* end = list_.get() + ends_[down];
      if (begin < end) visit(rows_[down], begin, end);
      begin = end;
    }
  }

  // Leave the vector that begins with this sample out of later lists, for none of its samples takes light any more.
  void retire(uint16_t sample) {
    open -= alive_[sample / kLanes];
    alive_[sample / kLanes] = 0;
  }

  // Retire the vectors in which every sample lets less than `least` through.
  void retire_below(T least) {
    const D d;
    const V limit = hn::Set(d, least);
    for (size_t v = 0; v < alive_.size(); ++v)
      if (alive_[v] && hn::AllTrue(d, hn::Lt(hn::Load(d, &transmittance[v * kLanes]), limit)))
        retire(uint16_t(v * kLanes));
  }

  // The sub-pixels of one cell in one row, the first of them at `lens_column`. Those that follow belong to the same
  // tile up to `tile_end`, which is the first that does not.
  struct Run {
    int64_t row, first, count, tile_end, patch, lens_column, lane;
  };
  // Call visit(run) for all runs on the panel, those of a row from left to right. Members are copied first, since to
  // the compiler the bytes that a visit writes could change any of them.
  template <class Visit>
  HWY_INLINE void for_each_run(const Visit& visit) const {
    const int64_t cells = layout_.cells_per_tile, width = 3 * lens_.width_px, across = across_, row0 = row0_;
    const int64_t rows = std::min<int64_t>(kBandRows, lens_.height_px - row0);
    const int64_t* starts = starts_.data();
    for (int64_t r = 0; r < rows; ++r, starts += cells + 1) {
      const int64_t tile_end = std::min(starts[cells], width);
      const int64_t block = kRows * stride_, within = r % block, down = r / block * stride_ + within % stride_;
      const int64_t patch = down * across, lane = within / stride_ * kCellsPerPatch;
      for (int64_t c = 0; c < cells; ++c) {
        const int64_t begin = std::max<int64_t>(starts[c], 0), end = std::min(starts[c + 1], width);
        if (begin < end)
          visit(Run{row0 + r, begin, end - begin, tile_end, patch + c / kCellsPerPatch, begin - anchor(r, c),
                    lane + c % kCellsPerPatch});
      }
    }
  }
  // The sample of a run's first sub-pixel; the next sub-pixel's is kLanes further on.
  int64_t sample(const Run& run) const {
    return (run.patch * layout_.lens_columns + run.lens_column) * kLanes + run.lane;
  }
  int64_t patches() const { return patches_; }
  int lens_columns() const { return layout_.lens_columns; }

 private:
  // How many rows lie from one row of a group to the next. Lenses lean, so that what a lens shows at a lens column
  // moves from row to row by a fraction of a lens column. If the rows of a group show nearly the same, a splat meets
  // them at fewer lens columns. This is the stride for which the parts differ least. A longer one makes groups taller,
  // which costs about as much as a twentieth of a lens column a row.
  static int row_stride(const LensLayout& layout) {
    int best = 1;
    double least = 2;
    for (int stride = 1; layout.by_lens && stride * kRows <= kBandRows; stride *= 2) {
      double low = 0, high = 0;
      for (int row = 1; row < kRows; ++row) {
        const double edge = layout.shear * stride * row, part = edge - std::round(edge);
        low = std::min(low, part), high = std::max(high, part);
      }
      const double cost = high - low + 0.05 * stride * (kRows - 1);
      if (cost < least) least = cost, best = stride;
    }
    return best;
  }
  // The first row of a group, and how far below it the middle of its rows lies.
  int64_t first_row(int64_t down) const { return down / stride_ * stride_ * kRows + down % stride_; }
  T middle_row() const { return T(0.5) * T((kRows - 1) * stride_); }

  // The first sub-pixel of cell c of the tile in row r of the band.
  int64_t& start(int64_t r, int64_t c) { return starts_[size_t(place(r, c))]; }
  int64_t start(int64_t r, int64_t c) const { return starts_[size_t(place(r, c))]; }
  // The sub-pixel at lens column 0 of the cell, which may belong to the cell before it: see LensLayout::lead.
  int64_t anchor(int64_t r, int64_t c) const { return layout_.lead ? anchors_[size_t(place(r, c))] : start(r, c); }
  int64_t place(int64_t r, int64_t c) const { return r * (layout_.cells_per_tile + 1) + c; }

  // Fill the terms of all groups of rows for a splat at (u, v) from the tile's origin.
  HWY_INLINE void fill_rows(const Splat<T>& splat, T u, T v, const RowUnits<T>& units) {
    const D d;
    const V lane_rows = hn::Load(d, row_of_lane_);
    const V tau = hn::Set(d, splat.tau * units.power), A = hn::Set(d, (splat.log2_opacity + units.level) * units.power);
    const V c0 = hn::Set(d, splat.c0 * units.place), c1 = hn::Set(d, splat.c1 * units.place);
    const V u0 = hn::Set(d, u * units.place), du = hn::Set(d, splat.du * units.place);
    for (int64_t down = first_; down < end_; ++down) {
      Rows& rows = rows_[down];
      const V dy = hn::Add(lane_rows, hn::Set(d, T(first_row(down)) - v));
      hn::Store(dy, d, rows.dy);
      hn::Store(hn::NegMulAdd(hn::Mul(tau, dy), dy, A), d, rows.A);
      hn::Store(hn::MulAdd(c0, dy, u0), d, rows.M0);
      hn::Store(hn::MulAdd(c1, dy, du), d, rows.M1);
    }
  }

  // Make one flat list of vectors from the ranges of lens_columns. Every patch writes at least eight entries, and the
  // next patch overwrites the surplus. So only a patch with more takes a branch. That is rare for small splats and the
  // rule for large ones; processors predict both.
  HWY_INLINE int64_t fill_list() {
    const hn::FixedTag<uint16_t, 8> d16;
    const auto steps = hn::Mul(hn::Iota(d16, uint16_t(0)), hn::Set(d16, uint16_t(kLanes)));
    const auto eight = hn::Set(d16, uint16_t(8 * kLanes));
    uint16_t* list = list_.get();
    const TI *first_samples = first_sample_.get(), *counts = count_.get();
    const int64_t across = across_, first = first_, last = end_;
    int64_t size = 0;
    std::fill_n(ends_, first, 0);
    for (int64_t down = first; down < last; ++down) {
      for (int64_t p = down * across, end = p + across; p < end; ++p) {
        auto entries = hn::Add(steps, hn::Set(d16, uint16_t(first_samples[p])));
        hn::StoreU(entries, d16, list + size);
        const int64_t count = counts[p];
        for (int64_t k = 8; HWY_UNLIKELY(k < count); k += 8) {
          entries = hn::Add(entries, eight);
          hn::StoreU(entries, d16, list + size + k);
        }
        size += count;
      }
      ends_[down] = size;
    }
    std::fill_n(ends_ + last, kDown - last, size);
    // Retired vectors do no harm in the list: a few are quicker blended than dropped
    if (HWY_LIKELY(8 * open > 7 * int(alive_.size()))) return size;

    // Drop the retired ones, group by group
    int64_t kept = 0;
    for (int64_t k = 0, down = 0; down < kDown; ++down) {
      for (const int64_t end = ends_[down]; k < end; ++k) {
        const uint16_t sample = list[k];
        list[kept] = sample;
        kept += alive_[sample / kLanes];
      }
      ends_[down] = kept;
    }
    return kept;
  }

  // Place the samples of a patch, and find where the patch lies as a whole, for find().
  template <bool kCells>
  void place_patch(int64_t patch) {
    const int64_t down = patch / across_, across = patch % across_, first = patch * layout_.lens_columns * kLanes;
    typename Placer::LaneCell lanes[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const int64_t r = first_row(down) + lane / kCellsPerPatch * stride_,
                    c = across * kCellsPerPatch + lane % kCellsPerPatch;
      lanes[lane] = {row0_ + r, anchor(r, c), start(r, c), start(r, c + 1)};
    }
    const auto spread = placer_.template place<kCells>(lanes, int64_t(x0_), &x[first], &s[first], &channel[first]);

    const double cell = double(cell0_ + across * kCellsPerPatch) + 0.5 * (kCellsPerPatch - 1);
    patch_x_[patch] = T(layout_.cell_x(cell, double(row0_ + first_row(down)) + double(middle_row())) - x0_);
    patch_s_[patch] = layout_.by_lens ? T(layout_.s_of_column_0) : T(0.5) * (spread.s_low + spread.s_high);
    patch_half_s_[patch] =
        layout_.by_lens ? T(layout_.half_s) : std::max(T(0), T(0.5) * (spread.s_high - spread.s_low)) + T(1e-6);
    if (layout_.by_lens && !kCells) {
      // Where all sub-pixels stand in stripes, the phases of the lanes give a tighter bound than the layout
      patch_s_[patch] = T(layout_.s_of_phase(lens_, 0.5 * (spread.first_phase + spread.last_phase)));
      patch_half_s_[patch] = T(layout_.half_s_of_phases(lens_, spread.last_phase - spread.first_phase));
    }
  }

  const Lens& lens_;
  const LensLayout& layout_;
  const Placer placer_;
  int64_t across_, stride_, patches_, samples_, padded_;
  int64_t row0_ = 0, cell0_ = 0;
  double x0_ = 0;  // tile origin, pixels
  alignas(64) T row_of_lane_[kLanes];
  Rows rows_[kDown];
  // Of each patch: its middle row, its first sample, the mean x at lens column 0, and the centre and half spread of
  // offsets
  hwy::AlignedFreeUniquePtr<T[]> patch_row_, patch_sample_, patch_x_, patch_s_, patch_half_s_;
  hwy::AlignedFreeUniquePtr<TI[]> first_sample_, count_;  // of each patch, the range of vectors that a splat may touch
  hwy::AlignedFreeUniquePtr<uint16_t[]> list_;            // of vectors, by their first samples
  int64_t first_ = 0, end_ = 0;                           // the groups of rows that the splat reaches
  int64_t ends_[kDown] = {};                              // where each group of rows ends in the list
  std::vector<uint8_t> alive_, row_of_vector_;
  std::vector<int64_t> starts_, anchors_;
};

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_DIRECT_TILE_INL_H_
