// Draw a run of tiles from a coarse lattice where that is accurate enough. judge() draws a lattice for the run and
// checks it; write() interpolates the run's sub-pixels and writes them to the image.

#if defined(LFGS_CPU_DIRECT_LATTICE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LFGS_CPU_DIRECT_LATTICE_INL_H_
#undef LFGS_CPU_DIRECT_LATTICE_INL_H_
#else
#define LFGS_CPU_DIRECT_LATTICE_INL_H_
#endif

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "cpu/direct/lattice-inl.h"
#include "cpu/direct/lens_layout.h"
#include "cpu/direct/direct_splat-inl.h"
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace lfgs {
namespace HWY_NAMESPACE {

class DirectLattice {
 public:
  static constexpr int kLanes = LatticeNodes::kLanes;
  using Words = hn::RebindToUnsigned<Tag<float>>;
  enum class Verdict { kFits, kSplit, kRefuse };
  float fineness;  // of the next lattice, see LatticeCurvature::plan
  int64_t evaluations() const { return nodes_.evaluations + middles_.evaluations; }

  DirectLattice(const Lens& lens, const Quality& quality)
      : fineness(0),
        lens_(lens),
        quality_(on_lattice(quality)),
        pixels_(quality.lattice > 0 ? size_t(lens.width_px + kLanes) * 3 : 0) {}

  int64_t bytes() const {
    return int64_t(pixels_.capacity() * sizeof(float)) + nodes_.bytes() + middles_.bytes() + errors_.bytes() +
           row_.bytes();
  }

  // The quality by which nodes are drawn. They stop so late that no lattice takes the stop for an edge.
  static Quality on_lattice(Quality quality) {
    quality.stop = std::min(quality.stop, std::max(0.1 * quality.lattice, kMinTransmittance));
    return quality;
  }
  // Whether lattices can draw a panel. With cells, every vector of pixels must begin with the same kind of cell, and a
  // place must have the same channel in all cells.
  static bool knows(const Lens& lens) { return !lens.has_cells || (kLanes % kCellPeriod == 0 && lens.has_one_order()); }
  void start_band() { fineness = first_fineness(float(quality_.lattice)), refused_ = 0; }

  // Draw the nodes of a lattice for a run that has samples, and the middles of its cells, and compare them. kFits: it
  // is as good as asked for. kSplit: one much finer than was tried is needed, which half a run may not need; never if
  // `last`. kRefuse: a lattice as good as asked for has too many nodes to be worth it. [begin, end): the splats that
  // the run's samples may meet, nearest first.
  Verdict judge(const LensRun& run, const Splats<float>& splats, const int32_t* begin, const int32_t* end,
                const float* background, bool last) {
    // Where nothing fitted lately, only one run in 2 kPatience is tried
    if (refused_ >= kPatience && ++refused_ % (2 * kPatience) != 0) return Verdict::kRefuse;

    // How fast the light field varies there
    x0_ = double(run.first[0]) / 3, y0_ = double(run.row0);
    const LatticePart part = run.part(lens_, x0_, y0_);
    LatticeCurvature curvature(part);
    for (const int32_t* id = begin; id != end; ++id)
      curvature.add(splats.splats[*id], float(double(splats.splats[*id].u0) - x0_));

    // Choose lattices by the errors of the one before
    const double most = kMostNodes * double(run.samples());
    for (int attempt = 0; attempt < kAttempts; ++attempt) {
      LatticePlan plan;
      curvature.plan(fineness, plan);
      const LatticePlan middles = plan.middles(part);
      if (double(plan.nodes()) + double(middles.nodes()) > most) break;
      draw(nodes_, plan, splats, begin, end, background);
      draw(middles_, middles, splats, begin, end, background);
      const float moved = move_nodes();
      // The error, relative to the allowed one. It grows with the square of the steps, which tells how fine the next
      // lattice must be.
      const Error at_middles = error_at_middles();
      const float largest = std::max(at_middles.largest, moved);
      const float error = std::max(std::max(largest, kMovedFactor * at_middles.mean) / float(quality_.lattice), 1e-6f);
      const float better = kBackOff / std::sqrt(error);
      fineness = std::clamp(fineness * std::clamp(better, 0.4f, 1.25f), 0.01f, kMostFineness);
      if (error <= 1) return refused_ = 0, Verdict::kFits;
      if (error > kSplitError && !last && refused_ < kPatience) return Verdict::kSplit;
    }
    ++refused_;
    return Verdict::kRefuse;
  }

  // Interpolate the run's samples and write them, the sub-pixels of a pixel in the order of their places.
  template <class Out>
  void write(const LensRun& run, Out* image) {
    for (int64_t r = 0; r < run.rows; ++r) {
      const int64_t first = run.first[r], end = run.end[r], pixel0 = first / 3, row = run.row0 + r;
      if (first >= end) continue;
      row_.move_to(nodes_, float(double(row) + 0.5 - y0_));
      auto* pixels = reinterpret_cast<Out*>(pixels_.data());
      lens_.has_cells ? interpolate<true>(row, pixel0, (end + 2) / 3 - pixel0, pixels)
                      : interpolate<false>(row, pixel0, (end + 2) / 3 - pixel0, pixels);
      std::memcpy(image + row * 3 * lens_.width_px + first, reinterpret_cast<Out*>(pixels_.data()) + first - 3 * pixel0,
                  size_t(end - first) * sizeof(Out));
    }
  }

 private:
  static constexpr int kAttempts = 3;
  static constexpr int kPatience = 4;  // runs in turn that may be refused before most are no longer tried
  static constexpr int kLookOut = 64;  // splats between two looks whether all nodes are opaque
  static constexpr float kSplitError = 2.5f;
  static constexpr float kMostNodes = 0.3f;  // nodes and middles for each sample of the run; a node has three channels

  void draw(LatticeNodes& nodes, const LatticePlan& plan, const Splats<float>& splats, const int32_t* begin,
            const int32_t* end, const float* background) {
    nodes.lay(plan);
    for (const int32_t* id = begin; id != end; ++id) {
      if ((id - begin) % kLookOut == kLookOut - 1 && nodes.opaque()) break;
      const Splat<float>& splat = splats.splats[*id];
      const float u = float(double(splat.u0) - x0_), v = float(double(splat.v0) - y0_);
      const Compensation<float>* compensation = splats.compensations ? splats.compensations + *id : nullptr;
      nodes.add(splat, compensation, u, v, colours(splats, *id), splats.orders[*id], quality_, background);
    }
    nodes.finish(background);
  }

  // Move every node by kNodeFactor times the mean error at the middles round it. Return the largest move. Nodes round
  // which errors have both signs, as at an edge, stay.
  float move_nodes() {
    const Tag<float> d;
    const LatticePlan& plan = nodes_.plan();
    errors_.lay(middles_.plan());
    error_at_middles();
    errors_.widen();
    auto most = hn::Zero(d);
    for (int c = 0; c < 3; ++c)
      for (int k = 0; k < plan.planes; ++k)
        for (int j = 0; j < plan.down; ++j) {
          float* row = nodes_.colours(c, k, j);
          for (int i = 0; i < plan.across; i += kLanes) {
            const auto move = hn::Mul(errors_.round(c, k, j, i, plan), hn::Set(d, kNodeFactor));
            hn::StoreU(hn::Sub(hn::LoadU(d, row + i), move), d, row + i);
            most = hn::Max(most, hn::Abs(move));
          }
        }
    return hn::GetLane(hn::MaxOfLanes(d, most));
  }

  // Compare what is interpolated at the middles of cells with what was drawn there: the largest error and the root
  // mean square. The errors are kept in errors_.
  struct Error {
    float largest, mean;
  };
  Error error_at_middles() {
    const Tag<float> d;
    const LatticePlan& plan = middles_.plan();
    auto worst = hn::Zero(d), squares = hn::Zero(d);
    int64_t count = 0;
    for (int j = 0; j < plan.down; ++j) {
      // A row of middles, on all planes
      row_.move_to(nodes_, plan.y0 + float(j) * plan.step_y);
      for (int k = 0; k < plan.planes; ++k)
        for (int i = 0; i < plan.across; i += kLanes) {
          // Lanes beyond the last middle repeat it
          const auto lane = hn::Min(hn::Iota(d, float(i)), hn::Set(d, float(plan.across - 1)));
          const auto index = hn::ConvertTo(hn::RebindToSigned<Tag<float>>(), lane);
          const auto along = hn::Add(lane, hn::Set(d, float(plan.margin) + 0.5f));
          for (int c = 0; c < 3; ++c) {
            const auto is = hn::GatherIndex(d, middles_.colours(c, k, j), index);
            const auto made = colour_of_bits(row_.at(c, along, hn::Set(d, float(k) + 0.5f)));
            const auto error = hn::Sub(made, shown(is));
            hn::StoreU(error, d, errors_.row(c, k, j) + i);
            worst = hn::Max(worst, hn::Abs(error)), squares = hn::MulAdd(error, error, squares);
          }
          count += 3 * kLanes;
        }
    }

    // Over all lanes
    const float sum = hn::GetLane(hn::SumOfLanes(d, squares));
    return {hn::GetLane(hn::MaxOfLanes(d, worst)), std::sqrt(sum / float(std::max<int64_t>(count, 1)))};
  }
  static HWY_INLINE hn::Vec<Tag<float>> shown(hn::Vec<Tag<float>> c) {
    const Tag<float> d;
    return hn::Min(hn::Max(c, hn::Zero(d)), hn::Set(d, 1.f));
  }

  // Interpolate the pixels [pixel0, pixel0 + count) of a row, and the rest of the last vector.
  template <bool kCells, class Out>
  HWY_NOINLINE void interpolate(int64_t row, int64_t pixel0, int64_t count, Out* to) {
    const Tag<float> d;
    const LatticePlan& plan = row_.plan();
    const float per_x = 1 / plan.step_x, last = float(plan.across - 1 - plan.margin) - 1e-3f;
    Phases phases(lens_, row, pixel0, plan);
    const int channels[3] = {lens_.channel_at(0, 0), lens_.channel_at(0, 1), lens_.channel_at(0, 2)};
    for (int64_t j = 0; j < count; j += kLanes) {
      const float x = float(double(pixel0 + j) + 0.5 - x0_) - plan.x0;
      const auto along =
          hn::Min(hn::MulAdd(hn::Iota(d, 0.f), hn::Set(d, per_x), hn::Set(d, x * per_x)), hn::Set(d, last));
      const auto a = row_.at(channels[0], along, phases.template next<kCells>(0));
      const auto b = row_.at(channels[1], along, phases.template next<kCells>(1));
      const auto c = row_.at(channels[2], along, phases.template next<kCells>(2));
      phases.skip();
      store(a, b, c, to + 3 * j);
    }
  }

  // The phases of one place in a vector of pixels. 32 bits, with 2^32 a lens, are enough: a sub-pixel at the border of
  // a view rarely gets the view beside it.
  struct Phases {
    hn::Vec<Words> phase;
    HWY_ALIGN uint32_t beyond[3][kLanes];  // what cells add at each place
    uint32_t step, pixels;
    float per_phase, to_plane, plane0;
    bool continuous;

    Phases(const Lens& lens, int64_t row, int64_t pixel0, const LatticePlan& plan)
        : step(uint32_t(lens.phase_x >> 32)),
          pixels(uint32_t((3 * kLanes * lens.phase_x) >> 32) - 3 * step),
          per_phase(float(double(lens.views) / 2147483648.0)),
          to_plane(float(lens.s_step()) / plan.step_s),
          plane0((float(lens.s_start()) - plan.s0) / plan.step_s),
          continuous(lens.continuous) {
      HWY_ALIGN uint32_t phases[kLanes];
      for (int lane = 0; lane < kLanes; ++lane) phases[lane] = uint32_t(lens.phase_at(row, 3 * (pixel0 + lane)) >> 32);
      phase = hn::Load(Words(), phases);
      if (lens.has_cells)
        for (int m = 0; m < 3 * kLanes; ++m)
          beyond[m % 3][m / 3] = uint32_t(lens.cells.phases[row % kCellPeriod][(3 * pixel0 + m) % kRowPeriod] >> 32);
      if (!continuous) plane0 += 0.5f * to_plane;
    }
    // The offsets of place k, counted in planes of the lattice. The phases then move on to the next place.
    template <bool kCells>
    HWY_INLINE hn::Vec<Tag<float>> next(int k) {
      const Tag<float> d;
      const auto own = kCells ? hn::Add(phase, hn::Load(Words(), beyond[k])) : phase;
      const auto half = hn::BitCast(hn::RebindToSigned<Tag<float>>(), hn::ShiftRight<1>(own));
      phase = hn::Add(phase, hn::Set(Words(), step));
      auto view = hn::Mul(hn::ConvertTo(d, half), hn::Set(d, per_phase));
      if (!continuous) view = hn::Floor(view);
      return hn::Max(hn::MulAdd(view, hn::Set(d, to_plane), hn::Set(d, plane0)), hn::Zero(d));
    }
    // Move on to the next vector of pixels.
    HWY_INLINE void skip() { phase = hn::Add(phase, hn::Set(Words(), pixels)); }
  };

  static HWY_INLINE hn::Vec<Tag<float>> colour_of_bits(hn::Vec<Words> bits) {
    const Tag<float> d;
    const auto fixed =
        hn::ConvertTo(d, hn::BitCast(hn::RebindToSigned<Tag<float>>(), hn::And(bits, hn::Set(Words(), 0xffffu))));
    return hn::Mul(hn::Sub(fixed, hn::Set(d, LatticeRow::kHalf)), hn::Set(d, 1 / LatticeRow::kUnit));
  }
  static HWY_INLINE void store(hn::Vec<Words> a, hn::Vec<Words> b, hn::Vec<Words> c, float* to) {
    hn::StoreInterleaved3(colour_of_bits(a), colour_of_bits(b), colour_of_bits(c), Tag<float>(), to);
  }
  static HWY_INLINE void store(hn::Vec<Words> a, hn::Vec<Words> b, hn::Vec<Words> c, uint8_t* to) {
    const hn::Rebind<uint8_t, Tag<float>> d8;
    auto byte = [&](hn::Vec<Words> v) { return hn::TruncateTo(d8, hn::ShiftRight<8>(v)); };
    hn::StoreInterleaved3(byte(a), byte(b), byte(c), d8, to);
  }

  const Lens& lens_;
  const Quality quality_;
  int refused_ = 0;         // runs since one fitted
  double x0_ = 0, y0_ = 0;  // the origin of places in lattices
  LatticeNodes nodes_, middles_;
  LatticeErrors errors_;
  LatticeRow row_;
  std::vector<float> pixels_;  // of a row
};

}  // namespace HWY_NAMESPACE
}  // namespace lfgs
HWY_AFTER_NAMESPACE();

#endif  // LFGS_CPU_DIRECT_LATTICE_INL_H_
