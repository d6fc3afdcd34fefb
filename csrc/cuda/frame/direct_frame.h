// A light-field frame on the device, forward only: project -> bin -> order -> composite without the host in between. It
// reads Gaussians and writes the image of a panel; everything else is in one work buffer that belongs to the caller.
//
// All sizes are fixed when the frame is made, nothing waits for the device, and every decision that depends on the
// scene is taken there. So a frame can be captured in a CUDA graph and replayed.
#pragma once

#include <algorithm>
#include <cstdint>

#include "base/config.h"
#include "cuda/stages/stages.h"
#include "math/lattice_plan.h"

namespace lfgs::cuda {

// The kernels that composite may use. kPixel... draw patches of pixels, large or small, with the inverse standard
// deviation of a splat linear or quadratic in s (composite_pixel.cu). kLensColumn draws tiles of lenses with tensor
// cores (composite_lens_column.cu).
enum class FrameKernel : int { kPixel, kPixelQuadratic, kPixelSmall, kPixelQuadraticSmall, kLensColumn, kCount };

// Whether kLensColumn can draw a lens on a device, and how its blocks use shared memory; see lens_column_operands.cuh.
enum class LensColumnLayout : int { kNone, kCompact, kFull };

constexpr int kMostProbeRows = 256;  // enough for 65,536 rows of pixels, see kProbeRows

// The kernel that draws a frame, and how.
struct KernelChoice {
  int kernel;  // FrameKernel
  float straight,
      needs_exact;  // limits of shape errors, see ShapeLimits; needs_exact < 0: every splat needs the exact formulas
};

// The results of one frame: written on the device, read by the host when it likes. The first four numbers come from
// bin, the next from the project before that, the rest from project and composite. Project clears all, or all but
// the first five.
struct FrameState {
  unsigned long long
      intersections;       // (tile, splat) intersections; when more than the capacity, composite walks all splats
  unsigned drawn;          // number of splats drawn
  unsigned next_splat;     // next free place of the list of all splats
  unsigned long_lists;     // number of lists of more than kShortList splats
  unsigned bent_colours;   // number of splats whose colours vary too much for kLensColumn
  unsigned colour_error;   // bits of a float: a bound of the error of colour polynomials
  KernelChoice choice;     // the kernel of the frame
  KernelChoice by_pixels;  // the kernel if kLensColumn must not draw it
  float curved;            // fraction of the splats whose error is beyond `straight`
  int lattices;            // whether any are laid
  unsigned next_tile[5];   // next piece of work of each composite kernel, see WorkQueue
  unsigned lattice_tiles;  // number of tiles drawn from a lattice
  unsigned refused_tiles;  // number of tiles that the lattice left to the kernel chosen
  unsigned tried_tiles;    // number of tiles with splats, on which a lattice was laid
  unsigned long long probed[kMostProbeRows];  // tiles of rows on which lattices are tried first, see ProbedRow
  unsigned pruned;                            // number of splats left out, see Quality
  unsigned sampled;                           // number of splats in the sums below (a part of all, for speed)
  unsigned blocks_summed;                     // blocks of project that have added to the sums
  unsigned long long sums[15];                // see FrameSum, in fixed point
};

constexpr int kMostLensColumns = 32;
constexpr int kPixelTileWidth = 64, kPixelTileHeight = 32;

// For every lens column t = 0, 1, ...: the part of the rig that the t-th sub-pixels of all lenses see. With cells, t
// counts from one sub-pixel before the first stripe of a lens to one behind its last. Those two may belong to this lens
// or to its neighbour.
struct LensColumns {
  int count, per_group, groups;
  int first_lens;                                          // left-most lens of the panel
  float centre[kMostLensColumns], half[kMostLensColumns];  // middle and half of the range of offsets s
  float view[kMostLensColumns];                            // the camera coordinate in the middle
  float view_unit;  // a power of 2. v = (camera coordinate - view) view_unit is at most about 1
  float cubic;      // the line `cubic` v is the one nearest to v^3 within a lens column
  float reach;      // largest |v|
  float widest;     // largest half range of offsets
  float most_bend;  // where no s2 is larger, no splat needs the exact formulas for its shape; see kLeastBend
  LFGS_HD int columns() const { return groups * per_group; }  // lens columns, and the filling of the last group
};

// The lens as kernels use it, in float; scene/lens.h has it in double.
struct LensOptics {
  int width_px, height_px, views;
  uint64_t phase0, phase_x, phase_y;
  float line_number, origin, slant_tan;  // origin: phase of the first sub-pixel in [0, line_number)
  float s_start, s_step;
  int permuted, continuous;
  int channels[3], places[3];  // image channel at each place, place of each channel; permuted: they are not 0, 1, 2
  // For sub-pixels that do not stand in stripes. Cells are listed by place where all pixels have their channels in one
  // order, otherwise by channel.
  int has_cells, lead;  // lead: lens columns before the first stripe of a lens
  float beyond;         // how far a sub-pixel stands aside of its stripe at most, in sub-pixels
  SubpixelCells cells;
  LensColumns lens_columns;
};

// How the panel is divided into tiles. Down, a tile has `height` rows of pixels. Across, tiles are steps of `width`
// along scale * (x + shear y). For the left end of a splat's interval add `low`, for the right end `high`. Every tile
// has a list for each of `groups` groups of lens_columns.
struct Tiling {
  int across, down, groups, height;
  float width, scale, low, high, shear;
  LFGS_HD int64_t tiles() const { return int64_t(across) * down * groups; }
};

struct Lattice;

// Everything that the kernels of a frame are told: its sizes and limits, and where the parts of the work buffer are.
struct DirectFrame {
  Camera<double> rig;
  LensOptics optics;
  Tiling pixel, lens_column;
  LensColumnLayout lens_column_layout = LensColumnLayout::kNone;
  int forced = -1;  // the FrameKernel to use; -1: the frame chooses by cost
  int sh_degree = 0;
  int64_t capacity = 0;         // the most intersections that the lists hold
  float colour_error = 0;       // error allowed of colours that are interpolated over the rig
  float left_out = 0;           // error allowed by the terms left out of colour polynomials
  float lens_column_error = 0;  // error allowed of colours that are parabolas within a lens column; 0: not looked at
  float cut = 0, stop = 0;      // of Quality: log2 of the opacity cut, transmittance at which a sample may end
  float sample_cut = 0;         // log2 of the alpha from which a splat that reaches a patch counts at a sample
  float least_light = 0;        // splats of less light are pruned, see alpha_integral()
  float lattice = 0;            // of Quality: error allowed at the checks of a lattice; 0: no lattice
  bool in_half = false;  // of Quality: kPixel and kPixelSmall evaluate in half precision, and `cut` is for patches

