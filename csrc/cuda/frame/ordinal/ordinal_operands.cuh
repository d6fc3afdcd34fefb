// What the kernel of composite_ordinal.cu multiplies: the layout of its shared memory, numbers as halves, tensor cores.
#pragma once

#include "cuda/common/blend.cuh"
#include "cuda/frame/composite_frame.cuh"
#include "cuda/common/halves.cuh"
#include "cuda/frame/lens_optics.cuh"

namespace lfgs::cuda {

constexpr int kWarpLenses = 4, kWarpRows = 16, kWarpsAcross = kTileLenses / kWarpLenses;
constexpr int kWarpsDown = kTileRows / kWarpRows, kWarps = kWarpsAcross * kWarpsDown, kThreads = 32 * kWarps;
constexpr int kFragments = 4, kHalves = 2;  // of 16 samples; of 32 samples, 8 rows each
constexpr float kMaxLineNumber = kMostOrdinals - 1, kMinLineNumber = 4, kMostViewsEach = 16;
constexpr float kMinCellLineNumber = 6;  // half a lens is more than sub-pixels stand aside
constexpr unsigned kOnes = 0x3c003c00u;  // two halves
constexpr unsigned kNothing = 0xe3d0;    // -1000 and 0: an exponent that draws nothing
constexpr int kFeatureBytes = 48, kHighOffset = 576, kExponentOffset = 1088;

// Splats staged at a time: what leaves room for two blocks on a multiprocessor. Queues hold the places of a *page* of
// them, a byte each.
template <bool Harmonics>
constexpr int kBatch = Harmonics ? 400 : 416;
constexpr int kPage = 256;

// What a warp keeps in shared memory.
template <bool Harmonics>
struct WarpMemory {
  // In turn: survivors of the first cull; features, 32 samples x 48 bytes; coefficients of 32 hits, 16 bytes each: d in
  // two parts, exponent.
  alignas(16) char operands[kExponentOffset + 512];
  uint4 colour[32], slope[Harmonics ? 32 : 1];
  // Of these 32 hits and of the 32 before, in turn: as they are in LensFrame
  float4 whole_colour[Harmonics ? 64 : 1];
  uint2 whole_slope[Harmonics ? 64 : 1];
  uint8_t queue[kGroupOrdinals][kBatch<Harmonics>];
  int first_page[kGroupOrdinals];              // how many of a queue lie in the first page, the others in the second
  float2 state[kGroupOrdinals * kHalves][32];  // colour and transmittance of each sample of the group
  // Of the lens of each sample, in its row: the sub-pixel at ordinal 0 and its phase; the first ordinal that is the
  // lens's own, and the first that is no more. In memory: the compiler would rather compute them again for every
  // ordinal than keep so many registers.
  int start[kHalves][32];
  ushort2 ordinals[kHalves][32];
  uint64_t phase[kHalves][32];
  float x_first;  // x of ordinal -1/2 in the middle row
};

static_assert(kBatch<false> * sizeof(uint16_t) <= sizeof(WarpMemory<false>::operands) && kBatch<false> <= 2 * kPage);

template <bool Harmonics>
struct Memory {
  float4 splat[3][kBatch<Harmonics>];                // where the depth was: of its colours, the first of the group
  float4 colour[Harmonics ? 1 : kBatch<false> + 1];  // with harmonics they are read when a hit is drawn
  WarpMemory<Harmonics> warps[kWarps];
  int2 rows[kTileRows];  // first sub-pixel of the tile in each row, and of the next tile
  unsigned next_tile;
  // then the bytes of the tile: kTileRows x lens_row_bytes()
};

__device__ inline unsigned halves(float a, float b) { return bits(__floats2half2_rn(a, b)); }
// A number as the sum of two halves.
__device__ inline unsigned split(float a) {
  const float high = __half2float(__float2half_rn(a));
  return halves(high, a - high);
}

// The slope and the bend of a colour in a word. What is multiplied are differences between splats, with the
// transmittance before each: what rounds these adds up, where what rounds a slope counts with the splat's own weight.
// So a slope is a multiple of kCoarseStep, a half of which differences below 1/4 are exact, and of kFineStep, -8 to 7
// of them; these stand in the last four bits of the bend, a half that can spare them.
constexpr float kCoarseStep = 1.f / (1 << 13), kFineStep = kCoarseStep / 16;
__device__ inline unsigned slope_and_bend(float slope, float bend) {
  constexpr float kMagic = 1536;  // a float beside it is a multiple of kCoarseStep
  const __half coarse = __float2half_rn((slope + kMagic) - kMagic);
  const float left = rintf((slope - __half2float(coarse)) * (1 / kFineStep));
  const int fine = int(fminf(fmaxf(left, -8.f), 7.f)), half = __half_as_ushort(__float2half_rn(bend));
  int change = (fine - half) & 15;  // of the bend's bits, as small as can be
  if (change > 8) change -= 16;
  if ((half & 0x7fff) + change < 0) change += 16;
  return unsigned(half + change) << 16 | __half_as_ushort(coarse);
}
__device__ inline float fine_steps(unsigned word) { return float(int(word << 12) >> 28); }
// Those of two words, or of one, as halves: 1032 more, which differences do not have.
__device__ inline __half2 fine_steps(unsigned a, unsigned b) {
  return as_half2((((a >> 16) & 0xf) | (b & 0xf0000)) ^ 0x64086408u);
}

// The same number, but the compiler does not know that: what follows from it is worked out anew where it is needed, and
// not kept in registers, or spilled.
__device__ inline int forgotten(int number) {
  asm volatile("" : "+r"(number));
  return number;
}

#if __CUDA_ARCH__ >= 800
__device__ inline void multiply(float (&c)[4], const unsigned (&a)[4], unsigned b0, unsigned b1) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3},{%4,%5,%6,%7},{%8,%9},{%10,%10,%10,%10};"
      : "=f"(c[0]), "=f"(c[1]), "=f"(c[2]), "=f"(c[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1), "f"(0.f));
}
__device__ inline void multiply(float (&c)[4], const unsigned (&a)[2], unsigned b) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0,%1,%2,%3},{%4,%5},{%6},{%7,%7,%7,%7};"
      : "=f"(c[0]), "=f"(c[1]), "=f"(c[2]), "=f"(c[3])
      : "r"(a[0]), "r"(a[1]), "r"(b), "f"(0.f));
}
__device__ inline void load_matrix(unsigned (&r)[4], unsigned address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3},[%4];"
               : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
               : "r"(address)
               : "memory");
}
__device__ inline void load_matrix(unsigned (&r)[2], unsigned address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x2.shared.b16 {%0,%1},[%2];"
               : "=r"(r[0]), "=r"(r[1])
               : "r"(address)
               : "memory");
}

template <bool Limit>
__device__ inline void blend(float d, float A, float change, float cut, float& colour, float& transmittance) {
  const float power = fmaf(-d, d, A);
  float alpha = fast_exp2(power);
  if (Limit) alpha = fminf(alpha, float(kMaxAlpha));
  colour = fmaf(transmittance, change, colour);
  if (power >= cut) transmittance = fmaf(-alpha, transmittance, transmittance);
}

// A hit's coefficients as halves: of d in two parts, of the exponent.
struct Operands {
  uint4 low, high, exponent;
};

// Of the three places of a pixel, as a parabola in v: value + slope v + bend v^2; without harmonics the value.
struct Colour {
  float value[3];
  unsigned slope[3];  // see slope_and_bend

  __device__ Colour() {
#pragma unroll
    for (int c = 0; c < 3; ++c) value[c] = 0, slope[c] = 0;
  }
};
template <class T>
__device__ inline T at_place(const T (&parts)[3], int place) {
  return place == 0 ? parts[0] : place == 1 ? parts[1] : parts[2];
}
#endif

}  // namespace lfgs::cuda
