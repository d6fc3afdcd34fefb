// A lattice as kernels use it: laid through one section of a tile by plan_lattices, see composite_lattice.cu.
#pragma once

#include "math/lattice_plan.h"

namespace lfgs::cuda {

constexpr int kMostLatticePlanes = 16;
constexpr int kMostNodes = 640;  // of a tile: a tenth of its sub-pixels

// A plane of nodes: what is seen at one of them is seen on the next plane `aside` nodes on; where its first is stored.
// These two are stride() places apart for every plane.
struct LatticePlane {
  float aside;
  int first;
};

struct Lattice : LatticeGrid {
  LatticePlane plane[kMostLatticePlanes];

  LFGS_HD int stride() const { return per_plane() + margin; }
  // Places of all nodes, at most.
  LFGS_HD int places() const { return nodes() + 2 * margin * (planes - 1); }
  // Nodes, and middles of the cells in which samples may lie.
  LFGS_HD int points() const { return nodes() + cells() * (down - 1) * (planes - 1); }
};

}  // namespace lfgs::cuda
