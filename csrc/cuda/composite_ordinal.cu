// Composite of a light-field frame by tiles of lenses, for rigs of large disparity. Needs tensor cores (sm_80).
//
// The t-th sub-pixels of neighbouring lenses see nearly the same part of the rig: an *ordinal* t covers 1 / P_e of it.
// A warp task is 4 lenses x 16 rows at one ordinal, 64 samples. With x, y, v (the view, scaled) about its centre,
//   exponent = A(y) - d(x, y, v)^2,   A = log2 o - tau (y - v0)^2,   d = S^(-1/2) (x - m(y, s)) to second order in v,
// are inner products of features of the sample with coefficients of the splat: d has 16 of them, A has 8, in half
// precision, large coefficients as the sum of two halves; the tensor cores multiply, in float. So do the colours: of
// each sample's features only those of its own channel are not zero. Colours enter as differences to the splat before.
//
// A tile has 16 lenses x 32 rows, 8 warps; its ordinals come in groups, each with a list of splats. Lane t of each quad
// takes one contiguous quarter of a task's hits; over is associative, the quarters are joined once.
#include <cuda_fp16.h>

#include "cuda/blend.cuh"
#include "cuda/composite_lens.cuh"
#include "cuda/lens_optics.cuh"
#include "cuda/strip.cuh"

