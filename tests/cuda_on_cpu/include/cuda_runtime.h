// CUDA on the CPU: blocks one after the other, a fiber per thread, warps in step where they talk to each other. For the
// logic of kernels, not for their speed; races and memory of the device are not seen.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __shared__ static
#define __grid_constant__
#define __noinline__
#define __launch_bounds__(...)

struct alignas(2) uchar2 {
  unsigned char x, y;
};
struct alignas(8) float2 {
  float x, y;
};
struct float3 {
  float x, y, z;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
struct alignas(8) ushort4 {
  unsigned short x, y, z, w;
};
struct alignas(8) int2 {
  int x, y;
};
struct alignas(8) uint2 {
  unsigned x, y;
};
struct alignas(16) uint4 {
  unsigned x, y, z, w;
};
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float3 make_float3(float x, float y, float z) { return {x, y, z}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline int2 make_int2(int x, int y) { return {x, y}; }
inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
inline uchar2 make_uchar2(unsigned char x, unsigned char y) { return {x, y}; }
inline uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }
struct dim3 {
  unsigned x, y, z;
  dim3(unsigned x_ = 1, unsigned y_ = 1, unsigned z_ = 1) : x(x_), y(y_), z(z_) {}
};

// --- host
using cudaStream_t = void*;
enum cudaError_t { cudaSuccess };
enum cudaFuncAttribute {
  cudaFuncAttributeMaxDynamicSharedMemorySize,
  cudaFuncAttributePreferredSharedMemoryCarveout,
};
enum cudaDeviceAttr {
  cudaDevAttrMultiProcessorCount,
  cudaDevAttrMaxSharedMemoryPerBlockOptin,
  cudaDevAttrMaxSharedMemoryPerMultiprocessor,
};
inline const char* cudaGetErrorString(cudaError_t) { return "no error"; }
inline cudaError_t cudaGetLastError() { return cudaSuccess; }
inline cudaError_t cudaGetDevice(int* device) { return *device = 0, cudaSuccess; }
inline cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr attribute, int) {
  *value = attribute == cudaDevAttrMultiProcessorCount ? 2 : 1 << 18;
  return cudaSuccess;
}
struct cudaFuncAttributes {
  int ptxVersion;
};
template <class Kernel>
cudaError_t cudaFuncGetAttributes(cudaFuncAttributes* attributes, Kernel) {
  return *attributes = {90}, cudaSuccess;
}
template <class Kernel>
cudaError_t cudaOccupancyMaxActiveBlocksPerMultiprocessor(int* blocks, Kernel, int, size_t) {
  return *blocks = 1, cudaSuccess;
}
template <class Kernel>
cudaError_t cudaFuncSetAttribute(Kernel, cudaFuncAttribute, int) {
  return cudaSuccess;
}
inline cudaError_t cudaMemsetAsync(void* to, int value, size_t bytes, cudaStream_t = 0) {
  return memset(to, value, bytes), cudaSuccess;
}

