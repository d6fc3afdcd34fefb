// Knobs of run time against error; as they stand here nothing is given up.
#pragma once

#include "math/constants.h"

namespace lfgs {

struct Quality {
  double log2_cut = kLog2MinAlpha;    // of the opacity cut: splats below it leave a sample as it is
  double stop = kMinTransmittance;    // a sample ends before its transmittance falls below
  double lattice = 0;                 // error allowed at the checks of a coarse lattice; 0: no lattice

  // A sample that ends early belongs to the splat at which it does; at the field's own limit, to the background.
  bool ends_early() const { return stop > kMinTransmittance; }
};

}  // namespace lfgs