namespace lfgs::cuda {
namespace {

constexpr int kWarpLenses = 4, kWarpRows = 16, kWarpsAcross = kTileLenses / kWarpLenses;
constexpr int kWarpsDown = kTileRows / kWarpRows, kWarps = kWarpsAcross * kWarpsDown, kThreads = 32 * kWarps;
constexpr int kFragments = 4, kHalves = 2;  // of 16 samples; of 32 samples, 8 rows each
constexpr float kMaxLineNumber = kMostOrdinals - 1, kMinLineNumber = 4, kMostViewsEach = 16;
constexpr unsigned kOnes = 0x3c003c00u;     // two halves
constexpr unsigned kNothing = 0xe3d0;       // -1000 and 0: an exponent that draws nothing
constexpr int kFeatureBytes = 48, kHighOffset = 576, kExponentOffset = 1088;

// Splats staged at a time.
template <bool Harmonics>
constexpr int kBatch = Harmonics ? 192 : 256;

// Offset that v = 1 stands for.
__device__ inline float offset_unit(const LensOptics& lens) { return lens.s_step / lens.ordinals.view_unit; }

// What a warp keeps in shared memory.
template <bool Harmonics>
struct WarpMemory {
  // First features, 32 samples x 48 bytes. Then coefficients of 32 hits, 16 bytes each: d in two parts, exponent.
  alignas(16) char operands[kExponentOffset + 512];
  uint4 colour[32], slope[Harmonics ? 32 : 1];
  uint8_t queue[kGroupOrdinals][kBatch<Harmonics>], survivors[kBatch<Harmonics>];
  float2 state[kGroupOrdinals * kHalves][32];  // colour and transmittance of each sample of the group
  // Of the lens of each sample, in its row: the first sub-pixel and its phase, the number of sub-pixels. In memory: the
  // compiler would rather compute them again for every ordinal than keep so many registers.
  int start[kHalves][32], length[kHalves][32];
  uint64_t phase[kHalves][32];
};

template <bool Harmonics>
struct Memory {
  float4 splat[3][kBatch<Harmonics>];
  // Colours; harmonics: at each ordinal of the group, and as halves the first and second power of v
  float4 colour[Harmonics ? kGroupOrdinals : 1][kBatch<Harmonics>];  // .w: of the first place
  uint2 slopes[Harmonics ? kGroupOrdinals : 1][Harmonics ? kBatch<Harmonics> : 1];  // of the others
  WarpMemory<Harmonics> warps[kWarps];
  int2 rows[kTileRows];  // first sub-pixel of the tile in each row, and of the next tile
  unsigned next_tile;
  // then the bytes of the tile: kTileRows x row_bytes()
};

int row_bytes(float line_number) { return (int(kTileLenses * line_number) + 5) & ~3; }

__device__ inline unsigned halves(float a, float b) {
  const __half2 h = __floats2half2_rn(a, b);
  return *reinterpret_cast<const unsigned*>(&h);
}
// A number as the sum of two halves.
__device__ inline unsigned split(float a) {
  const float high = __half2float(__float2half_rn(a));
  return halves(high, a - high);
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
__device__ inline void blend(float d, float A, float change, float& colour, float& transmittance) {
  const float power = fmaf(-d, d, A);
  float alpha = fast_exp2(power);
  if (Limit) alpha = fminf(alpha, float(kMaxAlpha));
  colour = fmaf(transmittance, change, colour);
  if (power >= float(kLog2MinAlpha)) transmittance = fmaf(-alpha, transmittance, transmittance);
}

// Of the three places of a pixel, as a parabola in v: value + slope.x v + slope.y v^2; without harmonics the value.
struct Colour {
  float value[3];
  __half2 slope[3];

  __device__ Colour() {
#pragma unroll
    for (int c = 0; c < 3; ++c) value[c] = 0, slope[c] = __float2half2_rn(0.f);
  }
};
template <class T>
__device__ inline T at_place(const T (&parts)[3], int place) {
  return place == 0 ? parts[0] : place == 1 ? parts[1] : parts[2];
}
__device__ inline unsigned bits(__half2 h) { return *reinterpret_cast<const unsigned*>(&h); }
__device__ inline __half2 as_half2(unsigned b) { return *reinterpret_cast<const __half2*>(&b); }

// The warp task, and what its lanes know of it.
template <bool Harmonics>
struct Task {
  const LensFrame& frame;
  Memory<Harmonics>& memory;
  WarpMemory<Harmonics>& own;
  int lane, row0, lens0;             // of the patch
  float middle_y;
  float x_sheared, half_x;           // of ordinal -1/2, x + tan y; half width to the outermost pixel centres
  float x_first;                     // x of ordinal -1/2 in the middle row
  unsigned places;                   // bit 8 p + s: the lens of sample s that this lane accumulates starts at place p

  __device__ Task(const LensFrame& frame_, Memory<Harmonics>& memory_, int tile_x, int tile_y)
      : frame(frame_), memory(memory_), own(memory_.warps[threadIdx.x / 32]), lane(threadIdx.x % 32) {
    const int warp = threadIdx.x / 32, across = warp % kWarpsAcross, down = warp / kWarpsAcross;
    const LensOptics& lens = frame.optics;
    row0 = tile_y * kTileRows + down * kWarpRows;
    lens0 = lens.ordinals.first_lens + (tile_x * kWarpsAcross + across) * kWarpLenses;
    middle_y = row0 + 0.5f * kWarpRows;
    const float phase0 = fmaf(lens0 + 0.5f * (kWarpLenses - 1), lens.line_number, -lens.origin);
    x_sheared = phase0 / 3 + 0.5f * lens.slant_tan + 1.f / 6;
    x_first = x_sheared - lens.slant_tan * middle_y;
    half_x = (0.5f * (kWarpLenses - 1) * lens.line_number + 0.5f) / 3 + 1.f / 3 + 0.01f;
    for (int h = 0; h < kHalves; ++h) {
      const int row = row0 + lane / kWarpLenses + 8 * h, number = lens0 + lane % kWarpLenses;
      const int start = lens_start(lens, row, number);
      own.start[h][lane] = start, own.length[h][lane] = lens_start(lens, row, number + 1) - start;
      own.phase[h][lane] = phase_at(lens, row, start);
    }
    __syncwarp();
    places = 0;
    for (int s = 0; s < 2 * kFragments; ++s)  // fragment s / 2, its row lane / 4 or 8 more
      places |= 1u << 8 * place_of(own.start[s / 4][s / 2 % 2 * 16 + s % 2 * 8 + lane / 4]) + s;
  }

  // x + tan y of an ordinal's samples, and of those of a group
  __device__ float sheared(float ordinal) const { return x_sheared + (ordinal + 0.5f) / 3; }

  __device__ Splat<float> staged(int i) const {
    return assembled(memory.splat[0][i], memory.splat[1][i], memory.splat[2][i]);
  }
  __device__ Strip strip(const Splat<float>& s) const {
    return Strip(s, row0 + 0.5f, row0 + kWarpRows - 0.5f, frame.optics.slant_tan);
  }

  // Which staged splats may touch the patch at which ordinal of the group; returns, in lane t, how many at ordinal t.
  __device__ int cull(int count, int first, int last) {
    const Ordinals& ordinals = frame.optics.ordinals;
    const float a = ordinals.centre[first], b = ordinals.centre[last];
    const float reach = fmaxf(fabsf(b - a) * 0.5f + ordinals.half[first], fabsf(b - a) * 0.5f + ordinals.half[last]);
    const unsigned before = (1u << lane) - 1;
    const float x = sheared(0.5f * (first + last)), half = half_x + (last - first) * (1.f / 6);
    int survivors = 0;
    for (int begin = 0; begin < count; begin += 32) {
      const int i = min(begin + lane, count - 1);
      const Splat<float> splat = staged(i);
      const Strip rows = strip(splat);
      const bool hit = (begin + lane < count) & rows.at(splat, 0.5f * (a + b), reach).touches(x, half);
      const unsigned hits = __ballot_sync(~0u, hit);
      if (hit) own.survivors[survivors + __popc(hits & before)] = i;
      survivors += __popc(hits);
    }
    __syncwarp();
    const float x_first_ordinal = sheared(first);
    int counts[kGroupOrdinals] = {};
    for (int begin = 0; begin < survivors; begin += 32) {
      const bool inside = begin + lane < survivors;
      const int i = own.survivors[inside ? begin + lane : 0];
      const Splat<float> splat = staged(i);
      const Strip rows = strip(splat);
#pragma unroll
      for (int t = 0; t < kGroupOrdinals; ++t) {
        const int ordinal = min(first + t, last);
        const Span span = rows.at(splat, ordinals.centre[ordinal], ordinals.half[ordinal]);
        const bool hit = inside & (first + t <= last) & span.touches(x_first_ordinal + t * (1.f / 3), half_x);
        const unsigned hits = __ballot_sync(~0u, hit);
        if (hit) own.queue[t][counts[t] + __popc(hits & before)] = i;
        counts[t] += __popc(hits);
      }
    }
    __syncwarp();
    int mine = 0;
#pragma unroll
    for (int t = 0; t < kGroupOrdinals; ++t) mine = lane == t ? counts[t] : mine;
    return mine;
  }

  // Features of the samples at an ordinal as operands of the tensor cores; false when no lens has so many sub-pixels.
  __device__ bool features(int ordinal, float x_centre, unsigned (&d)[kFragments][4], unsigned (&A)[kFragments][2]) {
    const LensOptics& lens = frame.optics;
    const unsigned base = unsigned(__cvta_generic_to_shared(own.operands));
    bool any = false;
    uint4 low[kHalves], high[kHalves], rows[kHalves];  // all before the first is stored: their latencies overlap
#pragma unroll
    for (int h = 0; h < kHalves; ++h) {
      any |= ordinal < own.length[h][lane];
      const int pixel = int(floorf((own.start[h][lane] + ordinal + 0.5f) * (1.f / 3)));
      const float x = pixel + 0.5f - x_centre, y = lane / kWarpLenses + 8 * h + 0.5f - 0.5f * kWarpRows;
      // From its start no sub-pixel of a lens wraps
      const float camera = camera_of(lens, own.phase[h][lane] + lens.phase_x * uint64_t(ordinal));
      const float v = (camera - lens.ordinals.view[ordinal]) * lens.ordinals.view_unit;
      const float vv = v * v, rest = lens.continuous ? v - __half2float(__float2half_rn(v)) : vv;
      low[h] = make_uint4(kOnes, halves(x, x), halves(y, y), halves(v, v));
      high[h] = make_uint4(halves(x * v, y * v), halves(vv, y * vv), halves(x * vv, vv * v), halves(rest, y * v));
      rows[h] = make_uint4(kOnes, halves(y, y), halves(y * y, y * y), 0);
    }
#pragma unroll
    for (int h = 0; h < kHalves; ++h) {
      __syncwarp();
      uint4* to = reinterpret_cast<uint4*>(own.operands + lane * kFeatureBytes);
      to[0] = low[h], to[1] = high[h], to[2] = rows[h];
      __syncwarp();
#pragma unroll
      for (int f = 0; f < 2; ++f) {
        const unsigned row = base + (16 * f + lane % 16) * kFeatureBytes;
        load_matrix(d[2 * h + f], row + lane / 16 * 16);
        load_matrix(A[2 * h + f], row + 32);
      }
    }
    return __any_sync(~0u, any);
  }

  // The coefficients of d and of the exponent for one hit, about (x_centre, middle_y) and the offset centre; unit is
  // the offset that v = 1 stands for.
  __device__ void coefficients(const Splat<float>& s, float centre, float unit, float x_centre, uint4& low,
                               uint4& high, uint4& exponent) const {
    const float S = fmaf(centre, fmaf(centre, s.S2, s.S1), s.S0), r = fast_rsqrt(S), inverse = r * r;
    const float s1 = fmaf(2 * centre, s.S2, s.S1) * unit * inverse, s2 = s.S2 * unit * unit * inverse;
    const float p1 = -0.5f * s1, p2 = fmaf(0.375f * s1, s1, -0.5f * s2);
    const float Y = middle_y - s.v0, tilt = fmaf(centre, s.c1, s.c0);
    const float E = fmaf(-tilt, Y, fmaf(-centre, s.du, x_centre - s.u0)), sweep = unit * fmaf(s.c1, Y, s.du);
    const float turn = unit * s.c1;
    const float v = fmaf(p1, E, -sweep) * r, yv = fmaf(-p1, tilt, -turn) * r, vv = fmaf(p2, E, -p1 * sweep) * r;
    const float yvv = fmaf(-p2, tilt, -p1 * turn) * r, vvv = -p2 * sweep * r;
    // The second half of vv, or where v itself is not exact in half the coefficient of what is left of it
    const unsigned v_ = split(v), vv_ = split(vv), yv_ = split(yv);
    const unsigned rest = frame.optics.continuous ? v_ << 16 : vv_;
    low = make_uint4(split(E * r), halves(p1 * r, yv), split(r), halves(vv, yvv));
    high = make_uint4(split(-tilt * r), halves(p2 * r, vvv), v_, __byte_perm(rest, yv_, 0x7632));
    exponent = make_uint4(split(fmaf(-s.tau * Y, Y, s.log2_opacity)), split(-2 * s.tau * Y), split(-s.tau), 0);
  }

  // The colour of a staged splat at ordinal t of the group.
  __device__ Colour colour(int i, int t) const {
    Colour out;
    const float4 c = memory.colour[Harmonics ? t : 0][i];
    out.value[0] = c.x, out.value[1] = c.y, out.value[2] = c.z;
    if (Harmonics) {
      const uint2 slopes = memory.slopes[Harmonics ? t : 0][Harmonics ? i : 0];
      out.slope[0] = as_half2(__float_as_uint(c.w));
      out.slope[1] = as_half2(slopes.x), out.slope[2] = as_half2(slopes.y);
    }
    return out;
  }

  // The samples, a bit each, of which this lane of a quad multiplies the colours: those of place `quad` at an ordinal.
  __device__ unsigned own_place(int ordinal) const {
    const int quad = lane % 4;
    return places >> 8 * (quad == 3 ? 3 : (quad + 3 - ordinal % 3) % 3);
  }
  // What belongs to the place of an accumulated sample; parts by the place that its lens starts at.
  template <class T>
  __device__ T pick(const T (&parts)[3], int sample) const {
    return places >> sample & 1 ? parts[0] : places >> (8 + sample) & 1 ? parts[1] : parts[2];
  }

  // v of an accumulated sample; it stands in the last columns of its features.
  __device__ float view_of(const unsigned (&features)[kFragments][4], int sample) const {
    const unsigned pair = __shfl_sync(~0u, features[sample / 2][sample % 2], lane | 3);
    return __low2float(as_half2(pair));
  }

  // Adds the n hits at ordinal t of the group to the samples' state.
  __device__ void draw(int t, int n, int ordinal) {
    const int quad = lane % 4, row = lane / 4;
    const float x_centre = floorf(x_first + (ordinal + 0.5f) * (1.f / 3));
    unsigned d_features[kFragments][4], A_features[kFragments][2], colour_features[kFragments][4];
    if (!features(ordinal, x_centre, d_features, A_features)) return;
    const float centre = frame.optics.ordinals.centre[ordinal], unit = offset_unit(frame.optics);
    const unsigned mine = own_place(ordinal);
#pragma unroll
    for (int s = 0; s < 2 * kFragments; ++s) {
      const float v = Harmonics ? view_of(d_features, s) : 0;
      colour_features[s / 2][s % 2] = mine >> s & 1 ? kOnes : 0;
      colour_features[s / 2][s % 2 + 2] = mine >> s & 1 ? halves(v, v * v) : 0;
    }

    float colours[2 * kFragments] = {}, transmittances[2 * kFragments];
#pragma unroll
    for (int s = 0; s < 2 * kFragments; ++s) transmittances[s] = 1;
    const int quarter = (n + 3) / 4;
    Colour kept, current;
    int begin = 0;
    for (; begin < quarter; begin += 8) {
      // 32 hits, one a lane: 8 of each quarter, columns 2 q and 2 q + 1 of four batches
      __syncwarp();
      const int q = lane % 8 / 2, j = begin + lane / 8 * 2 + lane % 2;
      const bool valid = j < min(quarter, n - q * quarter);
      const int i = own.queue[t][valid ? q * quarter + j : 0];
      const Splat<float> splat = staged(i);
      bool limit = valid && splat.log2_opacity > float(kLog2MaxAlpha);
      uint4 low, high, exponent;
      coefficients(splat, centre, unit, x_centre, low, high, exponent);
      if (!valid) exponent = make_uint4(kNothing, 0, 0, 0);
      current = valid ? colour(i, t) : Colour();
      store_operands(low, high, exponent, current, kept);
      __syncwarp();
      limit = __any_sync(~0u, limit);
      const int batches = min(4, (quarter - begin + 1) / 2);
      auto batch = [&](int b, auto limited) {
        const char* at = own.operands + quad / 2 * kHighOffset + (8 * b + row) * 16 + quad % 2 * 8;
        const uint2 d_b = *reinterpret_cast<const uint2*>(at);
        const int word = (8 * b + row) * 4 + quad;
        const unsigned A_b = reinterpret_cast<const unsigned*>(own.operands + kExponentOffset)[word];
        const unsigned c_b = reinterpret_cast<const unsigned*>(own.colour)[word];
        const unsigned s_b = Harmonics ? reinterpret_cast<const unsigned*>(own.slope)[word] : 0;
#pragma unroll
        for (int f = 0; f < kFragments; ++f) {
          float d[4], A[4], c[4];
          multiply(d, d_features[f], d_b.x, d_b.y);
          multiply(A, A_features[f], A_b);
          if (Harmonics) {
            multiply(c, colour_features[f], c_b, s_b);
          } else {
            const unsigned one_hot[2] = {colour_features[f][0], colour_features[f][1]};
            multiply(c, one_hot, c_b);
          }
          constexpr bool Limit = decltype(limited)::value;
          blend<Limit>(d[0], A[0], c[0], colours[2 * f], transmittances[2 * f]);
          blend<Limit>(d[2], A[2], c[2], colours[2 * f + 1], transmittances[2 * f + 1]);
          blend<Limit>(d[1], A[1], c[1], colours[2 * f], transmittances[2 * f]);
          blend<Limit>(d[3], A[3], c[3], colours[2 * f + 1], transmittances[2 * f + 1]);
        }
      };
      if (!limit) {
        batch(0, std::false_type{});
        if (batches > 1) batch(1, std::false_type{});
        if (batches > 2) batch(2, std::false_type{});
        if (batches > 3) batch(3, std::false_type{});
      } else {
#pragma unroll 1
        for (int b = 0; b < batches; ++b) batch(b, std::true_type{});
      }
    }
    if (quarter % 2 == 0) close(current, quarter - 1 - (begin - 8), ordinal % 3, d_features, colours, transmittances);
    join(t, colours, transmittances);
  }

  // One hit's operands; its colour as the difference to the hit before it in its quarter. kept: the colour of the last
  // column of the 32 hits before.
  __device__ void store_operands(const uint4& low, const uint4& high, const uint4& exponent, const Colour& current,
                                 Colour& kept) {
    const bool first = lane / 8 == 0 && lane % 2 == 0, last = lane / 8 == 3 && lane % 2 == 1;
    const int source = lane % 2 ? lane - 1 : first ? lane + 25 : lane - 7;
    Colour change;
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      change.value[c] = current.value[c] - __shfl_sync(~0u, last ? kept.value[c] : current.value[c], source);
      if (Harmonics)
        change.slope[c] = __hsub2(
            current.slope[c], as_half2(__shfl_sync(~0u, bits(last ? kept.slope[c] : current.slope[c]), source)));
    }
    kept = current;
    reinterpret_cast<uint4*>(own.operands)[lane] = low;
    reinterpret_cast<uint4*>(own.operands + kHighOffset)[lane] = high;
    reinterpret_cast<uint4*>(own.operands + kExponentOffset)[lane] = exponent;
    own.colour[lane] = make_uint4(split(change.value[0]), split(change.value[1]), split(change.value[2]), 0);
    if (Harmonics)
      own.slope[Harmonics ? lane : 0] =
          make_uint4(bits(change.slope[0]), bits(change.slope[1]), bits(change.slope[2]), 0);
  }

  // Takes the last colour of each quarter off again where no spare column did. j: its place in the last 32 hits.
  __device__ void close(const Colour& current, int j, int shift, const unsigned (&features)[kFragments][4],
                        float (&colours)[2 * kFragments], const float (&transmittances)[2 * kFragments]) {
    const int source = j / 2 * 8 + lane % 4 * 2 + j % 2;
    Colour end;  // by the place that a lens starts at
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      const int place = c + shift >= 3 ? c + shift - 3 : c + shift;
      end.value[c] = __shfl_sync(~0u, at_place(current.value, place), source);
      if (Harmonics) end.slope[c] = as_half2(__shfl_sync(~0u, bits(at_place(current.slope, place)), source));
    }
#pragma unroll
    for (int s = 0; s < 2 * kFragments; ++s) {
      float value = pick(end.value, s);
      if (Harmonics) {
        const __half2 slope = pick(end.slope, s);
        const float v = view_of(features, s);
        value += v * fmaf(v, __high2float(slope), __low2float(slope));
      }
      colours[s] = fmaf(-transmittances[s], value, colours[s]);
    }
  }

