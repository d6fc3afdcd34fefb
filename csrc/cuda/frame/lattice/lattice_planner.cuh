// How a warp lays a lattice through a section of a tile. The arithmetic is in math/lattice_plan.h, with the
// splats, then the bins, then the planes shared out among the lanes.
#pragma once

#include <new>

#include "cuda/frame/composite_frame.cuh"
#include "cuda/frame/direct_frame.h"
#include "cuda/frame/kernel_cost.cuh"
#include "math/colour_circle.h"

namespace lfgs::cuda {

// The list of splats of a section, and the point from which x and y are counted.
struct List {
  const Splats<float>& splats;
  const uint32_t* ids;
  unsigned count;
  float2 origin;

  __device__ Splat<float> splat(unsigned i) const { return splat_about(splats, ids[i], origin); }
  // The colour of a splat seen from the offset s, no channel below zero, and in w its 1 / S there.
  __device__ float4 shape(uint32_t id, float s) const {
    const float4 S = reinterpret_cast<const float4*>(splats.splats + id)[1];
    const float4* powers = reinterpret_cast<const float4*>(splats.colours) + int64_t(id) * (splats.colour_order + 1);
    const int order = splats.orders ? splats.orders[id] : 0;
    float4 c = powers[max(order, 0)];
    if (order == kCircleOrder) {
      const CirclePoint<float> point(powers[kPlaceTerm].w, powers[kDistanceTerm].w, s);
      c.x = point.colour([&](int m) { return powers[m].x; }), c.y = point.colour([&](int m) { return powers[m].y; });
      c.z = point.colour([&](int m) { return powers[m].z; });
    }
    for (int p = order - 1; p >= 0; --p) {
      const float4 power = powers[p];
      c.x = fmaf(c.x, s, power.x), c.y = fmaf(c.y, s, power.y), c.z = fmaf(c.z, s, power.z);
    }
    return make_float4(fmaxf(c.x, 0.f), fmaxf(c.y, 0.f), fmaxf(c.z, 0.f),
                       fast_reciprocal(fmaf(s, fmaf(s, S.z, S.y), S.x)));
  }
};

// Measure how fast the light field of a section varies, and lay a lattice for it. It lives in shared memory; all
// lanes of a warp call its functions together.
class LatticePlanner {
 public:
  // Measure a part of the panel by some splats of its list. A lane computes the terms of one splat. Then two lanes sum
  // the terms of one bin, each over every other splat.
  __device__ void measure(const List& list, const LatticePart& part) {
    constexpr int kMeasured = 256;  // about; enough for averages
    constexpr int kLanesPerBin = 32 / LatticeCurvature::kBins;
    const int lane = threadIdx.x % 32, bin = lane / kLanesPerBin;
    LatticeCurvature& curvature = *reinterpret_cast<LatticeCurvature*>(curvature_);
    if (lane == 0) new (&curvature) LatticeCurvature(part);
    __syncwarp();

    // Every `stride`-th splat, 32 at a time
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
      for (unsigned t = lane % kLanesPerBin; t < min(32u, measured - begin); t += kLanesPerBin) {
        const LatticeCurvature::Term& term = terms_[t];
        if (term.first <= bin && bin <= term.last) sums.add(term);
      }
      __syncwarp();
    }

    // Join the sums of the lanes that have the same bin
    for (int step = kLanesPerBin / 2; step > 0; step /= 2)
      for (float* sum : {&sums.weight, &sums.x, &sums.y, &sums.x_du, &sums.x_du2})
        *sum += __shfl_xor_sync(~0u, *sum, step);
    if (lane % kLanesPerBin == 0) curvature.set(bin, sums);
    __syncwarp();
  }

  // Lay a lattice of the given fineness. False where it would take too many nodes to pay.
  __device__ bool lay(float fineness, Lattice& lattice) const {
    constexpr float kReach = 2.3f;  // how far splats reach, in the standard deviations in which a plan counts
    const LatticeCurvature& curvature = *reinterpret_cast<const LatticeCurvature*>(curvature_);
    const int lane = threadIdx.x % 32;

    // Steps, rows and planes, from the sum over all bins
    LatticeCurvature::Totals totals;
    if (lane < LatticeCurvature::kBins) totals.add(curvature.bin(lane));
    for (float* total : {&totals.weight, &totals.x, &totals.y, &totals.spread}) *total = warp_sum(*total);
    if (lane == 0) curvature.lay(totals, fineness, kMostLatticePlanes + 1, lattice);
    __syncwarp();

    // How far each plane leans, a plane a lane, and the columns that this takes
    const float lean = curvature.plane_lean(lane, lattice), margin = warp_max(fabsf(lean));
    if (lane == 0) curvature.widen(margin, lattice);
    __syncwarp();
    if (lattice.planes > kMostLatticePlanes || lattice.across > kMostNodes || lattice.down > kMostNodes) return false;

    // Where each plane's nodes are stored, see LatticePlane
    int first = 0;
    for (int k = 0; k < lattice.planes - 1; ++k) {
      const int on = lattice.stride() - int(__shfl_sync(~0u, lean, k));
      first += k < lane ? on : 0;
    }
    if (lane < lattice.planes) lattice.plane[lane] = {lean, first};
    __syncwarp();

    // Whether it pays with splats of the size that the steps tell
    const float reach = 2 * kReach / fineness;
    return float(lattice.points()) <= points_worth(reach * lattice.step_x, reach * lattice.step_y);
  }

 private:
  LatticeCurvature::Term terms_[32];
  alignas(8) char curvature_[sizeof(LatticeCurvature)];
};

}  // namespace lfgs::cuda
