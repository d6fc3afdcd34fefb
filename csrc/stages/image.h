// What writing an image file takes beside the file itself.
#pragma once

#include <cstdint>
#include <vector>

namespace lfgs {

// The rows of a PNG [rows, row_bytes], 16-bit samples with the high byte first, as the zlib stream of its IDAT chunks.
//
// Every row has the filter Up, and only runs of one byte are stored as repetitions: in the image of a panel neighbours
// of a row belong to different views, so that nothing else repeats, while the pixel above is often of the same view.
// Source: Portable Network Graphics (PNG) Specification (Third Edition), W3C, 2025, sections 9.2 and 10; RFC 1950,
// RFC 1951.
std::vector<uint8_t> png_stream(const uint8_t* pixels, int64_t rows, int64_t row_bytes);

}  // namespace lfgs
