// Lists of a light-field frame: splats by depth, and for every tile (and group of ordinals) those that may touch it.
#pragma once

#include "cuda/lens_frame.h"

namespace lfgs::cuda {

// Pieces of work of bin, at most.
int64_t most_pieces(const LensFrame& frame);
// Scratch memory of the sorts.
size_t lists_temporary_bytes(const LensFrame& frame);

}  // namespace lfgs::cuda
