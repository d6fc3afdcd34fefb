// A coarse lattice over a part of the panel. LatticeNodes draws the light field at its nodes, all three channels at
// once. LatticeErrors holds the errors of interpolation between them. LatticeRow interpolates, a row at a time. A plan
// says where the nodes are (math/lattice_plan.h), direct_lattice-inl.h decides which tiles are drawn from a lattice.

#if defined(LFGS_CPU_LATTICE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_LATTICE_INL_H_
#undef LFGS_CPU_LATTICE_INL_H_
#else
#define LFGS_CPU_LATTICE_INL_H_
#endif

#include <algorithm>
#include <cmath>
#include <vector>

#include "hwy/aligned_allocator.h"
#include "hwy/highway.h"
#include "math/blend-inl.h"
#include "math/colour_circle.h"
#include "math/footprint.h"
#include "math/lattice_plan.h"
#include "math/quality.h"
#include "stages/stages.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// Colours and transmittances at the nodes of a plan: [plane][down][row], where a row is padded to whole vectors.
class LatticeNodes {
 public:
  using D = Tag<float>;
  using V = hn::Vec<D>;
  static constexpr int kLanes = int(hn::MaxLanes(D()));
  int64_t evaluations = 0;

  // Lay the nodes out with nothing drawn. Places in the plan are relative to an origin that the caller chooses.
  void lay(const LatticePlan& plan) {
    plan_ = plan, row_ = (plan.across + kLanes - 1) / kLanes * kLanes;
    stride_ = int64_t(row_) * plan.down * plan.planes;
    grow(transmittance_, size_t(stride_)), grow(colours_, 3 * size_t(stride_));
    const size_t lines = size_t(plan.planes) * size_t(plan.down);
    for (auto* a : {&s_, &y_, &A_, &middle_, &scale_}) grow(*a, lines);
    for (auto* a : {&block_, &blocks_}) grow(*a, lines);
    grow(list_, size_t(stride_ / kLanes));
    grow(splat_colours_, kColourStride * size_t(plan.planes));

    // The offset and y of each line; the nodes take all light, what pads their rows takes none
    for (int k = 0, line = 0; k < plan.planes; ++k)
      for (int j = 0; j < plan.down; ++j, ++line)
        s_.data[line] = plan.s0 + float(k) * plan.step_s, y_.data[line] = plan.y0 + float(j) * plan.step_y;
    for (int64_t i = 0; i < stride_; i += row_) {
      float* row = &transmittance_.data[i];
      std::fill(std::fill_n(row, plan.across, 1.f), row + row_, 0.f);
    }
    std::fill_n(colours_.data.get(), 3 * stride_, 0.f);
  }

  const LatticePlan& plan() const { return plan_; }
  int64_t bytes() const { return int64_t((transmittance_.size + colours_.size) * sizeof(float)); }
  // The colours of a channel on a row of a plane. A vector more may be read than the row has.
  const float* colours(int channel, int plane, int row) const {
    return colours_.data.get() + channel * stride_ + at(plane, row);
  }
  float* colours(int channel, int plane, int row) { return colours_.data.get() + channel * stride_ + at(plane, row); }
  // Whether no node takes any more light.
  bool opaque() const {
    const D d;
    auto most = hn::Zero(d);
    for (int64_t i = 0; i < stride_; i += kLanes) most = hn::Max(most, hn::Load(d, &transmittance_.data[i]));
    return hn::AllTrue(d, hn::Eq(most, hn::Zero(d)));
  }

  // Blend a splat whose centre is (u, v) from the plan's origin. colours: [order + 1, kColourStride], or on a circle;
  // compensation: the splat's, or null.
  HWY_NOINLINE void add(const Splat<float>& splat, const Compensation<float>* compensation, float u, float v,
                        const float* colours, int order, const Quality& quality, const float* background) {
    int first, last;
    if (!planes_touched(splat, u, v, first, last)) return;
    colours_on_planes(colours, order, first, last);
    reach_on_lines(splat, u, v, first * plan_.down, (last + 1) * plan_.down);
    if (HWY_UNLIKELY(compensation != nullptr)) compensate(splat, *compensation, first, last);
    const Block* end = list_blocks(first, last);
    for (const Block* block = list_.data.get(); block < end; ++block) blend(*block, quality, background);
  }