// --- device
namespace emulation {

struct Warp {
  uint64_t given[32], taken[32];
  int arrived = 0, size = 32;
  unsigned round = 0;
};
struct Block {
  int threads, current = 0, arrived = 0;
  bool all = true, any = false, was_all = true, was_any = false;
  unsigned round = 0;
  std::vector<void*> fibers;  // where the stack of each one ends
  std::vector<char> done;
  std::vector<Warp> warps;
  void* main;
};
inline Block* block;
inline dim3 block_index, block_size, grid_size;
inline std::function<void()>* body;
alignas(128) inline char dynamic_shared[1 << 18];
constexpr size_t kStackBytes = 1 << 17;

inline dim3 thread_index() {
  const unsigned t = block->current;
  return {t % block_size.x, t / block_size.x % block_size.y, t / (block_size.x * block_size.y)};
}
inline int lane() { return block->current % 32; }

// Continue on another stack: push the registers that a call preserves (System V, x86-64) on this one, and pop them from
// the other. swapcontext does the same, but asks the system for the signal mask each time. That took most of the time
// of the kernels with tensor cores.
__attribute__((naked, noinline)) inline void switch_stack(void** from, void* to) {
  asm("push %rbp\n push %rbx\n push %r12\n push %r13\n push %r14\n push %r15\n"
      "mov %rsp, (%rdi)\n mov %rsi, %rsp\n"
      "pop %r15\n pop %r14\n pop %r13\n pop %r12\n pop %rbx\n pop %rbp\n ret");
}
// A stack on which switch_stack finds six registers, and `begin` to return to, aligned as if it had been called.
inline void* new_stack(char* memory, size_t bytes, void (*begin)()) {
  void** top = reinterpret_cast<void**>((size_t(memory) + bytes) / 16 * 16);
  top[-1] = nullptr, top[-2] = reinterpret_cast<void*>(begin);
  return std::fill_n(top - 8, 6, nullptr), top - 8;
}

inline void yield() { switch_stack(&block->fibers[block->current], block->main); }
inline void enter() {
  (*body)();
  block->done[block->current] = true;
  yield();
}

// Waits for the warp; the values that its lanes gave.
inline const uint64_t* exchange(uint64_t value) {
  Warp& warp = block->warps[block->current / 32];
  const unsigned round = warp.round;
  warp.given[lane()] = value;
  if (++warp.arrived == warp.size) {
    memcpy(warp.taken, warp.given, sizeof warp.given);
    warp.arrived = 0, ++warp.round;
  } else {
    while (warp.round == round) yield();
  }
  return warp.taken;
}
inline void gather(unsigned value, unsigned (&values)[32]) {
  const uint64_t* all = exchange(value);
  for (int i = 0; i < 32; ++i) values[i] = unsigned(all[i]);
}
inline void barrier(bool value) {
  Block& b = *block;
  const unsigned round = b.round;
  b.all &= value, b.any |= value;
  if (++b.arrived == b.threads) {
    b.was_all = b.all, b.was_any = b.any, b.all = true, b.any = false, b.arrived = 0, ++b.round;
  } else {
    while (b.round == round) yield();
  }
}

inline void run_block(int threads) {
  static std::vector<std::vector<char>> stacks;
  while (int(stacks.size()) < threads) stacks.emplace_back(kStackBytes);
  Block b{threads};
  block = &b;
  b.fibers.resize(threads), b.done.assign(threads, false), b.warps.resize((threads + 31) / 32);
  if (threads % 32) b.warps.back().size = threads % 32;
  for (int t = 0; t < threads; ++t) b.fibers[t] = new_stack(stacks[t].data(), kStackBytes, enter);
  for (int left = threads, waits = 0; left > 0;) {
    const int before = left;
    for (int t = 0; t < threads; ++t) {
      if (b.done[t]) continue;
      b.current = t;
      switch_stack(&b.main, b.fibers[t]);
      left -= b.done[t];
    }
    waits = left == before ? waits + 1 : 0;
    if (waits > 10'000'000) fprintf(stderr, "a kernel's threads wait for each other for ever\n"), abort();
  }
}

// What stands behind the shared memory that a launch asked for, to see that no block writes there.
constexpr size_t kGuardBytes = 256;
constexpr char kGuard = 0x5a;
inline void set_guard(size_t bytes) {
  if (bytes + kGuardBytes > sizeof dynamic_shared) fprintf(stderr, "too much shared memory\n"), abort();
  memset(dynamic_shared + bytes, kGuard, kGuardBytes);
}
inline void check_guard(size_t bytes) {
  for (size_t i = bytes; i < bytes + kGuardBytes; ++i)
    if (dynamic_shared[i] != kGuard) fprintf(stderr, "a block writes behind its shared memory\n"), abort();
}

template <class Kernel>
struct Launch {
  Kernel kernel;
  dim3 grid, threads;
  size_t shared_bytes;
  template <class... A>
  void operator()(const A&... arguments) const {
    std::function<void()> run = [&] { kernel(arguments...); };
    body = &run, grid_size = grid, block_size = threads;
    set_guard(shared_bytes);
    for (unsigned z = 0; z < grid.z; ++z)
      for (unsigned y = 0; y < grid.y; ++y)
        for (unsigned x = 0; x < grid.x; ++x) {
          block_index = {x, y, z};
          run_block(int(threads.x * threads.y * threads.z));
        }
    check_guard(shared_bytes);
  }
};
template <class Kernel>
Launch<Kernel> launch(Kernel kernel, dim3 grid, dim3 threads, size_t shared_bytes = 0, cudaStream_t = 0) {
  return {kernel, grid, threads, shared_bytes};
}

template <class T>
T of_lane(T value, int source) {
  uint64_t bits = 0;
  memcpy(&bits, &value, sizeof value);
  bits = exchange(bits)[source];
  memcpy(&value, &bits, sizeof value);
  return value;
}

}  // namespace emulation

