#include "cuda/common/architectures.h"

namespace lfgs::cuda {

std::vector<int> architectures() {
  std::vector<int> found{__CUDA_ARCH_LIST__};  // nvcc's, of the values of __CUDA_ARCH__: 750, 900, 1200
  for (int& value : found) value /= 10;
  return found;
}

}  // namespace lfgs::cuda
