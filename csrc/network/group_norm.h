// Group normalisation of the network's feature maps on a CUDA device, for inference.
#pragma once

#include <cstdint>

#include "cuda/stages/stages.h"

namespace lfgs::cuda {

// The sizes of maps whose channels lie side by side ("channels last"). Each group has an even number of channels.
struct FeatureMaps {
  int64_t images, pixels;
  int channels, groups;
};

// out = silu(weight (in - mean) / sqrt(variance + eps) + bias). mean and variance are over a group of channels of one
// image (Wu & He, ECCV 2018, eq. 1 to 3). All arrays are bfloat16, two in a word; arithmetic is in float. out may be
// the same array as in.
void group_norm_silu(const FeatureMaps& maps, const uint32_t* in, const uint32_t* weight, const uint32_t* bias,
                     float eps, uint32_t* out, Stream stream);

}  // namespace lfgs::cuda