  // Joins the four quarters, nearest first, behind what the samples hold; each lane keeps two samples.
  __device__ void join(int t, const float (&colours)[2 * kFragments], const float (&transmittances)[2 * kFragments]) {
    const bool odd = lane & 1, upper = lane & 2;
    float colour[kFragments], transmittance[kFragments];
    auto over = [](bool mine_behind, float c, float other_c, float T, float other_T) {
      return mine_behind ? fmaf(other_T, c, other_c) : fmaf(T, other_c, c);
    };
#pragma unroll
    for (int i = 0; i < kFragments; ++i) {
      const int away = kFragments + i;
      const float c = __shfl_xor_sync(~0u, odd ? colours[i] : colours[away], 1);
      const float T = __shfl_xor_sync(~0u, odd ? transmittances[i] : transmittances[away], 1);
      const float own_c = odd ? colours[away] : colours[i], own_T = odd ? transmittances[away] : transmittances[i];
      colour[i] = over(odd, own_c, c, own_T, T), transmittance[i] = own_T * T;
    }
#pragma unroll
    for (int i = 0; i < kHalves; ++i) {
      const int away = kHalves + i;
      const float c = __shfl_xor_sync(~0u, upper ? colour[i] : colour[away], 2);
      const float T = __shfl_xor_sync(~0u, upper ? transmittance[i] : transmittance[away], 2);
      const float own_c = upper ? colour[away] : colour[i], own_T = upper ? transmittance[away] : transmittance[i];
      float2& state = own.state[t * kHalves + i][lane];
      state = make_float2(fmaf(state.y, over(upper, own_c, c, own_T, T), state.x), state.y * own_T * T);
    }
  }