  // Add the background.
  void finish(const float* background) {
    const D d;
    for (int c = 0; c < 3; ++c)
      for (int64_t i = 0; i < stride_; i += kLanes) {
        float* to = &colours_.data[c * stride_ + i];
        hn::Store(hn::MulAdd(hn::Load(d, &transmittance_.data[i]), hn::Set(d, background[c]), hn::Load(d, to)), d, to);
      }
  }

 private:
  template <class T>
  struct Buffer {
    hwy::AlignedFreeUniquePtr<T[]> data;
    size_t size = 0;
  };
  template <class T>
  static void grow(Buffer<T>& buffer, size_t size) {
    size = (size + kLanes - 1) / kLanes * kLanes + kLanes + 1;
    if (size <= buffer.size) return;
    buffer.data = hwy::AllocateAligned<T>(size), buffer.size = size;
  }
  // A *line* is a row of nodes on a plane; a *block* is a vector of its nodes.
  struct Block {
    uint16_t line, plane;
    int32_t block;
  };
  static_assert(kMostPlanes * kMostRows <= 65536);
  static constexpr int kBlockBits = kLanes == 16 ? 4 : kLanes == 8 ? 3 : kLanes == 4 ? 2 : kLanes == 2 ? 1 : 0;
  static_assert(kLanes == 1 << kBlockBits);
  // Find the planes on which a splat may touch a node; false if there is none.
  HWY_INLINE bool planes_touched(const Splat<float>& splat, float u, float v, int& first, int& last) const {
    // The rows that the splat reaches, from its centre
    const float low = plan_.y0 - v, high = low + float(plan_.down - 1) * plan_.step_y;
    const float d1 = std::max(low, -splat.reach_y), d2 = std::min(high, splat.reach_y);
    if (!(d1 <= d2)) return false;

    // Its half width there, and its distances from the lattice's first and last column at s = 0
    const float nearest = std::max(d1, 0.f) + std::min(d2, 0.f), middle = (d1 + d2) / 2, half = (d2 - d1) / 2;
    const float reach =
        std::sqrt(square_reach_x(splat, nearest)) + (std::abs(splat.c0) + std::abs(splat.c1)) * half + 0.01f;
    const float left = plan_.x0 - u - splat.c0 * middle, right = left + float(plan_.across - 1) * plan_.step_x;

    // The offsets at which its sweep is over the columns, counted in planes
    const float sweep = splat.du + splat.c1 * middle;
    const float slope = std::abs(sweep) < 1e-6f ? 1e-6f : sweep;
    const float a = (left - reach) / slope, b = (right + reach) / slope;
    const float k0 = (std::min(a, b) - plan_.s0) / plan_.step_s, k1 = (std::max(a, b) - plan_.s0) / plan_.step_s;
    if (!(k0 <= float(plan_.planes - 1)) || !(k1 >= 0)) return false;
    first = k0 > 0 ? int(std::ceil(k0)) : 0, last = k1 < float(plan_.planes - 1) ? int(k1) : plan_.planes - 1;
    return first <= last;
  }

  // The colour of a splat at the offsets of the planes from first to last.
  HWY_INLINE void colours_on_planes(const float* colours, int order, int first, int last) {
    if (HWY_UNLIKELY(order == kCircleOrder)) return circle_on_planes(colours, first, last);
    const hn::CappedTag<float, 4> d4;
    for (int k = first; k <= last; ++k) {
      const auto s = hn::Set(d4, s_.data[k * plan_.down]);
      auto value = hn::LoadU(d4, colours + order * kColourStride);
      for (int p = order - 1; p >= 0; --p) value = hn::MulAdd(value, s, hn::LoadU(d4, colours + p * kColourStride));
      hn::StoreU(hn::Max(value, hn::Zero(d4)), d4, &splat_colours_.data[kColourStride * k]);
    }
  }

