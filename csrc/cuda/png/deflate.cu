// Deflate an image (png.h): count each symbol of the stream, make the codes, find the start of each piece of a row, and
// write. The three passes over the image each filter it anew, which costs less than keeping it.
//
// A block has a piece of a row, and each of its threads a segment of that. Runs end with the segment, so that threads
// need nothing of each other but how many bits the others write.
#include "cuda/common/launch.h"
#include "cuda/png/huffman.cuh"
#include "cuda/png/png.h"

namespace lfgs::cuda {
namespace {

constexpr int kThreads = 96, kWarps = kThreads / 32;
constexpr int kSegment = 128, kPiece = kThreads * kSegment;  // bytes; two pieces are a row of 7680 pixels, nearly full
constexpr int kStride = kSegment + 4;                        // so that threads meet different banks of shared memory
constexpr int kShortestRun = 3;                              // RFC 1951, 3.2.5
constexpr uint8_t kUp = 2;                                   // the filter's number
constexpr int kCodeThreads = 288, kScanThreads = 1024;
constexpr unsigned kAdlerModulus = 65521;
static_assert(kCodeThreads >= kDeflateSymbols && kSegment < 258);

int64_t pieces_of_row(int64_t row_bytes) { return blocks_for(row_bytes, kPiece); }

// Writes bits of a thread into the stream that all threads share, the lowest first. The stream is zero before. The
// first and the last word of a thread also hold bits of its neighbours.
class BitWriter {
 public:
  __device__ BitWriter(uint32_t* stream, unsigned long long bit) : word_(stream + bit / 32), filled_(int(bit % 32)) {}

  // count: at most 32.
  __device__ void put(uint32_t bits, int count) {
    waiting_ |= uint64_t(bits) << filled_, filled_ += count;
    if (filled_ < 32) return;
    if (shared_)
      atomicOr(word_++, uint32_t(waiting_));
    else
      *word_++ = uint32_t(waiting_);
    shared_ = false, waiting_ >>= 32, filled_ -= 32;
  }
  __device__ void finish() {
    if (waiting_ != 0) atomicOr(word_, uint32_t(waiting_));
  }

 private:
  uint32_t* word_;
  uint64_t waiting_ = 0;
  int filled_;
  bool shared_ = true;
};

// A length as deflate has it: a symbol, and bits behind it.
struct Length {
  int symbol, extra_bits;
  unsigned extra;

  __device__ explicit Length(int bytes) {
    const int above = bytes - kShortestRun;
    extra_bits = above < 8 ? 0 : 29 - __clz(above);
    symbol = kEndOfBlock + 1 + 4 * extra_bits + (above >> extra_bits);
    extra = above & ((1u << extra_bits) - 1);
  }
};

// The block's piece of a row, filtered, in shared memory, and the thread's segment of it.
class Segment {
 public:
  // Call see(byte, column, n) for the n-th byte that this thread brings, kThreads apart from the one before.
  template <class See>
  __device__ Segment(const PngImage& image, unsigned pieces, uint8_t (&shared)[kThreads * kStride], See&& see)
      : row(blockIdx.x / pieces), first(int64_t(blockIdx.x % pieces) * kPiece) {
    const uint8_t* pixels = image.pixels + row * image.row_bytes;
    auto filtered = [&](int64_t at) { return uint8_t(pixels[at] - (row > 0 ? pixels[at - image.row_bytes] : 0)); };
    const int size = int(min(int64_t(kPiece), image.row_bytes - first)), begin = int(threadIdx.x) * kSegment;
    for (int k = threadIdx.x, n = 0; k < size; k += kThreads, ++n) {
      const uint8_t byte = filtered(first + k);
      see(byte, first + k, n);
      shared[k / kSegment * kStride + k % kSegment] = byte;
    }
    __syncthreads();
    count = max(0, min(kSegment, size - begin));
    bytes = shared + threadIdx.x * kStride;
    starts_row = first + begin == 0;
    if (threadIdx.x > 0)
      before = bytes[kSegment - 1 - kStride];
    else
      before = starts_row ? kUp : filtered(first - 1);
  }

  // Call literal(byte) and run(bytes) for the segment, in order: the filter where the row begins, and repetitions of
  // the byte before.
  template <class Literal, class Run>
  __device__ void symbols(Literal&& literal, Run&& run) const {
    if (starts_row) literal(kUp);
    uint8_t last = before;
    for (int at = 0; at < count;) {
      int end = at;
      while (end < count && bytes[end] == last) ++end;
      if (end - at >= kShortestRun) {
        run(end - at), at = end;
      } else {
        last = bytes[at++];
        literal(last);
      }
    }
  }