  __device__ bool opaque(int t) const {
    bool all = true;
#pragma unroll
    for (int i = 0; i < kHalves; ++i) all = all && own.state[t * kHalves + i][lane].y < float(kMinTransmittance);
    return __all_sync(~0u, all);
  }

  // Hands every finished sample of ordinals first .. last to put(row in the tile, sub-pixel from its first, value).
  template <class Put>
  __device__ void finish(int first, int last, const float4& background, const Put& put) {
    const int quad = lane % 4, down = threadIdx.x / 32 / kWarpsAcross;
#pragma unroll
    for (int i = 0; i < kHalves; ++i) {
      const int sample = quad % 2 * kFragments + quad / 2 * kHalves + i, fragment = sample / 2;
      const int half = fragment / 2, slot = fragment % 2 * 16 + sample % 2 * 8 + lane / 4;
      const int row = down * kWarpRows + slot / kWarpLenses + 8 * half;
      const int start = own.start[half][slot], end = min(own.length[half][slot] - 1, last);
      int place = place_of(start + first), at = start - memory.rows[row].x + first;
      for (int ordinal = first; ordinal <= end; ++ordinal, ++at) {
        const float2 state = own.state[(ordinal - first) * kHalves + i][lane];
        const float behind = place == 0 ? background.x : place == 1 ? background.y : background.z;
        put(row, at, fmaf(state.y, behind, state.x));
        place = place == 2 ? 0 : place + 1;
      }
    }
  }
};

// The colours of staged splat i about kShare ordinals of the group from number t: parabolas through the ends and the
// middle of each, none below zero.
constexpr int kShare = 3;  // fewer read the polynomial more often, more leave threads without work
__device__ inline void stage_colours(const LensFrame& frame, uint32_t id, int i, int t, int first, int last,
                                     Memory<true>& memory) {
  const Ordinals& ordinals = frame.optics.ordinals;
  const Splats<float>& splats = frame.splats;
  const int order = splats.orders[id];
  const float4* powers = reinterpret_cast<const float4*>(splats.colours) + int64_t(id) * (splats.colour_order + 1);
  constexpr int kAhead = 4;  // loads under way at a time
  float s[kShare][3], values[kShare][3][3] = {};  // ordinals; low, middle, high; places
#pragma unroll
  for (int o = 0; o < kShare; ++o)
#pragma unroll
    for (int n = 0; n < 3; ++n) {
      const int ordinal = min(first + t + o, last);
      s[o][n] = fmaf(float(n - 1), ordinals.half[ordinal], ordinals.centre[ordinal]);
    }
  for (int high = order; high >= 0; high -= kAhead) {
    float4 c[kAhead];
#pragma unroll
    for (int k = 0; k < kAhead; ++k) c[k] = by_place(frame.optics, powers[max(high - k, 0)]);
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      if (high < k) break;
#pragma unroll
      for (int o = 0; o < kShare; ++o)
#pragma unroll
        for (int n = 0; n < 3; ++n) {
          float(&value)[3] = values[o][n];
          value[0] = fmaf(value[0], s[o][n], c[k].x), value[1] = fmaf(value[1], s[o][n], c[k].y);
          value[2] = fmaf(value[2], s[o][n], c[k].z);
        }
    }
  }
#pragma unroll
  for (int o = 0; o < kShare; ++o) {
    if (first + t + o > last) break;
    const float half = ordinals.half[first + t + o];
    const float inverse = half > 0 ? 0.5f * offset_unit(frame.optics) / half : 0.5f;  // of v there, with its sign
    float middle[3];
    __half2 slope[3];
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      const float low = fmaxf(values[o][0][c], 0.f), high = fmaxf(values[o][2][c], 0.f);
      middle[c] = fmaxf(values[o][1][c], 0.f);
      slope[c] = __floats2half2_rn((high - low) * inverse, (high + low - 2 * middle[c]) * 2 * inverse * inverse);
    }
    memory.colour[t + o][i] = make_float4(middle[0], middle[1], middle[2], __uint_as_float(bits(slope[0])));
    memory.slopes[t + o][i] = make_uint2(bits(slope[1]), bits(slope[2]));
  }
}