  HWY_NOINLINE void circle_on_planes(const float* colours, int first, int last) {
    const float place = colours[kPlaceTerm * kColourStride + 3], distance = colours[kDistanceTerm * kColourStride + 3];
    for (int k = first; k <= last; ++k) {
      const CirclePoint<float> point(place, distance, s_.data[k * plan_.down]);
      float* to = &splat_colours_.data[kColourStride * k];
      for (int c = 0; c < 3; ++c)
        to[c] = std::max(point.colour([&](int m) { return colours[m * kColourStride + c]; }), 0.f);
    }
  }

  // Multiply the opacity by the compensation on the planes from first to last: add log2 of it to A on their lines.
  HWY_NOINLINE void compensate(const Splat<float>& splat, const Compensation<float>& c, int first, int last) {
    for (int k = first, l = first * plan_.down; k <= last; ++k) {
      const float s = s_.data[l], D = c.D0 + s * (c.D1 + s * c.D2), S = splat.S0 + s * (splat.S1 + s * splat.S2);
      const float log2_compensation = D > 0 ? 0.5f * std::log2(D / S) : -1e3f;
      for (int j = 0; j < plan_.down; ++j, ++l) A_.data[l] += log2_compensation;
    }
  }

  // Find what a splat is on the lines [line, end): at node i log2 of its alpha is A - scale (i - middle)^2. Also find
  // in which blocks the nodes are that it touches.
  HWY_INLINE void reach_on_lines(const Splat<float>& splat, float u, float v, int line, int end) {
    const D d;
    const hn::RebindToSigned<D> di;
    const V zero = hn::Zero(d), step = hn::Set(d, plan_.step_x), per_x = hn::Set(d, 1 / plan_.step_x);
    const V last = hn::Set(d, float(plan_.across - 1));
    for (int l = line; l < end; l += kLanes) {
      // Exponent
      const V s = hn::LoadU(d, &s_.data[l]), dy = hn::Sub(hn::LoadU(d, &y_.data[l]), hn::Set(d, v));
      const V A = hn::NegMulAdd(hn::Mul(hn::Set(d, splat.tau), dy), dy, hn::Set(d, splat.log2_opacity));
      const V left = hn::Sub(A, hn::Set(d, float(kLog2MinAlpha)));
      const V S = hn::MulAdd(hn::MulAdd(s, hn::Set(d, splat.S2), hn::Set(d, splat.S1)), s, hn::Set(d, splat.S0));
      const V m0 = hn::MulAdd(hn::Set(d, splat.c0), dy, hn::Set(d, u - plan_.x0));
      const V m1 = hn::MulAdd(hn::Set(d, splat.c1), dy, hn::Set(d, splat.du));
      const V middle = hn::Mul(hn::MulAdd(s, m1, m0), per_x);

      // Nodes that are touched, from the first to the last
      const V half = hn::MulAdd(hn::Sqrt(hn::Max(hn::Mul(left, S), zero)), per_x, hn::Set(d, 1e-3f));
      const V from = hn::Max(hn::Ceil(hn::Sub(middle, half)), zero);
      const V to = hn::Min(hn::Floor(hn::Add(middle, half)), last);
      hn::StoreU(A, d, &A_.data[l]), hn::StoreU(middle, d, &middle_.data[l]);
      hn::StoreU(hn::Mul(hn::Mul(step, step), Reciprocal(d, S)), d, &scale_.data[l]);
      // Where the splat touches a node, both are within the row
      const auto touched = hn::And(hn::Ge(left, zero), hn::Le(from, to));
      auto to_block = [&](V node) {
        return hn::ShiftRight<kBlockBits>(hn::ConvertTo(di, hn::IfThenElseZero(touched, node)));
      };
      const auto block = to_block(from), blocks = hn::Add(hn::Sub(to_block(to), block), hn::Set(di, 1));
      hn::StoreU(block, di, &block_.data[l]);
      hn::StoreU(hn::IfThenElseZero(hn::RebindMask(di, touched), blocks), di, &blocks_.data[l]);
    }
  }

