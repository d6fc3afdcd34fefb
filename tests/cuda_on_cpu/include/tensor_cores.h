// What cuda/frame/lens_column/lens_column_operands.cuh asks of tensor cores: mma.m16n8k16, mma.m16n8k8 and ldmatrix, a
// warp at a time.
#pragma once

#include <cuda_fp16.h>

namespace emulation {

inline float half_of(unsigned word, int place) { return __half2float({uint16_t(word >> 16 * place)}); }

// c = a b with a [16, K], b [K, 8]; each lane holds the parts that the PTX manual's figures of the fragments give it.
template <int K>
void multiply(float (&c)[4], const unsigned* a, const unsigned* b) {
  unsigned A[K / 4][32], B[K / 8][32];
  for (int i = 0; i < K / 4; ++i) gather(a[i], A[i]);
  for (int i = 0; i < K / 8; ++i) gather(b[i], B[i]);
  const int group = lane() / 4, thread = lane() % 4;
  for (int n = 0; n < 4; ++n) {
    const int row = group + 8 * (n / 2), column = 2 * thread + n % 2;
    c[n] = 0;
    for (int k = 0; k < K; ++k)
      c[n] += half_of(A[row / 8 + 2 * (k / 8)][row % 8 * 4 + k % 8 / 2], k % 2) *
              half_of(B[k / 8][column * 4 + k % 8 / 2], k % 2);
  }
}

// N matrices of 8 x 8 halves; lane i names row i % 8 of matrix i / 8.
template <int N>
void load(unsigned (&r)[N], unsigned address) {
  unsigned rows[32];
  gather(address, rows);
  for (int j = 0; j < N; ++j) memcpy(&r[j], dynamic_shared + rows[8 * j + lane() / 4] + lane() % 4 * 4, 4);
}

}  // namespace emulation

namespace lfgs::cuda {

inline void multiply(float (&c)[4], const unsigned (&a)[4], unsigned b0, unsigned b1) {
  const unsigned b[2] = {b0, b1};
  emulation::multiply<16>(c, a, b);
}
inline void multiply(float (&c)[4], const unsigned (&a)[2], unsigned b) { emulation::multiply<8>(c, a, &b); }
inline void load_matrix(unsigned (&r)[4], unsigned address) { emulation::load(r, address); }
inline void load_matrix(unsigned (&r)[2], unsigned address) { emulation::load(r, address); }

}  // namespace lfgs::cuda
