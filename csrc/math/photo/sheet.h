// The sheet of texels over the object of a photo, a texel at a time: its position on the surface, and its look.
// lightfield_gs/models/detail.py says why, differentiably. There are two passes over all texels, since each needs its
// neighbours. The first finds the surface and blurs along rows; the second does the rest. Between them ramps.h snaps
// the surface.
#pragma once

#include <cmath>
#include <cstdint>
#include <glm/glm.hpp>

#include "base/config.h"
#include "math/harmonics.h"
#include "math/photo/blur.h"
#include "scene/gaussians.h"

namespace lfgs {

// The choices of lightfield_gs/models/detail.py. Lengths are in texels unless noted.
struct SheetLook {
  float deviation, thickness;             // of a texel along the surface and across it
  float blur;                             // the deviation by which drawing blurs the photo
  float opacity, most_opaque;             // of a texel that is covered, and the most that one may have
  float most_of_sheet;                    // the opacity of the sheet where the photo's is 1
  float sharper_colour, sharper_outline;  // the part of the loss by blur that is put back
  float haze, object;                     // opacities of the photo: nothing up to the first, all from the second on
  float same_surface, steepest;           // footprints of depth between pixels of one surface, and from texel to texel
};

// The neighbours that a median takes: in `step` texels up to `radius` steps off. Other colours weigh `least`.
struct RampWindow {
  int radius = 1, step = 1;
  float deviation = 1, least = 0;  // of the weight, in texels; weight
};

// The choices of lightfield_gs/models/ramps.py. Slopes are in footprints of depth from texel to texel, lengths in
// texels.
struct RampLook {
  float steep, slope;         // in the middle of a ramp, and anywhere on it
  float down;                 // weight of steps down
  float apart;                // depth between surfaces, footprints
  float similar;              // deviation of the colours of a surface
  float there;                // least opacity of the object
  int reach, around, spread;  // half the length of a ramp, reach of cleaning, distance over which surfaces are apart
  RampWindow snap, clean;
  int snaps, cleans;  // passes
};

struct Sheet {
  int64_t height = 0, width = 0;      // pixels of the network's grid
  int factor = 1;                     // texels to a side of each
  const float* disparity = nullptr;   // [height, width] 1 / z of the surface
  const float* harmonics = nullptr;   // [3 (K - 1), height, width] those beyond the first
  const float* mask = nullptr;        // [height, width] opacity of the object
  const float* photo = nullptr;       // [4, rows, columns] premultiplied RGB and alpha, 0..1
  const float* intrinsics = nullptr;  // [4] fx, fy, cx, cy in pixels of the grid
  SheetLook look;
  RampLook ramps;
  float* soft = nullptr;     // [rows, columns, 5] colours, alpha and optical depth, blurred along rows
  float* surface = nullptr;  // [rows, columns] depth of the texels in footprints, and in the end their disparity
  float* other = nullptr;    // [rows, columns] the same of every other pass
  uint8_t* marks = nullptr;  // [2, rows, columns], see ramps.h
  Gaussians<float> out;      // [rows * columns]

  LFGS_HD int64_t rows() const { return factor * height; }
  LFGS_HD int64_t columns() const { return factor * width; }
};

// The pixels among which a texel lies, and how much it has of each: bilinear between pixels of one surface.
struct Mix {
  int64_t pixels[4];
  float weights[4];

  LFGS_HD float operator()(const float* channel) const {
    float sum = 0;
    for (int k = 0; k < 4; ++k) sum += weights[k] * channel[pixels[k]];
    return sum;
  }
};

// Along one axis: the pixel that a texel is in, the one towards which it lies, and the weight of that pixel.
struct Between {
  int64_t own, other;
  float part;

