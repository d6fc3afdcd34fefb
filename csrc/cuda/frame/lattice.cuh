// A lattice as kernels use it. plan_lattices_kernel lays it through one section of a tile, see composite_lattice.cu.
#pragma once

#include "math/lattice_plan.h"

namespace lfgs::cuda {

constexpr int kMostLatticePlanes = 16;
constexpr int kMostNodes = 640;  // of a tile: a tenth of its sub-pixels

// A plane of nodes. What is seen at one of its nodes is seen on the next plane `aside` nodes on. `first` is the index
// of its first node, such that a node and the one `aside` nodes on in the next plane are stride() apart.
struct LatticePlane {
  float aside;
  int first;
};

struct Lattice : LatticeGrid {
  LatticePlane plane[kMostLatticePlanes];

  LFGS_HD int stride() const { return per_plane() + margin; }
  // How many places all nodes take in memory, at most.
  LFGS_HD int places() const { return nodes() + 2 * margin * (planes - 1); }
  // How many points are drawn: the nodes, and the middles of the cells in which samples may lie.
  LFGS_HD int points() const { return nodes() + cells() * (down - 1) * (planes - 1); }
};

}  // namespace lfgs::cuda
