// The stages that lay a photo over the network's prediction, on a CUDA device. They are the stages of stages/photo.h
// with device pointers and a stream. Nothing allocates or waits: a CUDA graph can hold them.
#pragma once

#include <cstdint>

#include "cuda/stages/stages.h"
#include "math/photo/ramps.h"
#include "math/photo/sheet.h"
#include "math/photo/surface.h"

namespace lfgs::cuda {

void surface(const Surface& job, Stream stream);
void sheet(const Sheet& job, Stream stream);

constexpr int kFoundNumbers = 5;  // the numbers that find_object keeps

struct Photo {
  int64_t height = 0, width = 0;
  const uint8_t* bytes = nullptr;  // [height, width, 4] straight RGB and alpha, or
  const float* floats = nullptr;   // the same in 0..1
  float opaque = 0;                // alpha from which on a pixel is of the object, as the photo counts
  double margin = 0;               // margin on each side of the object's box, relative to its longer side
  unsigned* found = nullptr;       // [kFoundNumbers] the object's box
  float* checks = nullptr;         // [2] whether all values are in 0..1, whether there is an object
};

// Find the object's box, and write the checks.
void find_object(const Photo& photo, Stream stream);

// Write [4, size_px, size_px], premultiplied, of the square round the box: zero beyond the photo's edges, by the
// antialiased bilinear filter. narrow: [height, size_px, 4], for the photo resized along rows.
void crop_object(const Photo& photo, int size_px, float* narrow, float* out, Stream stream);

}  // namespace lfgs::cuda
