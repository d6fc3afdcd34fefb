// The stages that lay a photo over what the network predicts, on a CUDA device: the same as the CPU's (stages/photo.h),
// with device pointers and a stream. Nothing allocates or waits: a CUDA graph can hold them.
#pragma once

#include "cuda/stages/stages.h"
#include "math/photo/sheet.h"
#include "math/photo/surface.h"

namespace lfgs::cuda {

void surface(const Surface& job, Stream stream);
void sheet(const Sheet& job, Stream stream);

}  // namespace lfgs::cuda
