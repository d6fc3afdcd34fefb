// Which view every sub-pixel of a panel shows, exactly: twin of lightfield_gs/panels/panel.py and cells.py. A panel has
// the fields of Panel.to_dict. Numbers of two whole numbers, BigInts, keep every bit; phases are 2^-64 lens widths.

const LENS_WIDTH = 1n << 64n;
export const PERIOD = 4; // of cells, in rows and columns

/** The lens before a row of cameras, of which that of view 0 is at `start`, each next one `step` to the right. */
export function lensOf(panel, start, step) {
  const width = fraction(panel.line_number), slant = fraction(panel.slant_tan), first = fraction(panel.phase);
  const phases = [first, { over: 1n, under: 1n }, times(slant, 3n)].map((length) => phaseOf(length, width));
  const lens = {
    width_px: panel.width_px, height_px: panel.height_px, views: panel.views, line_number: panel.line_number,
    slant_tan: panel.slant_tan, phase: panel.phase, phases, bgr: panel.subpixel_order === "BGR", continuous: false,
    offset_start: start, offset_step: step, cells: null,
  };
  return panel.subpixel_cells?.length ? withCells(lens, panel, width, slant) : lens;
}

/** A lens of one view: what its camera sees is an ordinary picture. */
export function plainLens(width_px, height_px) {
  return {
    width_px, height_px, views: 1, line_number: 1, slant_tan: 0, phase: 0, phases: [0n, 0n, 0n], bgr: false,
    continuous: false, offset_start: 0, offset_step: 0, cells: null,
  };
}

/** How far sub-pixels are beyond the first stripe of their pixel, in sub-pixels: [row mod PERIOD][column mod PERIOD][channel]. */
export function subpixelOffsets(panel) {
  const stripes = panel.subpixel_order === "BGR" ? [2, 1, 0] : [0, 1, 2], places = [...Array(PERIOD).keys()];
  const cells = panel.subpixel_cells?.length ? cellOffsets(panel, fraction(panel.slant_tan)) : null;
  const numbers = cells?.map((cell) => cell.map(({ over, under }) => Number(over) / Number(under)));
  return places.map((row) => places.map((column) => (numbers ? numbers[cellNumber(panel, column, row)] : stripes)));
}

/** The same of each cell, by channel, as fractions. */
const cellOffsets = (panel, slant) => panel.subpixel_cells.map((cell) => cell.map(([x, y]) =>
  minus(times(fraction(x), 3n), times(product(slant, fraction(y)), 3n))));

function withCells(lens, panel, width, slant) {
  const offsets = cellOffsets(panel, slant);
  const pixels = [];
  for (let row = 0; row < PERIOD; row++)
    for (let column = 0; column < PERIOD; column++) pixels.push(inOrder(offsets[cellNumber(panel, column, row)]));
  const beyond = pixels.flat().map(({ offset, rank }) => minus(offset, { over: BigInt(rank), under: 1n }));
  const least = beyond.reduce((a, b) => (isLess(b, a) ? b : a)), most = beyond.reduce((a, b) => (isLess(a, b) ? b : a));
  const both = plus(least, most), shift = { over: both.over, under: 2n * both.under };
  const whole = wrapped(rounded(shift.over * LENS_WIDTH * width.under, shift.under * width.over)), [start, across] = lens.phases;
  const cells = pixels.flat().map(({ offset, rank, channel }) =>
    ({ channel, phase: wrapped(phaseOf(offset, width) - BigInt(rank) * across - whole) }));
  const phase = lens.phase + Number(shift.over) / Number(shift.under);
  return { ...lens, phase, phases: [wrapped(start + whole), across, lens.phases[2]], cells };
}

/** The sub-pixels of a pixel from left to right. */
function inOrder(offsets) {
  const found = offsets.map((offset, channel) => ({ offset, channel }));
  found.sort((a, b) => (isLess(a.offset, b.offset) ? -1 : isLess(b.offset, a.offset) ? 1 : a.channel - b.channel));
  return found.map((one, rank) => ({ ...one, rank }));
}

/** The number of a pixel's cell, by row and column mod PERIOD: cell_numbers of cells.py. */
function cellNumber({ cell_pattern, cell_rule, cell_rows, height_px }, x, row) {
  const y = cell_rows === "top" ? row : (((height_px - 1 - row) % PERIOD) + PERIOD) % PERIOD;
  const unity = [0, (x + y) % 2, x % 2, (y + 2 * (x % 2)) % 4, y % 2];
  if (cell_rule === "webxr" && cell_pattern === 2) return y % 4;
  if (cell_rule === "webxr" && cell_pattern === 4) return x % 2;
  return unity[cell_pattern];
}

// Fractions {over, under > 0}

/** A double as the fraction that it is. */
function fraction(number) {
  let under = 1n, value = number;
  while (!Number.isInteger(value)) { value *= 2; under *= 2n; }
  return { over: BigInt(value), under };
}

const times = (a, n) => ({ over: a.over * n, under: a.under });
const product = (a, b) => ({ over: a.over * b.over, under: a.under * b.under });
const plus = (a, b) => ({ over: a.over * b.under + b.over * a.under, under: a.under * b.under });
const minus = (a, b) => plus(a, times(b, -1n));
const isLess = (a, b) => a.over * b.under < b.over * a.under;
const floored = (over, under) => over / under - (over % under < 0n ? 1n : 0n);
const wrapped = (phase) => ((phase % LENS_WIDTH) + LENS_WIDTH) % LENS_WIDTH;

/** A length in sub-pixels as a phase, rounded up. */
const phaseOf = (length, width) => wrapped(-floored(-length.over * LENS_WIDTH * width.under, length.under * width.over));

/** Rounded to the nearest whole number, halves to the even one. */
function rounded(over, under) {
  const low = floored(over, under), rest = 2n * (over - low * under);
  return rest > under || (rest === under && low % 2n !== 0n) ? low + 1n : low;
}
