// Knobs of run time against error; as they stand here nothing is given up.
#pragma once

#include <cstdint>

#include "math/constants.h"

namespace lfgs {

constexpr double kRoughError = 0.02;  // of a colour: at most this is lost by rough evaluation

struct Quality {
  double log2_cut = kLog2MinAlpha;  // of the opacity cut: splats below it leave a sample as it is
  double stop = kMinTransmittance;  // a sample ends before its transmittance falls below
  double lattice = 0;               // error allowed at the checks of a coarse lattice; 0: no lattice
  double contribution = 0;          // mean over an image of the alphas that may be left out with whole splats
  double evaluation = 0;            // error allowed of the arithmetic by which samples are evaluated

  // Whether samples may be evaluated in 16 bits, or in fewer operations.
  bool rough() const { return evaluation >= kRoughError; }

  // Log2 of the alpha from which a splat counts at a sample: roughly, the cut is one of patches.
  double hit_cut() const { return rough() ? double(kLog2MinAlpha) : log2_cut; }

  // The transmittance below which a sample need not be looked at any more.
  double darkest() const { return rough() && stop < 0.1 * kRoughError ? 0.1 * kRoughError : stop; }

  // A sample that ends early belongs to the splat at which it does; at the field's own limit, to the background.
  bool ends_early() const { return stop > kMinTransmittance; }

  // A splat's even share of what may be left out: alphas, summed over the pixels.
  double least_light(int64_t width_px, int64_t height_px, int64_t splats) const {
    return splats > 0 ? contribution * double(width_px) * double(height_px) / double(splats) : 0;
  }
};

}  // namespace lfgs