  int64_t row, first;  // the first byte of the piece in its row
  const uint8_t* bytes;
  int count;
  bool starts_row;
  uint8_t before;  // the byte before it in the stream
};

__device__ unsigned long long sum_of_warp(unsigned long long value) {
  for (int step = 16; step > 0; step /= 2) value += __shfl_xor_sync(~0u, value, step);
  return value;
}

// Facts about the bytes of a thread: their sum, the sum of each times its number, and whether the image has more than
// one colour.
struct Seen {
  unsigned sum = 0, numbered = 0;
  bool varied = false;
};

// Add to the sums of Adler-32: of all bytes, and of each times how many there are from it to the end.
__device__ void add_to_sums(const PngImage& image, const Segment& segment, const Seen& seen) {
  const unsigned long long size = (unsigned long long)(image.height) * (image.row_bytes + 1);
  const unsigned long long to_end = size - segment.row * (image.row_bytes + 1) - 1 - (segment.first + threadIdx.x);
  unsigned long long sums[2] = {seen.sum, seen.sum * to_end - seen.numbered * (unsigned long long)(kThreads)};
  if (segment.starts_row) sums[0] += kUp, sums[1] += kUp * (to_end + 1);
  for (int k = 0; k < 2; ++k) {
    const unsigned long long sum = sum_of_warp(sums[k] % kAdlerModulus);
    if (threadIdx.x % 32 == 0) atomicAdd(&image.state->sums[k], sum);
  }
}

__global__ void __launch_bounds__(kThreads) count_kernel(const __grid_constant__ PngImage image, unsigned pieces) {
  __shared__ uint8_t shared[kThreads * kStride];
  __shared__ uint32_t counts[kDeflateSymbols];
  for (int k = threadIdx.x; k < kDeflateSymbols; k += kThreads) counts[k] = 0;
  Seen seen;
  const bool is_first_row = blockIdx.x < pieces;
  const Segment segment(image, pieces, shared, [&](uint8_t byte, int64_t column, int number) {
    seen.sum += byte, seen.numbered += byte * number;
    seen.varied |=
        byte != (is_first_row ? image.pixels[column % image.channels] : 0);  // below it, one colour has zeros
  });
  segment.symbols([&](uint8_t byte) { atomicAdd(&counts[byte], 1u); },
                  [&](int bytes) { atomicAdd(&counts[Length(bytes).symbol], 1u); });
  add_to_sums(image, segment, seen);
  if (__syncthreads_or(seen.varied) && threadIdx.x == 0) image.state->facts.varied = 1;
  for (int k = threadIdx.x; k < kDeflateSymbols; k += kThreads)
    if (counts[k] > 0) atomicAdd(&image.state->counts[k], counts[k]);
}

// The header of the block: all codes' lengths with four bits each, and one for distances, the one that means 1.
constexpr int kLengthSymbols = 19;
constexpr int kHeaderBits = 3 + 14 + 3 * kLengthSymbols + 4 * (kDeflateSymbols + 1);

__device__ void write_header(const CodeTable& table, uint32_t* stream) {
  BitWriter writer(stream, 0);
  writer.put(1 | 2 << 1, 3);  // the last block; dynamic codes
  writer.put((kDeflateSymbols - 257) | (kLengthSymbols - 4) << 10, 14);
  for (int k = 0; k < kLengthSymbols; ++k) writer.put(k < 3 ? 0 : 4, 3);  // the first three mean repetitions
  for (int k = 0; k < kDeflateSymbols; ++k) writer.put(__brev(table.lengths[k]) >> 28, 4);
  writer.put(__brev(1) >> 28, 4);
  writer.finish();
}

// One block.
__global__ void __launch_bounds__(kCodeThreads) codes_kernel(const __grid_constant__ PngImage image) {
  __shared__ CodeTable table;
  DeflateState& state = *image.state;
  if (threadIdx.x < kDeflateSymbols)
    table.counts[threadIdx.x] = threadIdx.x == kEndOfBlock ? 1 : state.counts[threadIdx.x];
  __syncthreads();
  make_codes(table, state.codes);
  if (threadIdx.x == 0) {
    write_header(table, image.stream);
    const unsigned long long size = (unsigned long long)(image.height) * (image.row_bytes + 1);
    const unsigned low = unsigned((1 + state.sums[0]) % kAdlerModulus);
    state.facts.adler = unsigned((size + state.sums[1]) % kAdlerModulus) << 16 | low;
  }
}

// The codes of the image in shared memory.
__device__ void load_codes(const PngImage& image, uint32_t (&codes)[kDeflateSymbols]) {
  for (int k = threadIdx.x; k < kDeflateSymbols; k += kThreads) codes[k] = image.state->codes[k];
}

// How many bits the thread's segment takes. A run has one bit for its distance.
__device__ unsigned bit_count(const Segment& segment, const uint32_t (&codes)[kDeflateSymbols]) {
  unsigned bits = 0;
  segment.symbols([&](uint8_t byte) { bits += codes[byte] >> 16; },
                  [&](int bytes) {
                    const Length length(bytes);
                    bits += (codes[length.symbol] >> 16) + length.extra_bits + 1;
                  });
  return bits;
}

// The sum of the values of the threads before this one. sums: one for each warp.
template <class T>
__device__ T sum_before(T value, T* sums) {
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  T up_to = value;
  for (int step = 1; step < 32; step *= 2) {
    const T other = __shfl_up_sync(~0u, up_to, step);
    if (lane >= step) up_to += other;
  }
  if (lane == 31) sums[warp] = up_to;
  __syncthreads();
  for (int k = 0; k < warp; ++k) up_to += sums[k];
  return up_to - value;
}

__global__ void __launch_bounds__(kThreads) measure_kernel(const __grid_constant__ PngImage image, unsigned pieces) {
  __shared__ uint8_t shared[kThreads * kStride];
  __shared__ uint32_t codes[kDeflateSymbols];
  __shared__ unsigned sums[kWarps];
  load_codes(image, codes);
  const Segment segment(image, pieces, shared, [](uint8_t, int64_t, int) {});
  const unsigned bits = bit_count(segment, codes), before = sum_before(bits, sums);
  image.starts[int64_t(blockIdx.x) * kThreads + threadIdx.x] = before;
  if (threadIdx.x == kThreads - 1) image.offsets[blockIdx.x] = before + bits;
}

// One block: how many bits the pieces take becomes where they begin.
__global__ void __launch_bounds__(kScanThreads) place_kernel(const __grid_constant__ PngImage image, int64_t pieces) {
  __shared__ unsigned long long sums[kScanThreads / 32], next;
  if (threadIdx.x == 0) next = kHeaderBits;
  for (int64_t first = 0; first < pieces; first += kScanThreads) {
    const int64_t piece = first + threadIdx.x;
    const unsigned long long bits = piece < pieces ? image.offsets[piece] : 0;
    const unsigned long long before = sum_before(bits, sums) + next;
    if (piece < pieces) image.offsets[piece] = before;
    __syncthreads();
    if (threadIdx.x == kScanThreads - 1) next = before + bits;
    __syncthreads();
  }
  if (threadIdx.x == 0) {
    const uint32_t end = image.state->codes[kEndOfBlock];
    BitWriter writer(image.stream, next);
    writer.put(end & 0xffff, int(end >> 16));
    writer.finish();
    image.state->facts.bits = next + (end >> 16);
  }
}

__global__ void __launch_bounds__(kThreads) write_kernel(const __grid_constant__ PngImage image, unsigned pieces) {
  __shared__ uint8_t shared[kThreads * kStride];
  __shared__ uint32_t codes[kDeflateSymbols];
  load_codes(image, codes);
  const Segment segment(image, pieces, shared, [](uint8_t, int64_t, int) {});
  BitWriter writer(image.stream,
                   image.offsets[blockIdx.x] + image.starts[int64_t(blockIdx.x) * kThreads + threadIdx.x]);
  segment.symbols([&](uint8_t byte) { writer.put(codes[byte] & 0xffff, int(codes[byte] >> 16)); },
                  [&](int bytes) {
                    const Length length(bytes);
                    const uint32_t code = codes[length.symbol];
                    const int bits = int(code >> 16);
                    writer.put((code & 0xffff) | length.extra << bits, bits + length.extra_bits + 1);
                  });
  writer.finish();
}

constexpr int64_t kStateBytes = (sizeof(DeflateState) + 15) / 16 * 16;

}  // namespace

int64_t PngImage::pieces() const { return height * pieces_of_row(row_bytes); }
int64_t PngImage::work_bytes() const {
  return kStateBytes + pieces() * int64_t(sizeof(*offsets) + kThreads * sizeof(*starts));
}
void PngImage::place(void* work, void* out) {
  state = static_cast<DeflateState*>(work);
  offsets = reinterpret_cast<unsigned long long*>(static_cast<uint8_t*>(work) + kStateBytes);
  starts = reinterpret_cast<uint32_t*>(offsets + pieces());
  stream = static_cast<uint32_t*>(out);
}

void deflate(const PngImage& image, Stream stream) {
  const auto cuda_stream = cudaStream_t(stream);
  const unsigned across = unsigned(pieces_of_row(image.row_bytes)), blocks = unsigned(image.pieces());
  check(cudaMemsetAsync(image.state, 0, kStateBytes, cuda_stream), "deflate: clear");
  check(cudaMemsetAsync(image.stream, 0, size_t(image.stream_bytes()), cuda_stream), "deflate: clear");
  count_kernel<<<blocks, kThreads, 0, cuda_stream>>>(image, across);
  check_launch("deflate: count");
  codes_kernel<<<1, kCodeThreads, 0, cuda_stream>>>(image);
  check_launch("deflate: codes");
  measure_kernel<<<blocks, kThreads, 0, cuda_stream>>>(image, across);
  check_launch("deflate: measure");
  place_kernel<<<1, kScanThreads, 0, cuda_stream>>>(image, image.pieces());
  check_launch("deflate: place");
  write_kernel<<<blocks, kThreads, 0, cuda_stream>>>(image, across);
  check_launch("deflate: write");
}

}  // namespace lfgs::cuda
