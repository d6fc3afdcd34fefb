// The stages that lay a photo over what the network predicts, on the CPU. Every buffer belongs to the caller.
#pragma once

#include "math/photo/sheet.h"

namespace lfgs {

// Writes the Gaussians of all texels.
void sheet(const Sheet& job, int threads);

}  // namespace lfgs