template <bool Harmonics>
__device__ void stage(const LensFrame& frame, const uint32_t* ids, int count, int first, int last,
                      Memory<Harmonics>& memory) {
  constexpr int kParts = Harmonics ? 3 : 4;
  for (int j = threadIdx.x; j < count * kParts; j += kThreads) {
    const int i = j / kParts, k = j % kParts;
    const uint32_t id = ids[i];
    if (k < 3)
      memory.splat[k][i] = reinterpret_cast<const float4*>(frame.splats.splats + id)[k];
    else
      memory.colour[0][i] = by_place(frame.optics, reinterpret_cast<const float4*>(frame.splats.colours)[id]);
  }
  if constexpr (Harmonics) {
    constexpr int kItems = kGroupOrdinals / kShare;
    for (int j = threadIdx.x; j < count * kItems; j += kThreads)
      stage_colours(frame, ids[j / kItems], j / kItems, j % kItems * kShare, first, last, memory);
  }
}

template <bool Harmonics, class Out>
__device__ void draw_tile(const LensFrame& frame, const Lists& lists, unsigned tile, int row_bytes,
                          const float4& background, Out* out, Memory<Harmonics>& memory) {
  const LensOptics& lens = frame.optics;
  const Ordinals& ordinals = lens.ordinals;
  const int tile_x = tile % frame.ordinal.across, tile_y = tile / frame.ordinal.across, width = 3 * lens.width_px;
  const int first_lens = ordinals.first_lens + tile_x * kTileLenses;
  bool shown = false;
  for (int r = threadIdx.x; r < kTileRows; r += kThreads) {
    const int row = tile_y * kTileRows + r;
    const int2 ends = make_int2(lens_start(lens, row, first_lens), lens_start(lens, row, first_lens + kTileLenses));
    memory.rows[r] = ends;
    shown = row < lens.height_px && ends.y > 0 && ends.x < width;
  }
  if (!__syncthreads_or(shown)) return;
  Task<Harmonics> task(frame, memory, tile_x, tile_y);
  uint8_t* bytes = reinterpret_cast<uint8_t*>(&memory + 1);
  auto put = [&](int r, int at, float value) {
    if constexpr (sizeof(Out) == 1) {
      bytes[r * row_bytes + at] = stored(value, out);
    } else {
      const int row = tile_y * kTileRows + r, m = memory.rows[r].x + at;
      if (row >= lens.height_px || m < 0 || m >= width) return;
      out[int64_t(row) * width + in_image(lens, m)] = stored(value, out);
    }
  };

  for (int group = 0; group < ordinals.groups; ++group) {
    const int first = group * ordinals.per_group, last = min(first + ordinals.per_group, ordinals.count) - 1;
#pragma unroll
    for (int t = 0; t < kGroupOrdinals * kHalves; ++t) task.own.state[t][task.lane] = make_float2(0, 1);
    const uint2 range = lists.range(int64_t(tile) * ordinals.groups + group);
    for (unsigned begin = range.x; begin < range.y; begin += kBatch<Harmonics>) {
      const int count = min(unsigned(kBatch<Harmonics>), range.y - begin);
      __syncthreads();
      stage<Harmonics>(frame, lists.ids + begin, count, first, last, memory);
      __syncthreads();
      const int hits = task.cull(count, first, last);
#pragma unroll 1
      for (int ordinal = first; ordinal <= last; ++ordinal) {
        const int n = __shfl_sync(~0u, hits, ordinal - first);
        if (n == 0 || (begin > range.x && task.opaque(ordinal - first))) continue;
        task.draw(ordinal - first, n, ordinal);
      }
    }
    __syncwarp();
    task.finish(first, last, background, put);
  }

  if constexpr (sizeof(Out) == 1) {
    __syncthreads();
    for (int r = threadIdx.x / 32; r < kTileRows; r += kWarps) {
      const int row = tile_y * kTileRows + r, begin = memory.rows[r].x, end = min(memory.rows[r].y, width);
      if (row >= lens.height_px) continue;
      Out* to = out + int64_t(row) * width;
      for (int m = begin + task.lane; m < end; m += 32)
        if (m >= 0) to[in_image(lens, m)] = bytes[r * row_bytes + m - begin];
    }
  }
}
#endif

