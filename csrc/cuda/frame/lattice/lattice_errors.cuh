// How a block of composite_lattice.cu checks a lattice. It finds the errors of interpolation at the middles of its
// cells, and moves nodes to lower them. Twin of LatticeErrors on the CPU. It reads and changes the nodes in shared
// memory.
#pragma once

#include "cuda/frame/lattice/lattice_tile.cuh"

namespace lfgs::cuda {
namespace {

// A point at which a section's lattice is drawn: a node, the middle of a cell, or nothing when the number is beyond
// both. half_plane counts the planes and the offsets half-way between them.
struct Point {
  bool node, middle;
  int i, j, k, half_plane;
  float x, y, s;

  __device__ Point(const Lattice& lattice, int number) {
    node = number < lattice.nodes(), middle = !node && number < lattice.points();
    const int n = node ? number : number - lattice.nodes();
    const int across = node ? lattice.across : lattice.cells(), down = lattice.down - !node;
    const int row = quotient(n, across);
    k = quotient(row, down), j = row - k * down, i = n - row * across;
    half_plane = node || middle ? 2 * k + !node : 0;
    const float half = node ? 0.f : 0.5f;
    if (!node) i += lattice.margin;
    x = fmaf(float(i) + half, lattice.step_x, lattice.x0), y = fmaf(float(j) + half, lattice.step_y, lattice.y0);
    s = fmaf(float(k) + half, lattice.step_s, lattice.s0);
  }
};

// Where in Memory::corners the cell that begins at a node has its place.
__device__ inline int place_index(const Memory& memory, const Lattice& lattice, int section, const Point& node) {
  return memory.first_node[section] + lattice.plane[node.k].first + node.j * lattice.across + node.i;
}

// Store the colour of a node, which is a corner of up to four cells.
__device__ inline void store_node(const Lattice& lattice, const Point& node, float3 colour, int place, Memory& memory) {
  const float values[3] = {colour.x, colour.y, colour.z};
#pragma unroll
  for (int c = 0; c < 3; ++c) {
    const __half value = __float2half_rn(__saturatef(values[c]));
    Corners* corners = memory.corners[c] + place;
    corners[0].low.x = value;
    if (node.i > 0) corners[-1].low.y = value;
    if (node.j > 0) corners[-lattice.across].high.x = value;
    if (node.i > 0 && node.j > 0) corners[-lattice.across - 1].high.y = value;
  }
}

__device__ inline float3 difference(float3 a, float3 b) { return make_float3(a.x - b.x, a.y - b.y, a.z - b.z); }

// The colour that interpolation gives for the middle of a cell.
__device__ inline float3 interpolated(const Lattice& lattice, const Nodes& nodes, const Point& middle) {
  auto channel = [&](int c) {
    return nodes.at(nodes.row_index(c, middle.j), __float2half2_rn(0.5f), float(middle.i) + 0.5f,
                    Seen(lattice, middle.k, 0.5f));
  };
  return make_float3(channel(0), channel(1), channel(2));
}

// The largest of a thread's errors, and the sum of their squares.
struct ErrorSums {
  float largest = 0, squares = 0;