  // List the blocks that the splat touches on the planes from first to last, and return the list's end. Every line
  // writes two blocks, and the next line overwrites the surplus. So only lines with more blocks branch, and they are
  // rare.
  HWY_INLINE const Block* list_blocks(int first, int last) {
    Block* to = list_.data.get();
    for (int k = first, l = first * plan_.down; k <= last; ++k)
      for (int j = 0; j < plan_.down; ++j, ++l) {
        const int block = block_.data[l], blocks = blocks_.data[l];
        const uint16_t line = uint16_t(l), plane = uint16_t(k);
        to[0] = {line, plane, block}, to[1] = {line, plane, block + 1};
        for (int more = 2; HWY_UNLIKELY(more < blocks); ++more) to[more] = {line, plane, block + more};
        to += blocks;
      }
    return to;
  }

  int64_t at(int plane, int row) const { return int64_t(plane * plan_.down + row) * row_; }

  // Blend the splat at hand into the nodes of a block.
  HWY_INLINE void blend(Block block, const Quality& quality, const float* background) {
    const D d;
    evaluations += kLanes;
    const int l = block.line, i = block.block * kLanes;
    const V dx = hn::Add(hn::Iota(d, 0.f), hn::Set(d, float(i) - middle_.data[l]));
    const V power = hn::NegMulAdd(hn::Mul(dx, dx), hn::Set(d, scale_.data[l]), hn::Set(d, A_.data[l]));
    const auto lit = hn::Ge(power, hn::Set(d, float(kLog2MinAlpha)));
    const V alpha = hn::IfThenElseZero(lit, hn::Min(Exp2<4>(d, power), hn::Set(d, float(kMaxAlpha))));

    // Weight; a node whose transmittance would fall too low ends here
    const int64_t node = int64_t(l) * row_ + i;
    float *left = &transmittance_.data[node], *sum = &colours_.data[node];
    const V before = hn::Load(d, left);
    V weight = hn::Mul(alpha, before), after = hn::Sub(before, weight);
    const auto stop = hn::And(hn::Gt(weight, hn::Zero(d)), hn::Lt(after, hn::Set(d, float(quality.stop))));
    const bool stops = !hn::AllFalse(d, stop);
    if (HWY_UNLIKELY(stops)) weight = hn::IfThenElse(stop, before, weight), after = hn::IfThenZeroElse(stop, after);
    hn::Store(after, d, left);

    // Colours
    const float* colour = &splat_colours_.data[kColourStride * block.plane];
    for (int c = 0; c < 3; ++c, sum += stride_) {
      V value = hn::Set(d, colour[c]);
      if (HWY_UNLIKELY(stops && !quality.ends_early())) value = hn::IfThenElse(stop, hn::Set(d, background[c]), value);
      hn::Store(hn::MulAdd(weight, value, hn::Load(d, sum)), d, sum);
    }
  }

  LatticePlan plan_;
  int row_ = 0;
  int64_t stride_ = 0;                // nodes of a channel, with padding
  Buffer<float> s_, y_;               // of each line
  Buffer<float> A_, middle_, scale_;  // of the splat at hand on each line
  Buffer<int32_t> block_, blocks_;    // the first block that it touches there, and how many
  Buffer<Block> list_;
  Buffer<float> splat_colours_;            // of the splat at hand on each plane
  Buffer<float> transmittance_, colours_;  // [stride], [3, stride]
};

// Errors of interpolation at the middles of cells, [3][planes - 1][down - 1][row], and its mean round a node.
class LatticeErrors {
 public:
  using D = Tag<float>;
  using V = hn::Vec<D>;
  static constexpr int kLanes = LatticeNodes::kLanes;