template <bool Harmonics, class Out>
__global__ void __launch_bounds__(kThreads, 2)
    composite_ordinal_kernel(const __grid_constant__ LensFrame frame, int row_bytes, const float* background,
                             Out* out) {
#if __CUDA_ARCH__ >= 800
  if (frame.state->kernel != int(LensKernel::kOrdinal)) return;
  extern __shared__ __align__(16) char shared[];
  Memory<Harmonics>& memory = *reinterpret_cast<Memory<Harmonics>*>(shared);
  const float4 behind = by_place(frame.optics, make_float4(background[0], background[1], background[2], 0));
  const Lists lists(frame);
  const unsigned tiles = unsigned(frame.ordinal.across * frame.ordinal.down);
  WorkQueue work(frame, LensKernel::kOrdinal);
  for (unsigned tile = blockIdx.x; tile < tiles; tile = memory.next_tile) {
    if (threadIdx.x == 0) work.claim(gridDim.x);
    draw_tile<Harmonics>(frame, lists, tile, row_bytes, behind, out, memory);
    __syncthreads();
    if (threadIdx.x == 0) memory.next_tile = work.claimed;
    __syncthreads();
  }
#endif
}

template <bool Harmonics, class Out>
void launch(const LensFrame& frame, const float* background, Out* out, cudaStream_t stream) {
  const auto kernel = composite_ordinal_kernel<Harmonics, Out>;
  const int row = row_bytes(frame.optics.line_number);
  const size_t bytes = sizeof(Memory<Harmonics>) + kTileRows * row;
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(bytes)),
        "composite_ordinal: shared memory");
  kernel<<<resident_blocks(kernel, kThreads, bytes), kThreads, bytes, stream>>>(frame, row, background, out);
  check_launch("composite_ordinal");
}

}  // namespace

