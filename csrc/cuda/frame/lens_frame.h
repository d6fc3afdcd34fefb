// A light-field frame on the device, forward only: project -> bin -> order -> composite without the host in between.
// All sizes are fixed when the frame is made, nothing waits for the device, and every decision that depends on the
// scene is taken there: so a frame can be captured in a CUDA graph and replayed.
#pragma once

#include <algorithm>
#include <cstdint>

#include "base/config.h"
#include "cuda/stages/stages.h"

namespace lfgs::cuda {

// How composite goes about it. kPixel...: patches of pixels, large or small, the inverse standard deviation linear or
// quadratic in s (composite_pixel.cu). kOrdinal: tiles of lenses, tensor cores (composite_ordinal.cu).
enum class LensKernel : int { kPixel, kPixelQuadratic, kPixelSmall, kPixelQuadraticSmall, kOrdinal, kCount };

constexpr unsigned kShortList = 256;  // splats of a list that a warp sorts
constexpr int kMostProbeRows = 256;   // see kProbeRows: of 65,536 rows of pixels

// What one frame found out: written on the device, read by the host when it likes. The first four come from bin,
// the rest from project and composite.
struct FrameState {
  unsigned long long pairs;  // (tile, splat) pairs; when more than the capacity, composite walks all splats
  unsigned drawn;            // splats
  unsigned next_splat;       // of the list of all
  unsigned long_lists;       // of more than kShortList splats
  unsigned colour_error;     // bits of a float: largest estimated error of a colour polynomial
  int kernel;                // LensKernel chosen
  float straight, careful;   // limits of shape errors, see ShapeLimits; careful < 0: every splat is careful
  float curved;              // share of the splats beyond the first
  int lattices;              // whether any are laid
  unsigned next_tile[5];     // of each composite kernel
  unsigned lattice_tiles;    // drawn from a lattice
  unsigned refused_tiles;    // by the lattice: left to the kernel chosen
  unsigned tried_tiles;      // with splats, on which a lattice was laid
  unsigned long long probed[kMostProbeRows];  // tiles of rows on which lattices are tried first, see ProbedRow
  unsigned pruned;                            // splats, see Quality
  unsigned sampled;                           // splats in the sums below (a part of them, for speed)
  unsigned blocks_summed;                     // of project
  unsigned long long sums[15];                // see FrameSum, fixed point
};

constexpr int kMostOrdinals = 32;
constexpr int kPixelTileWidth = 64, kPixelTileHeight = 32;

// Sub-pixels t of all lenses, t = 0, 1, ...: the part of the rig that they see. With cells, t counts from one before
// the first stripe of a lens to one behind the last: those are of this lens or of the next.
struct Ordinals {
  int count, per_group, groups;
  int first_lens;                                    // left-most lens of the panel
  float centre[kMostOrdinals], half[kMostOrdinals];  // of s
  float view[kMostOrdinals];                         // of the camera coordinate, at the centre
  float view_unit;                                   // a power of 2 that scales its distance from there to about 1
  float cubic;                                       // `cubic` v is next to v^3, v that distance in an ordinal
  float reach;                                       // of v
  float most_bend;                                   // where s2 is no larger, none is careful; see kLeastBend
  LFGS_HD int columns() const { return groups * per_group; }  // count, and what fills the last group
};

// The lens for kernels, in float.
struct LensOptics {
  int width_px, height_px, views;
  uint64_t phase0, phase_x, phase_y;
  float line_number, origin, slant_tan;  // origin: phase of the first sub-pixel in [0, line_number)
  float s_start, s_step;
  int permuted, continuous;
  int channels[3], places[3];  // image channel at each place, place of each channel; permuted: not 0, 1, 2
  // Sub-pixels that do not stand in stripes: by place where all pixels have one order, else by channel
  int has_cells, lead;  // lead: ordinals before the first stripe of a lens
  float beyond;         // how far aside, at most, in sub-pixels
  SubpixelCells cells;
  Ordinals ordinals;
};

// Tiles in rows of `height` pixels; across they are steps of `width` along scale * (x + shear y), moved by low or high.
struct Tiling {
  int across, down, groups, height;
  float width, scale, low, high, shear;
  LFGS_HD int64_t tiles() const { return int64_t(across) * down * groups; }
};

struct Lattice;

struct LensFrame {
  View<double> rig;
  LensOptics optics;
  Tiling pixel, ordinal;
  bool has_ordinal = false;  // whether kOrdinal can draw this lens on this device
  int forced = -1;           // a LensKernel, or -1: chosen by cost
  int sh_degree = 0;
  int64_t capacity = 0;     // pairs
  float tolerance = 0;      // of colour polynomials
  float cut = 0, stop = 0;  // of Quality: log2 of the opacity cut, transmittance at which a sample may end
  float hit_cut = 0;        // log2 of the alpha from which a splat that reaches a patch counts at a sample
  float least_light = 0;    // see light_of: what has less is pruned
  float lattice = 0;        // of Quality: error allowed at the checks of a lattice; 0: none
  bool in_half = false;     // of Quality: kPixel and kPixelSmall evaluate in half precision, and `cut` is for patches