  LFGS_HD Between(int64_t texel, int factor, int64_t pixels) {
    own = texel / factor;
    const float place = (float(texel - own * factor) + 0.5f) / float(factor) - 0.5f;
    const int64_t next = place > 0 ? own + 1 : own - 1;
    other = next < 0 ? 0 : next < pixels ? next : pixels - 1;
    part = std::abs(place);
  }
};

LFGS_HD Mix texel_mix(const Sheet& sheet, int64_t row, int64_t column) {
  const Between y(row, sheet.factor, sheet.height), x(column, sheet.factor, sheet.width);
  Mix mix{{y.own * sheet.width + x.own, y.own * sheet.width + x.other, y.other * sheet.width + x.own,
           y.other * sheet.width + x.other},
          {(1 - y.part) * (1 - x.part), (1 - y.part) * x.part, y.part * (1 - x.part), y.part * x.part}};
  const float own = sheet.disparity[mix.pixels[0]], per_footprint = sheet.intrinsics[0] / sheet.look.same_surface;
  float sum = mix.weights[0];
  for (int k = 1; k < 4; ++k) {
    const float apart = std::abs(std::log(sheet.disparity[mix.pixels[k]] / own)) * per_footprint;
    mix.weights[k] *= glm::clamp(2 - apart, 0.f, 1.f);
    sum += mix.weights[k];
  }
  for (float& weight : mix.weights) weight /= sum;
  return mix;
}

// The disparity of a texel, bilinear between pixels, each weighted by its opacity too: beside the object there is none.
LFGS_HD float covered_disparity(const Sheet& sheet, int64_t row, int64_t column) {
  const Between y(row, sheet.factor, sheet.height), x(column, sheet.factor, sheet.width);
  const int64_t pixels[4] = {y.own * sheet.width + x.own, y.own * sheet.width + x.other, y.other * sheet.width + x.own,
                             y.other * sheet.width + x.other};
  const float weights[4] = {(1 - y.part) * (1 - x.part), (1 - y.part) * x.part, y.part * (1 - x.part), y.part * x.part};
  float sum = 0, all = 0;
  for (int k = 0; k < 4; ++k) {
    const float weight = weights[k] * glm::max(sheet.mask[pixels[k]], 1e-4f);
    sum += weight * sheet.disparity[pixels[k]];
    all += weight;
  }
  return sum / all;
}

// Straight colour, grey where nothing is, and alpha of a texel. Dividing by 1/50 at least keeps the rounding of faint
// pixels from becoming bright colours.
constexpr float kFaint = 0.02f;
LFGS_HD glm::vec4 straight_texel(const Sheet& sheet, int64_t texel) {
  const int64_t step = sheet.rows() * sheet.columns();
  const float* photo = sheet.photo + texel;
  const float alpha = photo[3 * step];
  if (!(alpha > kFaint)) return {0.5f, 0.5f, 0.5f, alpha};
  return {glm::clamp(glm::vec3(photo[0], photo[step], photo[2 * step]) / alpha, 0.f, 1.f), alpha};
}
// The same, its colour times alpha.
LFGS_HD glm::vec4 covering_texel(const Sheet& sheet, int64_t texel) {
  const int64_t step = sheet.rows() * sheet.columns();
  const float* photo = sheet.photo + texel;
  const float alpha = photo[3 * step];
  if (!(alpha > kFaint)) return {0.5f * alpha, 0.5f * alpha, 0.5f * alpha, alpha};
  return {glm::clamp(glm::vec3(photo[0], photo[step], photo[2 * step]), 0.f, alpha), alpha};
}

// The optical depth of the sheet over the optical depth of a whole object: overlapping texels add it up. Where the
// photo shows the object in part it is less yet, for what spreads beyond the outline cannot be taken back there.
LFGS_HD float thickness_at(const SheetLook& look, float alpha) {
  if (alpha == 0 || alpha == 1) return alpha;  // most of a photo, and logarithms are slow
  return alpha * std::log1p(-look.most_of_sheet * alpha) / std::log1p(-look.most_of_sheet);
}

// A texel's colour times alpha, alpha and optical depth, blurred.
struct SoftTexel {
  glm::vec4 covering{0};
  float thickness = 0;

