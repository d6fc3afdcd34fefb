// The stages that lay a photo over the network's prediction, on the CPU. Every buffer belongs to the caller.
#pragma once

#include "math/photo/ramps.h"
#include "math/photo/sheet.h"
#include "math/photo/surface.h"

namespace lfgs {

// Write where the sheet lies, and the cloud under it.
void surface(const Surface& job, int threads);

// Write the Gaussians of all texels.
void sheet(const Sheet& job, int threads);

}  // namespace lfgs