  // Parts of the work buffer. The state and the ranges project clears, with one launch
  FrameState* state = nullptr;
  uint32_t* ranges = nullptr;  // [lists, 2]: first and end of every list
  size_t cleared_bytes = 0;
  Splats<float> splats;
  uint32_t* depths = nullptr;      // [N]: bits of the splats' depths
  uint32_t* ids = nullptr;         // [capacity, or N if more]: the lists' splats, nearest first
  uint32_t* long_lists = nullptr;  // [lists]: which of them are long, in any order
  // With harmonics, by place: colours at the middles of ordinals, and the first and second power of v as halves (of the
  // first place in the fourth number of a colour)
  float* ordinal_colours = nullptr;    // [N, columns, 4]
  uint32_t* ordinal_slopes = nullptr;  // [N, columns, 2]
  // Of an anti-aliased scene: log2 of the share of opacity there, and its first and second power of v as halves
  float* ordinal_shares = nullptr;  // [N, columns, 2]
  Lattice* lattices = nullptr;      // [tiles], where any are laid: see composite_lattice.cu
  uint32_t* refused = nullptr;      // [tiles without groups]: those to draw, in any order, where lattices are laid

  LensFrame() = default;
  // Throws Error when the sizes do not fit 32 bits.
  LensFrame(int64_t gaussians, int sh_degree, int colour_order, const View<double>& rig, const Lens& lens,
            int64_t capacity, const Quality& quality, double tolerance);
  // Lays the parts out in `work` (null: only counts); returns the bytes.
  size_t place(void* work);
  // On the device: those of the kernel chosen; whether there are more pairs than places.
  LFGS_HD const Tiling& tiling() const { return state->kernel == int(LensKernel::kOrdinal) ? ordinal : pixel; }
  LFGS_HD bool overfull() const { return state->pairs > static_cast<unsigned long long>(capacity); }
  int64_t most_lists() const { return std::max(pixel.tiles(), has_ordinal ? ordinal.tiles() : 0); }
};

// The stages, in this order. gaussians: the frame's count and degree. Colours at order > 0: sh_degree > 0.
// keep_lists: bin and order will not follow, for only colours have changed since they last did.
// Otherwise bin follows once: project has cleared what it counts with.
void frame_project(const LensFrame& frame, const Gaussians<const float>& gaussians, bool keep_lists, Stream stream);
void frame_bin(const LensFrame& frame, Stream stream);  // after it state->pairs is known
void frame_order(const LensFrame& frame, Stream stream);
void frame_composite(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream);

// Parts of frame_composite. The lattice first, if the frame has one; then each of the others draws what the lattice
// refused, or all tiles, when the frame chose it.
void composite_lattice(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream);
void composite_pixel(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream);
void composite_ordinal(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream);
// Lenses across and rows down of a tile of composite_ordinal; whether it can draw a lens on the current device.
constexpr int kTileLenses = 16, kTileRows = 32, kGroupOrdinals = 6;
bool can_composite_ordinal(const Lens& lens);

}  // namespace lfgs::cuda
