// What an eye sees through the lenses of a panel, in the numbers of csrc/webgpu/seen.wgsl: twin of
// lightfield_gs/panels/simulate.py, whose simulate has the formulas.

import { PERIOD, subpixelOffsets } from "./lens.js";

const RADIANS = Math.PI / 180, FWHM_TO_SIGMA = 1 / (2 * Math.sqrt(2 * Math.log(2)));

/** An eye `place`, -0.5 .. 0.5, across the viewing zone of a panel: {samples, sharpness, borders, turns}; null where the
 *  panel lacks a measure. */
export function eyeBefore(panel, place) {
  const { width_px: width, height_px: height, line_number: lens, slant_tan: slant, viewing_distance_mm: distance } = panel;
  if (!distance || !panel.pixel_pitch_mm) return null;
  const tangent = Math.tan((panel.cone_deg / 2) * RADIANS), subpixel = panel.pixel_pitch_mm / 3;
  const gap = ((lens * subpixel) / (2 * tangent)) * (panel.invert_views ? -1 : 1);
  if (distance + gap <= 0) throw new Error(`the eye must be farther than the lens gap of ${Math.abs(gap)} mm`);
  const lensWidth = (lens * subpixel * distance) / (distance + gap), right = place * 2 * distance * tangent;
  const middle = 1.5 * (width - 1) + (panel.subpixel_cells?.length ? 0 : 1) + 1.5 * (height - 1) * slant + panel.phase;
  const slope = (subpixel * distance) / ((distance + gap) * lensWidth);
  const shift = middle / lens + (right * gap) / ((distance + gap) * lensWidth);
  const offsets = subpixelOffsets(panel), turns = new Float32Array(3 * PERIOD * width + height);
  for (let row = 0; row < PERIOD; row++)
    for (let channel = 0; channel < 3; channel++)
      for (let column = 0, at = (3 * row + channel) * width; column < width; column++, at++)
        turns[at] = fraction(slope * (3 * column + offsets[row][column % PERIOD][channel] + panel.phase - middle) + shift);
  for (let row = 0; row < height; row++) turns[3 * PERIOD * width + row] = fraction(slope * 3 * slant * row);
  const across = borders(width, lens), down = borders(height, lens);
  return {
    samples: [across.length - 1, down.length - 1], sharpness: lens / (FWHM_TO_SIGMA * Math.SQRT2),
    borders: new Uint32Array([...across, ...down]), turns,
  };
}

const fraction = (number) => number - Math.floor(number);

/** The borders in pixels of samples about a lens wide. */
function borders(size, lens) {
  const count = Math.min(size, Math.max(1, toEven((3 * size) / lens))), step = size / count;
  return Array.from({ length: count + 1 }, (_, k) => (k === count ? size : toEven(k * step)));
}

/** Rounded to the nearest whole number, halves to the even one. */
function toEven(number) {
  const low = Math.floor(number), rest = number - low;
  return rest > 0.5 || (rest === 0.5 && low % 2 !== 0) ? low + 1 : low;
}