#define threadIdx (emulation::thread_index())
#define blockIdx (emulation::block_index)
#define blockDim (emulation::block_size)
#define gridDim (emulation::grid_size)
inline void __threadfence() {}
inline void __syncthreads() { emulation::barrier(false); }
inline int __syncthreads_and(int v) { return emulation::barrier(v), emulation::block->was_all; }
inline int __syncthreads_or(int v) { return emulation::barrier(v), emulation::block->was_any; }
inline void __syncwarp(unsigned = ~0u) { emulation::exchange(0); }
inline unsigned __ballot_sync(unsigned, int v) {
  const uint64_t* all = emulation::exchange(v != 0);
  unsigned bits = 0;
  for (int i = 0; i < emulation::block->warps[emulation::block->current / 32].size; ++i) bits |= unsigned(all[i]) << i;
  return bits;
}
inline int __any_sync(unsigned mask, int v) { return __ballot_sync(mask, v) != 0; }
inline int __all_sync(unsigned mask, int v) { return __ballot_sync(mask, !v) == 0; }
// Of lanes that have gone different ways, each goes on by itself.
inline unsigned __activemask() { return 1u << emulation::lane(); }
// The lanes that gave the same value.
template <class T>
unsigned __match_any_sync(unsigned mask, T v) {
  if (mask == 1u << emulation::lane()) return mask;
  const uint64_t* all = emulation::exchange(v);
  unsigned same = 0;
  for (int i = 0; i < emulation::block->warps[emulation::block->current / 32].size; ++i)
    same |= unsigned(all[i] == v) << i;
  return same;
}
template <class T>
T __shfl_sync(unsigned mask, T v, int source) {
  return mask == 1u << emulation::lane() ? v : emulation::of_lane(v, source & 31);
}
template <class T>
T __shfl_xor_sync(unsigned, T v, int mask) {
  return emulation::of_lane(v, emulation::lane() ^ mask);
}
template <class T>
T __shfl_up_sync(unsigned, T v, int by, int width = 32) {
  return emulation::of_lane(v, emulation::lane() % width >= by ? emulation::lane() - by : emulation::lane());
}
template <class T>
T __shfl_down_sync(unsigned, T v, int by) {
  return emulation::of_lane(v, std::min(emulation::lane() + by, 31));
}

inline int __ffs(int v) { return __builtin_ffs(v); }
inline int __popc(unsigned v) { return __builtin_popcount(v); }
inline unsigned __brev(unsigned v) {
  unsigned out = 0;
  for (int i = 0; i < 32; ++i) out |= (v >> i & 1) << (31 - i);
  return out;
}
inline int __clz(int v) { return std::countl_zero(unsigned(v)); }
inline unsigned __umulhi(unsigned a, unsigned b) { return unsigned(uint64_t(a) * b >> 32); }
inline unsigned __byte_perm(unsigned a, unsigned b, unsigned selector) {
  const uint64_t bytes = uint64_t(b) << 32 | a;
  unsigned out = 0;
  for (int i = 0; i < 4; ++i) out |= unsigned(bytes >> 8 * (selector >> 4 * i & 7) & 255) << 8 * i;
  return out;
}
inline size_t __cvta_generic_to_shared(const void* p) { return size_t((const char*)p - emulation::dynamic_shared); }
inline float __fdividef(float a, float b) { return a / b; }
inline float __fmul_rn(float a, float b) { return a * b; }
inline float __fadd_rn(float a, float b) { return a + b; }
inline float __saturatef(float x) { return fminf(fmaxf(x, 0.f), 1.f); }
inline float rsqrtf(float x) { return 1 / sqrtf(x); }
inline unsigned __float2uint_rn(float f) { return unsigned(nearbyintf(f)); }
inline unsigned __float_as_uint(float f) { return std::bit_cast<unsigned>(f); }
inline float __uint_as_float(unsigned u) { return std::bit_cast<float>(u); }
template <class T>
T __ldg(const T* p) {
  return *p;
}
template <class T, class U>
T atomicAdd(T* p, U v) {
  T old = *p;
  return *p += v, old;
}
template <class T, class U>
T atomicOr(T* p, U v) {
  T old = *p;
  return *p |= v, old;
}
template <class T, class U>
T atomicMax(T* p, U v) {
  T old = *p;
  return *p = std::max(old, T(v)), old;
}
using std::max;
using std::min;