  __device__ void add(float3 e) {
    largest = fmaxf(largest, fmaxf(fabsf(e.x), fmaxf(fabsf(e.y), fabsf(e.z))));
    squares += e.x * e.x + e.y * e.y + e.z * e.z;
  }
  // Combine the `count` errors of all threads of the block, which call this together. Return the largest, or `factor`
  // times the root mean square if that is more.
  __device__ float of_block(Memory& memory, int count, float factor) const {
    const float most = warp_max(largest), sum = warp_sum(squares);
    if (threadIdx.x % 32 == 0) memory.largest[threadIdx.x / 32] = most, memory.squares[threadIdx.x / 32] = sum;
    __syncthreads();
    float all = 0, all_squares = 0;
    for (int w = 0; w < kWarps; ++w) all = fmaxf(all, memory.largest[w]), all_squares += memory.squares[w];
    return fmaxf(all, factor * sqrtf(all_squares * fast_reciprocal(float(count))));
  }
};

// The mean, for each channel, of the errors at the middles round a node; 0 where they have both signs.
__device__ inline float3 errors_round(const Lattice& lattice, const Point& node, const Triple* errors) {
  const int cells = lattice.cells(), rows = lattice.down - 1;
  const __half2 most = __float2half2_rn(60000.f), none = __float2half2_rn(0.f);
  __half2 low[2] = {most, most}, high[2] = {__hneg2(most), __hneg2(most)}, sum[2] = {none, none};
  int count = 0;

  // The least, the largest and the sum, over the cells before and behind the node in the view, in y and in x
#pragma unroll 1
  for (int k = max(node.k - 1, 0); k <= min(node.k, lattice.planes - 2); ++k) {
    // The middles lie half the lean aside of the nodes on either plane: find the ones left and right of the node
    const int lean = int(lattice.plane[k].aside) * (k == node.k ? 1 : -1);
    const int right = node.i - lattice.margin + (lean >> 1), left = right - !(lean & 1);
#pragma unroll 1
    for (int j = max(node.j - 1, 0); j <= min(node.j, rows - 1); ++j, count += 2)
#pragma unroll
      for (int side = 0; side < 2; ++side) {
        const int i = min(max(side ? right : left, 0), cells - 1);
        const Triple error = errors[i + cells * (j + rows * k)];
        const __half2 parts[2] = {error.red_green, error.blue};
#pragma unroll
        for (int p = 0; p < 2; ++p) {
          low[p] = __hmin2(low[p], parts[p]), high[p] = __hmax2(high[p], parts[p]);
          sum[p] = __hadd2(sum[p], parts[p]);
        }
      }
  }

  // Where least and largest have one sign, the mean
  const float each = 1 / float(count);
  auto mean = [&](float low, float high, float sum) { return low > 0 || high < 0 ? sum * each : 0.f; };
  return make_float3(mean(__low2float(low[0]), __low2float(high[0]), __low2float(sum[0])),
                     mean(__high2float(low[0]), __high2float(high[0]), __high2float(sum[0])),
                     mean(__low2float(low[1]), __low2float(high[1]), __low2float(sum[1])));
}

// Call visit(number, error) for those middles that this thread has.
template <class Visit>
__device__ void for_each_error(const Lattice& lattice, int section, const Memory& memory, const Visit& visit) {
  const Nodes nodes(memory, section);
  const int first = lattice.nodes(), points = lattice.points();
#pragma unroll 1
  for (int n = first + int(threadIdx.x); n < points; n += kThreads)
    visit(n - first, difference(interpolated(lattice, nodes, Point(lattice, n)), memory.middles[n - first].floats()));
}

// Move every node by kNodeFactor times the mean error at the middles round it. Return the largest move of this thread's
// nodes. Nodes round which there are errors of both signs, as at an edge, stay where they are. By all threads of the
// block.
__device__ float move_nodes(const Lattice& lattice, int section, Memory& memory) {
  for_each_error(lattice, section, memory, [&](int number, float3 e) { memory.errors[number] = Triple(e); });
  __syncthreads();
  float largest = 0;
#pragma unroll 1
  for (int n = threadIdx.x; n < lattice.nodes(); n += kThreads) {
    const Point node(lattice, n);
    const float3 mean = errors_round(lattice, node, memory.errors);
    const int place = place_index(memory, lattice, section, node);
    auto moved = [&](int c, float error) {
      largest = fmaxf(largest, fabsf(kNodeFactor * error));
      return fmaf(-kNodeFactor, error, __half2float(memory.corners[c][place].low.x));
    };
    store_node(lattice, node, make_float3(moved(0, mean.x), moved(1, mean.y), moved(2, mean.z)), place, memory);
  }
  return largest;
}

}  // namespace
}  // namespace lfgs::cuda