  LFGS_HD void add(float weight, const glm::vec4& more, float thicker) {
    covering += weight * more;
    thickness += weight * thicker;
  }
};

// The first pass. `weight` gives the weights of Blur.
template <class Weight>
LFGS_HD void prepare_texel(const Sheet& sheet, int reach, const Weight& weight, int64_t row, int64_t column) {
  const int64_t columns = sheet.columns(), texel = row * columns + column;
  SoftTexel soft;
  for (int k = -reach; k <= reach; ++k) {
    if (column + k < 0 || column + k >= columns) continue;
    const glm::vec4 covering = covering_texel(sheet, texel + k);
    soft.add(weight(k), covering, thickness_at(sheet.look, covering.w));
  }
  for (int c = 0; c < 4; ++c) sheet.soft[5 * texel + c] = soft.covering[c];
  sheet.soft[5 * texel + 4] = soft.thickness;
  const float per_footprint = float(sheet.factor) * sheet.intrinsics[0];
  sheet.surface[texel] = -std::log(covered_disparity(sheet, row, column)) * per_footprint;
  sheet.marks[texel] = sheet.marks[sheet.rows() * columns + texel] = 0;
}

template <class Weight>
LFGS_HD SoftTexel blurred_down(const Sheet& sheet, int reach, const Weight& weight, int64_t row, int64_t column) {
  const int64_t rows = sheet.rows(), columns = sheet.columns();
  SoftTexel soft;
  for (int k = -reach; k <= reach; ++k) {
    if (row + k < 0 || row + k >= rows) continue;
    const float* from = sheet.soft + 5 * ((row + k) * columns + column);
    soft.add(weight(k), glm::vec4(from[0], from[1], from[2], from[3]), from[4]);
  }
  return soft;
}

// The smaller of the steps to both neighbours, `stride` texels off, where both go the same way, else 0: edges stay
// open. Beyond the sheet's own edges there is no step.
LFGS_HD float to_step(const float* disparity, int64_t stride, int64_t at, int64_t count) {
  if (at == 0 || at + 1 >= count) return 0;
  const float ahead = disparity[stride] - disparity[0], behind = disparity[0] - disparity[-stride];
  if (!(ahead * behind > 0)) return 0;
  return std::abs(ahead) < std::abs(behind) ? ahead : behind;
}

// The quaternion, w first, of the rotation with these columns, which turns by less than 180 degrees.
LFGS_HD glm::vec4 to_quaternion(const glm::vec3& first, const glm::vec3& second, const glm::vec3& third) {
  const float w = std::sqrt(glm::max(1 + first.x + second.y + third.z, 1e-6f)) / 2;
  const glm::vec3 axis = glm::vec3(second.z - third.y, third.x - first.z, first.y - second.x) / (4 * w);
  const glm::vec4 q(w, axis.x, axis.y, axis.z);
  return q / std::sqrt(glm::dot(q, q));
}

struct TexelGaussian {
  glm::vec3 mean, scale, constant;  // the last: the first harmonic
  glm::vec4 quaternion;
  float opacity;
};

// Turn a texel along the surface. The slopes across and down are in footprints of depth a texel. The axes of the texel
// are the direction of descent, the level direction and the normal. Along the first, texels lie farther apart.
LFGS_HD void lay_along(float across, float down, const glm::vec3& ray, TexelGaussian& texel) {
  const glm::vec3 tangent_x = glm::vec3(1, 0, 0) + across * ray, tangent_y = glm::vec3(0, 1, 0) + down * ray;
  const float right = across < 0 ? across - 1e-4f : across + 1e-4f;  // a level surface descends to the right
  const float length = std::sqrt(right * right + down * down);
  const glm::vec3 descent = std::abs(right) / length * tangent_x + (across < 0 ? -down : down) / length * tangent_y;
  const float stretch = std::sqrt(glm::dot(descent, descent));
  const glm::vec3 first = descent / stretch, normal = glm::cross(tangent_x, tangent_y);
  const glm::vec3 third = normal / std::sqrt(glm::dot(normal, normal));
  texel.quaternion = to_quaternion(first, glm::cross(third, first), third);
  texel.scale.x *= stretch;
}

// The second pass, without the harmonics beyond the first. A texel beside the object is not seen, so that where it is
// will do.
template <class Weight>
LFGS_HD TexelGaussian finish_texel(const Sheet& sheet, int reach, const Weight& weight, int64_t row, int64_t column) {
  const int64_t columns = sheet.columns(), texel = row * columns + column;
  const SheetLook& look = sheet.look;
  const float* disparity = sheet.surface + texel;
  const float factor = float(sheet.factor), *camera = sheet.intrinsics, depth = 1 / disparity[0];
  const float footprint = 1 / (factor * camera[0]), size = footprint * depth;
  const glm::vec3 ray((float(column) + 0.5f - factor * camera[2]) * footprint,
                      (float(row) + 0.5f - factor * camera[3]) / (factor * camera[1]), 1);
  const glm::vec4 straight = straight_texel(sheet, texel);
  const float alpha = straight.w, there = glm::clamp((alpha - look.haze) / (look.object - look.haze), 0.f, 1.f);
  glm::vec3 colour(straight);
  TexelGaussian found{
      ray * depth, size * glm::vec3(look.deviation, look.deviation, look.thickness), {}, {1, 0, 0, 0}, 0};

  if (there > 0) {
    const SoftTexel soft = blurred_down(sheet, reach, weight, row, column);
    const glm::vec3 near = glm::vec3(soft.covering) / glm::max(soft.covering.w, 1e-3f);
    const float thickness = thickness_at(look, alpha);
    colour = glm::clamp(colour + look.sharper_colour * (colour - near), 0.f, 1.f);
    const float outline = glm::max(thickness + look.sharper_outline * (thickness - soft.thickness), 0.f);
    found.opacity = glm::clamp(look.opacity * outline * there, 0.f, look.most_opaque);

    const float slope = -1 / (disparity[0] * footprint);
    const float across = to_step(disparity, 1, column, columns) * slope;
    const float down = to_step(disparity, columns, row, sheet.rows()) * slope;
    lay_along(glm::clamp(across, -look.steepest, look.steepest), glm::clamp(down, -look.steepest, look.steepest), ray,
              found);
  }
  found.constant = (colour - 0.5f) / float(kConstantHarmonic);
  return found;
}

// The harmonics beyond the first, which are the surface's.
LFGS_HD void store_harmonics(const Sheet& sheet, int64_t row, int64_t column) {
  const Mix mix = texel_mix(sheet, row, column);
  const int rest = 3 * (sheet.out.sh_count() - 1);
  float* to = sheet.out.sh + (row * sheet.columns() + column) * (rest + 3) + 3;
  for (int c = 0; c < rest; ++c) to[c] = mix(sheet.harmonics + c * sheet.height * sheet.width);
}

}  // namespace lfgs
