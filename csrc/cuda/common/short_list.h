// How long a list of splats may be for a warp to sort it; longer ones are left to blocks.
#pragma once

namespace lfgs::cuda {

constexpr unsigned kShortList = 256;

}  // namespace lfgs::cuda