  // Parts of the work buffer. The state and the ranges lie side by side, so that project clears both at once
  FrameState* state = nullptr;
  uint32_t* ranges = nullptr;  // [lists, 2]: first and end of every list
  size_t cleared_bytes = 0;
  Splats<float> splats;
  uint32_t* depths = nullptr;      // [N]: bits of the splats' depths
  uint32_t* ids = nullptr;         // [capacity, or N if more]: the splats of all lists, nearest first after order
  uint32_t* long_lists = nullptr;  // [lists]: which of them are long, in any order
  // With harmonics, the colours of every splat at every lens column, by place in the pixel. A colour is its value in
  // the middle, with slope and bend in v as halves in one word. The word of the first place is the fourth number of the
  // colour.
  float* lens_column_colours = nullptr;    // [N, columns, 4]
  uint32_t* lens_column_slopes = nullptr;  // [N, columns, 2]
  // With compensation: log2 of the compensation there, and its slope and bend in v as halves
  float* lens_column_compensations = nullptr;  // [N, columns, 2]
  Lattice* lattices = nullptr;                 // [tiles], where any are laid: see composite_lattice.cu
  uint32_t* refused = nullptr;                 // [tiles, without groups]: the tiles that lattices left, in any order

  DirectFrame() = default;
  // shared_memory: bytes of it that a block may take at most; 0: what the device has. Throws Error when the sizes do
  // not fit 32 bits.
  DirectFrame(int64_t gaussians, int sh_degree, int colour_order, const Camera<double>& rig, const Lens& lens,
              int64_t capacity, const Quality& quality, double colour_error, double left_out, int64_t shared_memory);
  // Lay the parts out in `work` (null: only counts); return the bytes.
  size_t place(void* work);
  // On the device only: the tiles of the kernel chosen; whether there are more intersections than the lists hold.
  LFGS_HD const Tiling& tiling() const { return lens_column_chosen() ? lens_column : pixel; }
  LFGS_HD bool lens_column_chosen() const { return state->choice.kernel == int(FrameKernel::kLensColumn); }
  LFGS_HD bool overfull() const { return state->intersections > static_cast<unsigned long long>(capacity); }
  LFGS_HD bool has_lens_column() const { return lens_column_layout != LensColumnLayout::kNone; }
  int64_t most_lists() const { return std::max(pixel.tiles(), has_lens_column() ? lens_column.tiles() : 0); }
};

// The stages, in this order. gaussians must have the count and degree that the frame was made for; colours have an
// order above 0 where sh_degree is above 0. keep_lists says that bin and order will not follow, since only colours have
// changed since they last did. Otherwise bin must follow once, since project has cleared its counters.
void frame_project(const DirectFrame& frame, const Gaussians<const float>& gaussians, bool keep_lists, Stream stream);
void frame_bin(const DirectFrame& frame, Stream stream);  // then state->intersections is known
void frame_order(const DirectFrame& frame, Stream stream);
void frame_composite(const DirectFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream);

// Parts of frame_composite. The lattice goes first, if the quality allows one. Then both others are launched, and the
// one that the frame chose draws the tiles that the lattice refused, or all tiles.
void composite_lattice(const DirectFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream);
void composite_pixel(const DirectFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream);
void composite_lens_column(const DirectFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream);
// Lenses across and rows down of a tile of composite_lens_column, and lens columns in a group of a list. The function
// says how it draws a lens on the current device; shared_memory: see DirectFrame.
constexpr int kTileLenses = 16, kTileRows = 32, kGroupColumns = 6;
LensColumnLayout lens_column_layout(const Lens& lens, int64_t shared_memory);

constexpr int kMostLatticePlanes = 16;
constexpr int kMostNodes = 640;  // of a tile: a tenth of its sub-pixels

// A plane of nodes. A point at one of its nodes is `aside` nodes further on the next plane. `first` is the index
// of its first node, such that a node and the one `aside` nodes on in the next plane are stride() apart.
struct LatticePlane {
  float aside;
  int first;
};

struct Lattice : LatticeGrid {
  LatticePlane plane[kMostLatticePlanes];

  LFGS_HD int stride() const { return per_plane() + margin; }
  // How many places all nodes take in memory, at most.
  LFGS_HD int places() const { return nodes() + 2 * margin * (planes - 1); }
  // How many points are drawn: the nodes, and the middles of the cells in which samples may lie.
  LFGS_HD int points() const { return nodes() + cells() * (down - 1) * (planes - 1); }
};

}  // namespace lfgs::cuda
