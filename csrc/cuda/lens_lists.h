// Lists of a light-field frame: splats by depth, and for every tile (and group of ordinals) those that may touch it.
#pragma once

#include "cuda/lens_frame.h"

namespace lfgs::cuda {

// Scratch memory of the sorts and the scan.
size_t lists_temporary_bytes(const LensFrame& frame);

}  // namespace lfgs::cuda
