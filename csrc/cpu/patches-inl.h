// Composite for samples that one camera sees, in ordinary images and in `sorted`. ListSplats finds the splats of each
// tile of a band. A tile's samples form patches of one vector each: Patches tells which of them a splat may touch,
// SplatTerms evaluates the splat at their samples. CompositeItems gives every worker its memory.

#if defined(LFGS_CPU_PATCHES_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_PATCHES_INL_H_
#undef LFGS_CPU_PATCHES_INL_H_
#else
#define LFGS_CPU_PATCHES_INL_H_
#endif

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <vector>

#include "base/parallel.h"
#include "cpu/tile_lists.h"
#include "hwy/aligned_allocator.h"
#include "hwy/highway.h"
#include "math/blend-inl.h"
#include "stages/stages.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

// The boxes around the sample centres of kCount patches, measured from the tile's corner, and which patches are open.
template <class T, int kCount>
struct Patches {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  static constexpr int kLanes = int(hn::MaxLanes(D())), kWords = (kCount + 63) / 64;
  static_assert(kCount % kLanes == 0);

  alignas(64) T x[kCount] = {}, y[kCount] = {}, half_x[kCount] = {}, half_y[kCount] = {};
  uint64_t open[kWords];     // bit per patch: some sample still takes light
  uint64_t touched[kWords];  // bit per patch: the splat at hand may touch it

  // Open the first `count` patches.
  void reopen(int count) {
    for (int w = 0; w < kWords; ++w) {
      const int bits = std::clamp(count - 64 * w, 0, 64);
      open[w] = bits == 64 ? ~0ull : (1ull << bits) - 1;
    }
  }
  bool closed() const {
    return std::all_of(open, open + kWords, [](uint64_t w) { return w == 0; });
  }
  void close(int patch) { open[patch / 64] &= ~(1ull << patch % 64); }

  // Mark the open patches that a splat may touch, whose centre is (u, v) from the tile's corner; return how many.
  HWY_INLINE int find(const Splat<T>& s, T u, T v) {
    const D d;
    const V slope = hn::Set(d, std::abs(s.c0)), margin = hn::Set(d, T(0.01));
    int count = 0;
    std::fill(touched, touched + kWords, 0);
    for (int p = 0; p < kCount; p += kLanes) {
      // The exponent left in the row nearest to the centre
      const V half = hn::Load(d, half_y + p);
      const V middle = hn::Sub(hn::Load(d, y + p), hn::Set(d, v));
      const V nearest = hn::Max(hn::Sub(hn::Abs(middle), half), hn::Zero(d));
      const V exponent = hn::NegMulAdd(hn::Mul(hn::Set(d, s.tau), nearest), nearest,
                                       hn::Set(d, s.log2_opacity - T(kLog2MinAlpha) + T(1e-3)));

      // How far the box is from the footprint's middle line, and whether that is within its half width
      const V centre = hn::MulAdd(hn::Set(d, s.c0), middle, hn::Set(d, u));
      const V spread = hn::Add(hn::MulAdd(half, slope, hn::Load(d, half_x + p)), margin);
      const V distance = hn::Max(hn::Sub(hn::Abs(hn::Sub(hn::Load(d, x + p), centre)), spread), hn::Zero(d));
      const auto near = hn::Le(hn::Mul(distance, distance), hn::Mul(exponent, hn::Set(d, s.S0)));
      const auto hit = hn::And(near, hn::Ge(exponent, hn::Zero(d)));

      // One bit per patch
      alignas(8) uint8_t bits[8] = {};
      hn::StoreMaskBits(d, hit, bits);
      uint64_t word;
      std::memcpy(&word, bits, 8);
      touched[p / 64] |= word << p % 64 & open[p / 64];
    }
    for (int w = 0; w < kWords; ++w) count += std::popcount(touched[w]);
    return count;
  }

  // Call visit(patch) for the patches that find marked.
  template <class Visit>
  HWY_INLINE void for_each_touched(const Visit& visit) const {
    for (int w = 0; w < kWords; ++w)
      for (uint64_t todo = touched[w]; todo; todo &= todo - 1) visit(64 * w + std::countr_zero(todo));
  }
};

// The constants of a splat that samples of a tile read, a vector each.
template <class T>
struct SplatTerms {
  using D = Tag<T>;
  using V = hn::Vec<D>;
  V u, v, c0, tau, log2_opacity, inverse_S;

  HWY_INLINE SplatTerms(const Splat<T>& s, T u_, T v_) {
    const D d;
    u = hn::Set(d, u_), v = hn::Set(d, v_), c0 = hn::Set(d, s.c0), tau = hn::Set(d, s.tau);
    log2_opacity = hn::Set(d, s.log2_opacity), inverse_S = hn::Set(d, T(1) / s.S0);
  }
  // Return log2 of opacity * weight; also set dy, the distance from the centre's row, and dx, that from the
  // footprint's middle in the sample's row.
  HWY_INLINE V power(V x, V y, V& dx, V& dy) const {
    dy = hn::Sub(y, v);
    dx = hn::NegMulAdd(c0, dy, hn::Sub(x, u));
    return hn::NegMulAdd(hn::Mul(dx, dx), inverse_S, hn::NegMulAdd(hn::Mul(tau, dy), dy, log2_opacity));
  }
};

// List the splats of each tile of a band, nearest first; tiles are tile_px wide.
template <class Job>
HWY_INLINE void ListSplats(const Job& job, int64_t image, int64_t band, int64_t tile_px, TileLists& lists) {
  const auto* splats = job.splats.splats + image * job.splats.count;
  using T = decltype(splats->u0);
  const int64_t item = image * band_count(job.height_px) + band, y0 = band * kBandRows;
  const int64_t begin = job.bins.band_offsets[item], end = job.bins.band_offsets[item + 1];
  const T low = T(y0) + T(0.5), high = T(std::min(y0 + kBandRows, job.height_px)) - T(0.5);
  const int64_t tiles = (job.width_px + tile_px - 1) / tile_px;
  lists.build(job.bins.band_splats + begin, end - begin, tiles, [&](int32_t id) -> Range {
    T left, right;
    if (!footprint_columns(splats[id], low, high, T(0), left, right)) return {0, -1};
    const Range pixels = pixels_within(left, right, job.width_px);
    if (pixels.last < pixels.first) return {0, -1};
    return {pixels.first / tile_px, pixels.last / tile_px};
  });
}

// Call draw(item, lists, tile, counters) for all items, with the memory and the counters of the worker. Return the sum
// of the counters.
template <class Tile, class Draw>
Counters CompositeItems(int64_t items, int threads, const Draw& draw) {
  std::vector<TileLists> lists(size_t(std::max(threads, 1)));
  std::vector<Counters> counters(lists.size());
  auto tiles = hwy::MakeUniqueAlignedArray<Tile>(lists.size());
  parallel_for(items, threads, [&](int64_t item, int worker) {
    const size_t w = size_t(worker);
    draw(item, lists[w], tiles[w], counters[w]);
  });
  Counters sum;
  for (size_t w = 0; w < lists.size(); ++w) {
    sum += counters[w];
    sum.scratch_bytes += lists[w].bytes() + int64_t(sizeof(Tile));
  }
  return sum;
}

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_PATCHES_INL_H_
