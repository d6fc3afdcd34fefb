// The operands of composite_lens_column.cu: the layout of a block's shared memory, numbers as halves, and the
// instructions of the tensor cores.
#pragma once

#include <type_traits>

#include "cuda/common/blend.cuh"
#include "cuda/frame/composite_frame.cuh"
#include "cuda/common/halves.cuh"
#include "cuda/frame/lens_optics.cuh"

namespace lfgs::cuda {

constexpr int kWarpLenses = 4, kWarpRows = 16, kWarpsAcross = kTileLenses / kWarpLenses;
constexpr int kWarpsDown = kTileRows / kWarpRows, kWarps = kWarpsAcross * kWarpsDown, kThreads = 32 * kWarps;
// The 64 samples of a patch are four fragments of 16 for the tensor cores, or two halves of 32. A half has 8 rows, and
// one sample a lane.
constexpr int kFragments = 4, kHalves = 2;
constexpr float kMaxLineNumber = kMostLensColumns - 1, kMinLineNumber = 4, kMostViewsEach = 16;
constexpr float kMinCellLineNumber = 6;  // then half a lens is wider than a sub-pixel can stand aside of its stripe
constexpr unsigned kOnes = 0x3c003c00u;  // 1 and 1, as halves
constexpr unsigned kNothing = 0xe3d0;    // -1000 and 0, as halves: an exponent that draws nothing
// Bytes of a sample's features; where the second part of d's coefficients begins, and where A's coefficients begin.
constexpr int kFeatureBytes = 48, kHighOffset = 576, kExponentOffset = 1088;

// How a block uses shared memory. Two blocks should stand on a multiprocessor: with one, 8 warps are too few to cover
// each other's waits. The full layout does so with 228 KB (sm_90), the compact one with 100 KB (sm_86, sm_89, sm_120).
// KB of a block with harmonics, full and compact:
//   samples 24, 12    queues 9, 6    operands 12.5    colours 9.5    lenses 3
//   staged splats and their patches 31.5, 5    bytes of the tile 2 to 16, 0    all 92 to 107, 49
// A task with a list of one batch was counted in warp instructions (sheet:512 at 40 degrees). It takes 1460 for 52
// intersections: 380 to set up and join, 170 for each 32 operands, and 104 for each batch of products. So a list that
// is cut in two costs a third more, and the batch must not be small. The compact layout holds no splats, only
// their numbers, and every task reads its intersections from the cache. It draws half a group of lens columns at a
// time, a *pass*. Where a list is one batch, it is staged once for both passes.
template <bool Harmonics_, bool Compact_>
struct BlockLayout {
  static constexpr bool kHarmonics = Harmonics_, kCompact = Compact_;
  static constexpr bool kHoldsColours =
      !kHarmonics && !kCompact;  // otherwise they are read when an intersection is drawn
  static constexpr int kLensColumns = kCompact ? kGroupColumns / 2 : kGroupColumns;  // drawn at a time
  // Splats staged at a time
  static constexpr int kBatch = kHarmonics && kCompact ? 400 : 576;
  static_assert(kGroupColumns % kLensColumns == 0);  // those drawn at a time have one list
};
// When a lane looks for intersections it looks at so many splats of a batch at once.
constexpr int kAhead = 2;
// The shared memory that the system takes for each block, and the most that a block may take where two fit 100 KB.
constexpr int kReservedBytes = 1024, kCompactBytes = 100 * 1024 / 2 - kReservedBytes;

// The shared memory of a warp. The state of samples is the largest part, 512 bytes for each lens_column.
template <class Layout>
struct WarpMemory {
  static constexpr bool kHarmonics = Layout::kHarmonics;
  // Holds in turn the features of 32 samples, 48 bytes each, and the coefficients of 32 intersections. These are d in
  // two parts, then A, 16 bytes each.
  alignas(16) char operands[kExponentOffset + 512];
  uint4 colour[32], slope[kHarmonics ? 32 : 1];
  // The colours of the last intersection of every quarter in this round and in the one before, which change places
  float4 last_colour[2][Layout::kHoldsColours ? 1 : 4];
  uint2 last_slope[2][kHarmonics ? 4 : 1];
  uint16_t
      queue[Layout::kBatch];  // the intersections of the lens column that is drawn: which of the staged splats they are
  float2 state[Layout::kLensColumns * kHalves][32];  // colour and transmittance of each sample
  // For the lens of each sample, in the sample's row: the sub-pixel at lens column 0, the lens's first lens column, and
  // the one past its last. They are in memory, because the compiler would compute them again for every lens column
  // rather than keep so many registers.
  int start[kHalves][32];
  uchar2 lens_columns[kHalves][32];
  float x_first;  // x of lens column -1/2, the left edge of the first, in the middle row
};

// The shared memory of a block. In the full layout the bytes of the tile follow behind it: kTileRows x
// lens_row_bytes().
template <class Layout>
struct Memory {
  static constexpr int kBatch = Layout::kBatch;
  // The staged splats. Full layout: what they are, but for the depth, see splat_with_entry(), and their colours.
  // Compact layout: their numbers
  float4 splat[3][Layout::kCompact ? 1 : kBatch];
  float4 colour[Layout::kHoldsColours ? kBatch + 1 : 1];
  uint32_t id[Layout::kCompact ? kBatch : 1];
  // The patches that they touch, see patches_touched(); nothing, from behind the last to a multiple of kLooked
  static constexpr int kLooked = 32 * kAhead;
  uint32_t touched[kWarpsDown][(kBatch + kLooked - 1) / kLooked * kLooked];
  WarpMemory<Layout> warps[kWarps];
  int2 rows[kTileRows];  // first sub-pixel of the tile in each row, and of the next tile
  unsigned next_tile;
};
template <bool Harmonics>
using CompactMemory = Memory<BlockLayout<Harmonics, true>>;
static_assert(sizeof(CompactMemory<false>) <= kCompactBytes && sizeof(CompactMemory<true>) <= kCompactBytes);

__device__ inline unsigned halves(float a, float b) { return bits(__floats2half2_rn(a, b)); }
// A number as the sum of two halves: it keeps about twice the digits of one.
__device__ inline unsigned split(float a) {
  const float high = __half2float(__float2half_rn(a));
  return halves(high, a - high);
}

// The slope and the bend of a colour in a word. The tensor cores multiply differences between the slopes of successive
// splats with the transmittance before each. Errors from rounding these differences would add up over the splats,
// whereas an error in a slope itself counts only with that splat's weight. So slopes are rounded such that their
// differences are exact. A slope is a multiple of kCoarseStep (as a half; differences below 1/4 are exact) plus -8 to 7
// times kFineStep. That number of fine steps stands in the last four bits of the bend, a half that can spare them.
constexpr float kCoarseStep = 1.f / (1 << 13), kFineStep = kCoarseStep / 16;
__device__ inline unsigned slope_and_bend(float slope, float bend) {
  constexpr float kMagic = 1536;  // floats of about this size are multiples of kCoarseStep: adding it rounds
  const __half coarse = __float2half_rn((slope + kMagic) - kMagic);
  const float left = rintf((slope - __half2float(coarse)) * (1 / kFineStep));
  const int fine = int(fminf(fmaxf(left, -8.f), 7.f)), half = __half_as_ushort(__float2half_rn(bend));
  // Change the bend's bits as little as brings the fine steps into the last four
  int change = (fine - half) & 15;
  if (change > 8) change -= 16;
  if ((half & 0x7fff) + change < 0) change += 16;
  return unsigned(half + change) << 16 | __half_as_ushort(coarse);
}
__device__ inline float fine_steps(unsigned word) { return float(int(word << 12) >> 28); }
// The fine steps of two words as two halves. Both are too large by 1032, which cancels in differences.
__device__ inline __half2 fine_steps(unsigned a, unsigned b) {
  return as_half2((((a >> 16) & 0xf) | (b & 0xf0000)) ^ 0x64086408u);
}

// Return the number that it gets, but the compiler does not know that. So what follows from the number is worked out
// anew where it is needed, instead of being kept in registers or spilled.
__device__ inline int forgotten(int number) {
  asm volatile("" : "+r"(number));
  return number;
}

#if __CUDA_ARCH__ >= 800
// c = a b on the tensor cores, for a fragment of 16 samples and a batch of 8 intersections, over 16 or over 8
// coefficients. A lane receives samples lane / 4 (c[0], c[1]) and 8 more (c[2], c[3]) at intersections 2 (lane % 4) and
// the next.
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
// Load features from shared memory in the layout of the operand a. Every lane names the address of a row.
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

// Blend one intersection into one sample. `change` is the step from the colour of the intersection before. It is added
// with all the light so far, also where this intersection draws nothing: the intersections behind build on it. Limit:
// whether alpha may be above its most.
template <bool Limit>
__device__ inline void blend(float d, float A, float change, float cut, float& colour, float& transmittance) {
  const float power = fmaf(-d, d, A);
  float alpha = fast_exp2(power);
  if (Limit) alpha = fminf(alpha, float(kMaxAlpha));
  colour = fmaf(transmittance, change, colour);
  if (power >= cut) transmittance = fmaf(-alpha, transmittance, transmittance);
}

// An intersection's coefficients as halves: those of d in two parts, and those of A. Each lane of a quad reads two
// adjacent words: the first two lanes the four words of `low`, the others those of `high`.
struct Operands {
  uint4 low, high, exponent;
};

// A splat's colour at the three places of a pixel, as a parabola in v: value + slope v + bend v^2. Without harmonics
// there is only the value.
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