  // Allocate the errors at the middles of this plan.
  void lay(const LatticePlan& middles) {
    cells_ = middles.across, down_ = middles.down, planes_ = middles.planes;
    // Spare entries at both ends of rows: for cells beside a node beyond the samples, and for the rest of a vector
    spare_ = 2 * middles.margin + kLanes + 1, wide_ = cells_ + 2 * spare_;
    errors_.resize(size_t(3 * planes_ * down_) * size_t(wide_));
  }
  float* row(int channel, int plane, int row) {
    return errors_.data() + size_t((channel * planes_ + plane) * down_ + row) * size_t(wide_) + spare_;
  }
  // Fill the spare entries of rows with the errors at the ends.
  void widen() {
    for (float* row = errors_.data() + spare_; row < errors_.data() + errors_.size(); row += wide_)
      std::fill_n(row - spare_, spare_, row[0]), std::fill_n(row + cells_, spare_, row[cells_ - 1]);
  }
  // The mean error of the cells round each of a vector of nodes, from node i of a row of a plane on. It is 0 where
  // these errors have both signs.
  HWY_INLINE V round(int channel, int plane, int row_, int i, const LatticePlan& nodes) {
    const D d;
    V low = hn::Set(d, 1e9f), high = hn::Set(d, -1e9f), sum = hn::Zero(d);
    int count = 0;
    for (int k = std::max(plane - 1, 0); k <= std::min(plane, planes_ - 1); ++k) {
      // On each of their two planes, cells stand half their lean aside: right on the lower one, left on the upper one.
      // Where half a lean is no whole cell, one cell is straight beside the node, and counts twice.
      const int lean = int(nodes.lean[k]) * (k == plane ? 1 : -1);
      const int right = i - nodes.margin + (lean >> 1), left = right - (lean % 2 == 0);
      for (int j = std::max(row_ - 1, 0); j <= std::min(row_, down_ - 1); ++j)
        for (int from : {left, right}) {
          const V error = hn::LoadU(d, row(channel, k, j) + from);
          low = hn::Min(low, error), high = hn::Max(high, error), sum = hn::Add(sum, error), ++count;
        }
    }
    const auto one_sign = hn::Gt(hn::Mul(low, high), hn::Zero(d));
    return hn::IfThenElseZero(one_sign, hn::Mul(sum, hn::Set(d, 1.f / float(count))));
  }
  int64_t bytes() const { return int64_t(errors_.capacity() * sizeof(float)); }

 private:
  int cells_ = 0, down_ = 0, planes_ = 0, spare_ = 0, wide_ = 0;
  std::vector<float> errors_;
};

// Interpolate colours between the nodes, a row of samples at a time. Most of the time goes into looking nodes up; so
// they are rounded to 8 bits, and a word holds all four round a sample. The colours have 16 bits: 256 times those of 8
// bits and a half, so that the upper byte is rounded.
class LatticeRow {
 public:
  using D = Tag<float>;
  using V = hn::Vec<D>;
  using DI = hn::RebindToUnsigned<D>;
  static constexpr int kLanes = LatticeNodes::kLanes;
  static constexpr float kUnit = 255 * 256, kHalf = 128;

