// Where a lattice is laid through a section of a tile, by a warp: math/lattice_plan.h with a splat, a bin or a plane a
// lane.
#pragma once

#include <new>

#include "cuda/frame/composite_frame.cuh"
#include "cuda/frame/lattice.cuh"
#include "cuda/frame/lens_plan.cuh"

namespace lfgs::cuda {

// The list of a section.
struct List {
  const Splats<float>& splats;
  const uint32_t* ids;
  unsigned count;
  float2 origin;

  __device__ Splat<float> splat(unsigned i) const { return splat_about(splats, ids[i], origin); }
  // Of a splat at the offset s, no channel below zero; w: 1 / S.
  __device__ float4 shape(uint32_t id, float s) const {
    const float4 S = reinterpret_cast<const float4*>(splats.splats + id)[1];
    const float4* powers = reinterpret_cast<const float4*>(splats.colours) + int64_t(id) * (splats.colour_order + 1);
    const int order = splats.orders ? splats.orders[id] : 0;
    float4 c = powers[order];
    for (int p = order - 1; p >= 0; --p) {
      const float4 power = powers[p];
      c.x = fmaf(c.x, s, power.x), c.y = fmaf(c.y, s, power.y), c.z = fmaf(c.z, s, power.z);
    }
    return make_float4(fmaxf(c.x, 0.f), fmaxf(c.y, 0.f), fmaxf(c.z, 0.f),
                       fast_reciprocal(fmaf(s, fmaf(s, S.z, S.y), S.x)));
  }
};

// How fast the light field of a section varies, and a lattice for it. In shared memory, by all lanes of a warp.
class LatticePlanner {
 public:
  // Measures a part, by some splats of its list.
  __device__ void measure(const List& list, const LatticePart& part) {
    constexpr int kMeasured = 256;  // about; enough for averages
    constexpr int kShare = 32 / LatticeCurvature::kBins;
    const int lane = threadIdx.x % 32, bin = lane / kShare;
    LatticeCurvature& curvature = *reinterpret_cast<LatticeCurvature*>(curvature_);
    if (lane == 0) new (&curvature) LatticeCurvature(part);
    __syncwarp();
    const unsigned stride = list.count / kMeasured + 1, measured = list.count / stride;
    LatticeCurvature::Sums sums;
#pragma unroll 1
    for (unsigned begin = 0; begin < measured; begin += 32) {
      if (begin + lane < measured) {
        const Splat<float> splat = list.splat((begin + lane) * stride);
        terms_[lane] = curvature.term(splat, splat.u0);
      }
      __syncwarp();
#pragma unroll 2
      for (unsigned t = lane % kShare; t < min(32u, measured - begin); t += kShare) {
        const LatticeCurvature::Term& term = terms_[t];
        if (term.first <= bin && bin <= term.last) sums.add(term);
      }
      __syncwarp();
    }
    for (int step = kShare / 2; step > 0; step /= 2)
      for (float* sum : {&sums.weight, &sums.x, &sums.y, &sums.x_du, &sums.x_du2})
        *sum += __shfl_xor_sync(~0u, *sum, step);
    if (lane % kShare == 0) curvature.set(bin, sums);
    __syncwarp();
  }

  // Lays a lattice of such a fineness. False where it would take too many nodes to pay.
  __device__ bool lay(float fineness, Lattice& lattice) const {
    constexpr float kReach = 2.3f;  // of splats, in units of a plan's
    const LatticeCurvature& curvature = *reinterpret_cast<const LatticeCurvature*>(curvature_);
    const int lane = threadIdx.x % 32;
    LatticeCurvature::Totals totals;
    if (lane < LatticeCurvature::kBins) totals.add(curvature.bin(lane));
    for (float* total : {&totals.weight, &totals.x, &totals.y, &totals.spread}) *total = warp_sum(*total);
    if (lane == 0) curvature.lay(totals, fineness, kMostLatticePlanes + 1, lattice);
    __syncwarp();
    const float lean = curvature.lean_of(lane, lattice), margin = warp_max(fabsf(lean));
    if (lane == 0) curvature.widen(margin, lattice);
    __syncwarp();
    if (lattice.planes > kMostLatticePlanes || lattice.across > kMostNodes || lattice.down > kMostNodes) return false;
    int first = 0;
    for (int k = 0; k < lattice.planes - 1; ++k) {
      const int on = lattice.stride() - int(__shfl_sync(~0u, lean, k));
      first += k < lane ? on : 0;
    }
    if (lane < lattice.planes) lattice.plane[lane] = {lean, first};
    __syncwarp();
    const float reach = 2 * kReach / fineness;
    return float(lattice.points()) <= points_worth(reach * lattice.step_x, reach * lattice.step_y);
  }

 private:
  LatticeCurvature::Term terms_[32];
  alignas(8) char curvature_[sizeof(LatticeCurvature)];
};

}  // namespace lfgs::cuda
