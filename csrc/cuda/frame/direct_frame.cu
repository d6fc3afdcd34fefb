// Make a DirectFrame: round the lens for kernels, find the sizes of tilings and of lens columns, and lay out the
// work buffer. On the host only.
#include "cuda/frame/direct_frame.h"

#include <algorithm>
#include <cmath>

#include "base/error.h"
#include "cuda/common/launch.h"
#include "cuda/direct/rounded_rig.cuh"
#include "cuda/frame/root_series.cuh"

namespace lfgs::cuda {
namespace {

// Error of a colour that is a parabola within a lens column, times the splat's opacity: half of 1/255.
constexpr double kLensColumnColourError = 2e-3;
constexpr int64_t kMostTiles = int64_t(1) << 31;

// The lean of the lenses over the height of the panel, in sub-pixels. The smallest D - origin on the panel is in its
// first or last row.
double tilt(const Lens& lens) { return 3 * lens.slant_tan * double(lens.height_px - 1); }
double lowest_phase(const Lens& lens) { return std::min(0.0, tilt(lens)); }

// How many lens columns lie before the first stripe of a lens.
int leading_columns(const Lens& lens) { return lens.has_cells ? 1 : 0; }

// Which views each lens column sees, as offsets and as camera coordinates.
LensColumns make_lens_columns(const Lens& lens) {
  LensColumns out{};
  const int lead = leading_columns(lens);
  const double beyond = lens.most_beyond();
  out.count = int(std::ceil(lens.line_number)) + 2 * lead, out.per_group = kGroupColumns;
  out.groups = (out.count + kGroupColumns - 1) / kGroupColumns;
  out.first_lens = int(std::floor((lowest_phase(lens) - beyond) / lens.line_number));

  // How many views a lens column sees, and the power of 2 that brings half of them to about 1
  const double views_each = double(lens.views) / lens.line_number, last = double(lens.views) - 1;
  const double seen = (1 + 2 * beyond) * views_each + (lens.continuous ? 0 : 1);
  out.view_unit = float(std::exp2(-std::ceil(std::log2(seen / 2))));

  // The middle and half of the range of each; whole views have their cameras at n + 1/2
  for (int t = 0; t < std::min(out.count, kMostLensColumns); ++t) {
    double low = (t - lead - beyond) * views_each, high = (t - lead + 1 + beyond) * views_each;
    if (!lens.continuous) low = std::floor(low - 1e-6) + 0.5, high = std::floor(high + 1e-6) + 0.5;
    const double least = lens.continuous ? 0 : 0.5, most = lens.continuous ? last + 1 : last + 0.5;
    low = std::clamp(low, least, most), high = std::clamp(high, low, most);
    const double view = (low + high) / 2;
    out.reach = std::max(out.reach, float((high - low) / 2 * out.view_unit));
    out.view[t] = float(view);
    out.centre[t] = float(lens.s_start() + lens.s_step() * view);
    out.half[t] = float(std::fabs(lens.s_step()) * (high - low) / 2);
    out.widest = std::max(out.widest, out.half[t]);
  }

  // Constants of the fits in v. Where a lens column sees one view only, nothing varies within it
  const float square = out.reach * out.reach;
  out.cubic = 0.6f * square;
  out.most_bend = kLeastBend / std::max(square, 1e-6f);
  return out;
}

// Sets which channel lies at which place, and by how much sub-pixels are off their stripes where they do not stand in
// stripes. Where the pixels of a panel have their channels in different orders, "places" are channels. The phases of
// the cells give the position of each channel.
void set_places(const Lens& lens, LensOptics& out) {
  const bool by_place = !lens.has_cells || lens.has_one_order();
  for (int k = 0; k < 3; ++k) {
    out.channels[k] = by_place ? lens.channel_at(0, k) : k;
    out.places[out.channels[k]] = k;
  }
  out.permuted = out.channels[0] != 0 || out.channels[1] != 1;
  out.has_cells = lens.has_cells, out.lead = leading_columns(lens), out.beyond = float(lens.most_beyond());
  for (int row = 0; row < kCellPeriod; ++row)
    for (int m = 0; m < kRowPeriod; ++m) {
      const int k = m % 3, at = by_place ? k : lens.cells.channels[row][m];
      out.cells.phases[row][m - k + at] = lens.cells.phases[row][m] + lens.phase_x * uint64_t(int64_t(k - at));
    }
}

// The lens, rounded to float. Phases stay whole numbers: they decide which view a sub-pixel shows.
LensOptics make_optics(const Lens& lens) {
  LensOptics out{};
  out.width_px = int(lens.width_px), out.height_px = int(lens.height_px), out.views = int(lens.views);
  out.phase0 = lens.phase0, out.phase_x = lens.phase_x, out.phase_y = lens.phase_y;
  out.line_number = float(lens.line_number), out.slant_tan = float(lens.slant_tan);
  out.origin = float(lens.phase - std::floor(lens.phase / lens.line_number) * lens.line_number);
  out.s_start = float(lens.s_start()), out.s_step = float(lens.s_step());
  out.continuous = lens.continuous;
  set_places(lens, out);
  out.lens_columns = make_lens_columns(lens);
  return out;
}

// Tiles of pixels: pixel j, whose centre is at j + 1/2, lies in tile floor(j / width).
Tiling pixel_tiling(const Lens& lens) {
  const int across = int((lens.width_px + kPixelTileWidth - 1) / kPixelTileWidth);
  const int down = int((lens.height_px + kPixelTileHeight - 1) / kPixelTileHeight);
  return {across, down, 1, kPixelTileHeight, float(kPixelTileWidth), 1, 0.5f, -0.5f, 0};
}

// Tiles of lenses. Place k of the pixel with centre x in row i has D = 3 x - 3/2 + k + 3 i tan + origin. It lies in
// lens floor(D / P_e). Tiles count from the first lens of the panel; strips are sheared along y = i + 1/2.
Tiling lens_column_tiling(const Lens& lens, const LensOptics& optics) {
  const double first = optics.lens_columns.first_lens * lens.line_number;
  const double most = 3.0 * double(lens.width_px) + std::fabs(tilt(lens)) + lowest_phase(lens) + lens.line_number;
  const double width = kTileLenses * lens.line_number, zero = optics.origin - first - 1.5 * lens.slant_tan;
  const int across = int((most - first) / width) + 1;
  const int down = int((lens.height_px + kTileRows - 1) / kTileRows);
  return {across,
          down,
          optics.lens_columns.groups,
          kTileRows,
          float(width),
          3,
          float(zero - 1.5 - optics.beyond),
          float(zero + 0.5 + optics.beyond),
          float(lens.slant_tan)};
}

}  // namespace

DirectFrame::DirectFrame(int64_t gaussians, int sh_degree_, int colour_order, const Camera<double>& rig_,
                         const Lens& lens, int64_t capacity_, const Quality& quality, double colour_error_,
                         double left_out_, int64_t shared_memory)
    : rig(rig_),
      optics(make_optics(lens)),
      pixel(pixel_tiling(lens)),
      lens_column(lens_column_tiling(lens, optics)),
      sh_degree(sh_degree_),
      capacity(capacity_),
      colour_error(float(colour_error_)),
      left_out(float(left_out_)),
      lens_column_error(float(std::max(colour_error_, kLensColumnColourError))),
      cut(float(quality.log2_cut)),
      stop(float(quality.stop)),
      sample_cut(float(quality.sample_cut())),
      least_light(float(quality.least_light(lens.width_px, lens.height_px, gaussians))),
      lattice(lens.has_cells ? 0.f : float(quality.lattice)),
      in_half(quality.approximate()) {
  require(gaussians >= 0 && gaussians < (int64_t(1) << 31) && capacity >= 0 && capacity < (int64_t(1) << 32),
          "a frame takes fewer than 2^31 Gaussians and 2^32 intersections, got " + std::to_string(gaussians) + " and " +
              std::to_string(capacity));
  require(!rig.compensated() || !(lattice > 0 || in_half),
          "a frame of compensated opacities is drawn neither from lattices nor in half precision");
  // The lens column kernel numbers colours, splats times lens columns, with 32 bits
  if (gaussians * optics.lens_columns.columns() < (int64_t(1) << 32))
    lens_column_layout = cuda::lens_column_layout(lens, shared_memory);
  require(std::max(pixel.down, lens_column.down) <= kProbeRows * kMostProbeRows,
          "the panel has too many rows: " + std::to_string(lens.height_px));
  require(most_lists() < kMostTiles, "the panel has too many tiles: " + std::to_string(most_lists()));
  splats.images = 1, splats.count = gaussians, splats.colour_order = colour_order;
}

size_t DirectFrame::place(void* work) {
  Parts parts{static_cast<char*>(work)};
  const int64_t n = splats.count;

  // The arrays that project clears come first, side by side
  parts.take(state, 1), parts.take(ranges, 2 * most_lists());
  cleared_bytes = parts.used;

  // Splats and their colours
  parts.take(splats.splats, n);
  parts.take(splats.colours, n * (splats.colour_order + 1) * kColourStride);
  splats.orders = nullptr;
  if (splats.colour_order > 0) {
    parts.take(splats.orders, n);
    const int64_t colours = has_lens_column() ? n * optics.lens_columns.columns() : 0;
    parts.take(lens_column_colours, 4 * colours), parts.take(lens_column_slopes, 2 * colours);
  }
  if (rig.compensated()) {
    parts.take(splats.compensations, n);
    parts.take(lens_column_compensations, has_lens_column() ? 2 * n * optics.lens_columns.columns() : 0);
  }

  // Lists, and lattices where the quality allows them
  parts.take(depths, n), parts.take(ids, std::max(capacity, n)), parts.take(long_lists, most_lists());
  if (lattice > 0) parts.take(lattices, most_lists()), parts.take(refused, most_lists());
  return parts.used;
}

void frame_composite(const DirectFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream) {
  if (frame.lattice > 0) composite_lattice(frame, background, out, out8, stream);
  composite_pixel(frame, background, out, out8, stream);
  composite_lens_column(frame, background, out, out8, stream);
}

}  // namespace lfgs::cuda
