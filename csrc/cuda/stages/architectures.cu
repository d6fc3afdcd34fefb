// Find the architectures of this build: nvcc defines the list as a macro.
#include "cuda/stages/stages.h"

namespace lfgs::cuda {

std::vector<int> architectures() {
  std::vector<int> found{__CUDA_ARCH_LIST__};  // values of __CUDA_ARCH__: 750, 900, 1200
  for (int& value : found) value /= 10;
  return found;
}

}  // namespace lfgs::cuda
