// The patterns of a calibration, drawn here: each sub-pixel in the colour of its view, as panels/patterns.py does it.

const ENTRIES = 1024, BITS = 22; // entries of a table of colours, and the bits of a phase below them
const HUE_SPAN = 5 / 6, MIDDLE = 1 / 8;

/** The light of a channel, 0..255, at a fraction of the views: a hue, red to magenta; or white in the middle quarter. */
function light(kind, fraction, channel, views) {
  if (kind === "centre") return Math.abs(fraction - 0.5) < MIDDLE ? 255 : 0;
  const turns = Math.floor(fraction * views) / Math.max(1, views - 1) * HUE_SPAN - channel / 3;
  return Math.round(255 * Math.min(1, Math.max(0, 2 - 6 * Math.abs(turns - Math.round(turns)))));
}

function tables(kind, views) {
  return [0, 1, 2].map((channel) => Uint32Array.from({ length: ENTRIES }, (_, entry) =>
    light(kind, (entry + 0.5) / ENTRIES, channel, views) << (8 * channel)));
}

/** Draws a pattern for a lens, whose phases are in 2^-32 lens widths: start, across, down, offsets [4, 4, 3]. */
export function drawPattern(canvas, kind, views, lens) {
  const { width, height } = canvas, context = canvas.getContext("2d", { alpha: false });
  const image = context.createImageData(width, height), pixels = new Uint32Array(image.data.buffer);
  const [red, green, blue] = tables(kind, views), offsets = Uint32Array.from(lens.offsets);
  for (let row = 0, at = 0; row < height; row++) {
    const first = (lens.start + Math.imul(lens.down, row)) | 0;
    for (let column = 0; column < width; column++, at++) {
      const phase = (first + Math.imul(lens.across, column)) | 0, cell = 3 * (4 * (row & 3) + (column & 3));
      pixels[at] = 0xff000000 | red[(phase + offsets[cell]) >>> BITS] |
        green[(phase + offsets[cell + 1]) >>> BITS] | blue[(phase + offsets[cell + 2]) >>> BITS];
    }
  }
  context.putImageData(image, 0, 0);
}