// The shared memory of a tile must fit too: 100 KB leave room on every device of sm_80 and later but for the smallest.
bool can_composite_ordinal(const Lens& lens) {
  int device = 0, major = 0, shared = 0;
  check(cudaGetDevice(&device), "composite_ordinal: device");
  check(cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, device), "composite_ordinal: architecture");
  check(cudaDeviceGetAttribute(&shared, cudaDevAttrMaxSharedMemoryPerBlockOptin, device),
        "composite_ordinal: shared memory");
  const double number = lens.line_number, views_each = double(lens.views) / number;
  const size_t bytes = sizeof(Memory<true>) + kTileRows * row_bytes(float(number));
  return major >= 8 && bytes <= size_t(shared) && number >= kMinLineNumber && number <= kMaxLineNumber &&
         views_each <= kMostViewsEach;
}

void composite_ordinal(const LensFrame& frame, const float* background, float* out, uint8_t* out8, Stream stream) {
  if (!frame.has_ordinal) return;
  auto draw = [&](auto* image) {
    if (frame.splats.orders)
      launch<true>(frame, background, image, cudaStream_t(stream));
    else
      launch<false>(frame, background, image, cudaStream_t(stream));
  };
  out8 ? draw(out8) : draw(out);
}

}  // namespace lfgs::cuda
