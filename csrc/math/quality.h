// The accuracy that kernels may give up for speed; by default none.
// lightfield_gs/rasterizer/quality.py has the knobs as users see them.
#pragma once

#include <cstdint>

#include "math/constants.h"

namespace lfgs {

constexpr double kApproximateError = 0.02;  // the largest change of a colour by approximate evaluation

struct Quality {
  double log2_cut = kLog2MinAlpha;  // log2 of the opacity cut: a splat of lower alpha leaves a sample as it is
  double stop = kMinTransmittance;  // a sample ends before its transmittance falls below
  double lattice = 0;               // error allowed at the checks of a coarse lattice; 0: no lattice
  double contribution = 0;          // mean over an image of the alpha that may be lost with whole splats
  double evaluation = 0;            // error allowed in the arithmetic of samples

  // Whether samples may be evaluated in 16 bits, or in fewer operations.
  bool approximate() const { return evaluation >= kApproximateError; }

  // Log2 of the alpha from which a splat counts at a sample. In approximate evaluation the opacity cut only chooses
  // patches, and all alphas from 1/255 on count within them.
  double sample_cut() const { return approximate() ? double(kLog2MinAlpha) : log2_cut; }

  // The transmittance below which a sample need not be looked at any more.
  double darkest() const { return approximate() && stop < 0.1 * kApproximateError ? 0.1 * kApproximateError : stop; }

  // Whether the limit is raised. Then the light that is left when a sample ends goes to the splat at which it ends. At
  // the field's own limit it goes to the background.
  bool ends_early() const { return stop > kMinTransmittance; }

  // The sum of alphas over the pixels that each splat may lose, if all splats may lose the same.
  double least_light(int64_t width_px, int64_t height_px, int64_t splats) const {
    return splats > 0 ? contribution * double(width_px) * double(height_px) / double(splats) : 0;
  }
};

}  // namespace lfgs
