// The compressed part of a PNG file, made on a CUDA device. Rows are filtered by "Up" and deflated as one block of
// dynamic Huffman codes. Its only repetitions are runs of one byte. Neighbours in a row of a panel's image show
// different views, so that there are few repetitions but runs (lightfield_gs/io/images.py). Nothing allocates or waits.
//
// Sources: Portable Network Graphics (PNG) Specification (Third Edition), W3C, 2025, section 9.2; RFC 1951, section
// 3.2; RFC 1950, section 9 (Adler-32).
#pragma once

#include <cstdint>

#include "cuda/stages/stages.h"

namespace lfgs::cuda {

constexpr int kDeflateSymbols = 286;  // bytes, the end of the block and lengths of repetitions (RFC 1951, 3.2.5)

// Facts of a compressed image; the host reads them to know where the stream ends.
struct DeflateFacts {
  unsigned long long bits;  // of the stream
  uint32_t adler;           // Adler-32 of the filtered rows
  uint32_t varied;          // whether the image has more than one colour
};

struct DeflateState {
  DeflateFacts facts;
  unsigned long long sums[2];        // Adler-32's, before their remainders are taken
  uint32_t counts[kDeflateSymbols];  // how often each symbol stands in the stream
  uint32_t codes[kDeflateSymbols];   // its code, the first bit lowest, and above 16 bits the code's length
};

// An image of 8 bits and the memory that it takes to compress it.
struct PngImage {
  int64_t height = 0, row_bytes = 0, channels = 0;
  const uint8_t* pixels = nullptr;        // [height, row_bytes]
  DeflateState* state = nullptr;          // first in the work memory
  unsigned long long* offsets = nullptr;  // [pieces]: where in the stream each piece of a row begins, in bits
  uint32_t* starts = nullptr;             // [pieces, threads]: where each segment begins in its piece, in bits
  uint32_t* stream = nullptr;             // raw deflate, [stream_bytes / 4]

  int64_t pieces() const;
  int64_t work_bytes() const;
  // The most that it can take. A byte takes at most 9 bits where all symbols have codes of one length. The code here is
  // the best of at most 15 bits, except that some symbols with a probability below 2^-12 take a bit more.
  int64_t stream_bytes() const { return (10 * height * (row_bytes + 1) / 8 + 1024) / 4 * 4; }
  void place(void* work, void* out);
};

void deflate(const PngImage& image, Stream stream);

}  // namespace lfgs::cuda