  // Prepare the row at y, from the plan's origin, by linear interpolation between rows of nodes.
  void move_to(const LatticeNodes& nodes, float y) {
    const D d;
    const DI du;
    plan_ = nodes.plan();
    stride_ = plan_.across;
    const size_t size = size_t(3 * plan_.planes * stride_ + kLanes);
    if (size > size_) cells_ = hwy::AllocateAligned<uint32_t>(size_ = size);
    // Words beyond the ends of a plane are read where nodes lean past them, and belong to no sample. Behind the last
    // plane is another, for samples whose s is at its limit.
    const int64_t spare = plan_.margin + kLanes + 1, wide = stride_ + 2 * spare;
    bytes_.resize(size_t((plan_.planes + 1) * wide));
    const float place = (y - plan_.y0) / plan_.step_y;
    const int row = std::clamp(int(std::floor(place)), 0, plan_.down - 2);
    const V f = hn::Set(d, place - float(row)), zero = hn::Zero(d), one = hn::Set(d, 1.f);
    for (int c = 0; c < 3; ++c) {
      for (int k = 0; k < plan_.planes; ++k) {
        const float *a = nodes.colours(c, k, row), *b = nodes.colours(c, k, row + 1);
        uint32_t* to = &bytes_[size_t(k * wide + spare)];
        // The nodes of the row in bytes, a plane at a time
        for (int i = 0; i < plan_.across; i += kLanes) {
          const V low = hn::LoadU(d, a + i), value = hn::MulAdd(f, hn::Sub(hn::LoadU(d, b + i), low), low);
          const V byte = hn::MulAdd(hn::Min(hn::Max(value, zero), one), hn::Set(d, 255.f), hn::Set(d, 0.5f));
          hn::StoreU(hn::BitCast(du, hn::ConvertTo(hn::RebindToSigned<D>(), byte)), du, to + i);
        }
      }
      for (int k = 0; k < plan_.planes; ++k) {
        // Four bytes to a word: a node and the next, on this plane and on the one above
        const uint32_t *a = &bytes_[size_t(k * wide + spare)], *b = a + wide + int64_t(plan_.lean[k]);
        uint32_t* to = cells_.get() + (c * plan_.planes + k) * stride_;
        for (int i = 0; i < plan_.across; i += kLanes) {
          const auto low = hn::Or(hn::LoadU(du, a + i), hn::ShiftLeft<8>(hn::LoadU(du, a + i + 1)));
          const auto high = hn::Or(hn::LoadU(du, b + i), hn::ShiftLeft<8>(hn::LoadU(du, b + i + 1)));
          hn::StoreU(hn::Or(low, hn::ShiftLeft<16>(high)), du, to + i);
        }
      }
    }
  }

  // A channel's colour at x = x0 + along * step_x and s = s0 + up * step_s. It is linear along x on the planes below
  // and above, then linear between the two. It is in the low 16 bits.
  HWY_INLINE hn::Vec<DI> at(int channel, V along, V up) const {
    const D d;
    const hn::RebindToSigned<D> di;
    // The cell, and the place in it
    const V plane = hn::Floor(up), between = hn::Sub(up, plane);
    const V lean = plane_lean(hn::ConvertTo(di, plane));
    const V place = hn::NegMulAdd(lean, between, along), node = hn::Floor(place), past = hn::Sub(place, node);
    const V index = hn::MulAdd(plane, hn::Set(d, float(stride_)), node);
    const uint32_t* cells = cells_.get() + channel * plan_.planes * stride_;
    const auto cell = hn::GatherIndex(DI(), cells, hn::ConvertTo(di, index));

    // Its four nodes
    const auto byte = hn::Set(DI(), 255u);
    auto value = [&](hn::Vec<DI> bits) { return hn::ConvertTo(d, hn::BitCast(di, bits)); };
    const V a = value(hn::And(cell, byte)), b = value(hn::And(hn::ShiftRight<8>(cell), byte));
    const V e = value(hn::And(hn::ShiftRight<16>(cell), byte)), f = value(hn::ShiftRight<24>(cell));
    const V low = hn::MulAdd(past, hn::Sub(b, a), a), high = hn::MulAdd(past, hn::Sub(f, e), e);
    // Adding 2^23 leaves the colour in the low 16 bits of the float
    return hn::BitCast(DI(), hn::MulAdd(hn::MulAdd(between, hn::Sub(high, low), low), hn::Set(d, kUnit / 255),
                                        hn::Set(d, 8388608 + kHalf)));
  }

  const LatticePlan& plan() const { return plan_; }
  int64_t bytes() const { return int64_t((size_ + bytes_.capacity()) * sizeof(uint32_t)); }

 private:
  HWY_INLINE V plane_lean(hn::Vec<hn::RebindToSigned<D>> plane) const {
    const D d;
    if (plan_.planes > kLanes) return hn::GatherIndex(d, plan_.lean, plane);
    return hn::TableLookupLanes(hn::LoadU(d, plan_.lean), hn::IndicesFromVec(d, plane));
  }

  LatticePlan plan_;
  int stride_ = 0;
  size_t size_ = 0;
  hwy::AlignedFreeUniquePtr<uint32_t[]> cells_;  // [3, planes, stride]: a node and the next, here and on the next plane
  std::vector<uint32_t> bytes_;                  // of a channel: [planes + 1, spare + stride + spare]
};

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_LATTICE_INL_H_
