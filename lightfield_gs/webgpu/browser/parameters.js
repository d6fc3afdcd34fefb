// The numbers of a frame as csrc/webgpu/frame.wgsl takes them, and how the panel is cut into boxes: twin of
// lightfield_gs/webgpu/parameters.py.

export const BOX_ROWS = 16; // as in csrc/webgpu/footprint.wgsl, as the next two
const TILE_WIDTH = 32, BOX_LENSES = 16;
export const ORDINALS = [0, 2, 3, 6]; // tilings in the order of cost_of_splat in csrc/webgpu/project.wgsl
const LENS_WIDTHS = [6, 200]; // sub-pixels, of lenses that boxes are made of
// In sub-pixels: from a cell's shift to the next one's, and between the least and the most, for boxes of lenses
const LEAST_STEP = -0.9, MOST_SPREAD = 1.5;
const LOG2_MIN_ALPHA = Math.log2(1 / 255), MIN_TRANSMITTANCE = 1e-4; // of an exact picture
const CELLS_IN_ROW = 12, CELLS = 48, POSE_NUMBERS = 16, FLOATS = 40, WORDS = 20;

/** The boxes of a panel: {ordinals, across, down, groups, firstLens}. */
export function boxesOf(lens, ordinals) {
  const down = Math.ceil(lens.height_px / BOX_ROWS);
  if (!ordinals) return { ordinals, across: Math.ceil(lens.width_px / TILE_WIDTH), down, groups: 1, firstLens: 0 };
  const [least, most] = shiftsOf(lens), corners = [0, 3 * lens.width_px].flatMap((place) => [0, lens.height_px].flatMap((row) =>
    [least, most].map((shift) => (place + 3 * row * lens.slant_tan + lens.phase + shift) / lens.line_number)));
  const firstLens = Math.floor(Math.min(...corners)) - 1;
  const across = Math.ceil((Math.ceil(Math.max(...corners)) + 1 - firstLens) / BOX_LENSES);
  return { ordinals, across, down, groups: Math.ceil((Math.floor(lens.line_number + most - least) + 1) / ordinals), firstLens };
}

/** How far cells lie beyond their stripes, in sub-pixels, by row mod 4 and sub-pixel mod 12. */
function cellShifts(lens) {
  return lens.cells?.map(({ phase }) => (Number(BigInt.asIntN(64, phase)) * lens.line_number) / 2 ** 64) ?? Array(CELLS).fill(0);
}

/** The least and the most of them. */
function shiftsOf(lens) {
  const shifts = cellShifts(lens);
  return [Math.min(...shifts), Math.max(...shifts)];
}

/** The ordinals of the tilings that a panel allows; boxes of lenses need cells in the order of stripes. */
export function tilings(lens) {
  const shifts = cellShifts(lens), [least, most] = shiftsOf(lens);
  const next = (k) => shifts[k - (k % CELLS_IN_ROW) + ((k + 1) % CELLS_IN_ROW)];
  const isOrdered = shifts.every((shift, k) => next(k) - shift > LEAST_STEP) && most - least <= MOST_SPREAD;
  const fit = LENS_WIDTHS[0] <= lens.line_number && lens.line_number <= LENS_WIDTHS[1];
  return fit && isOrdered ? ORDINALS : ORDINALS.slice(0, 1);
}

/** The struct Params.
 *  room: for pairs, colours, large splats and chunks of long lists. rows: of boxes of this pass, first and one behind. */
export function packParams({ camera, antialiased, background, tolerance }, { degree, count }, boxes, rows, room) {
  const { lens, pose } = camera, data = new ArrayBuffer(8 * POSE_NUMBERS + 4 * (FLOATS + WORDS + 4 * CELLS));
  const floats = new Float32Array(data, 8 * POSE_NUMBERS), words = new Uint32Array(data, 8 * POSE_NUMBERS);
  const reach = Math.max(Math.abs(lens.offset_start), Math.abs(lens.offset_start + lens.offset_step * lens.views));
  const [start, step] = [lens.offset_start, lens.offset_step].map((value) => (reach > 0 ? value / reach : 0));
  const [fx, fy, cx, cy] = camera.intrinsics, [right, down, ahead] = [0, 4, 8].map((row) => pose.slice(row, row + 4));
  new Float64Array(data, 0, POSE_NUMBERS).set([
    ...right.map((x, k) => fx * x + cx * ahead[k]), ...down.map((y, k) => fy * y + cy * ahead[k]), ...ahead,
    ...ahead.map((z, k) => reach * fx * (z / camera.zero_depth - (k === 3 ? 1 : 0))),
  ]);
  const turn = [0, 4, 8].flatMap((row) => [...pose.slice(row, row + 3), 0]);
  floats.set([
    ...turn, ...camera.intrinsics, ...camera.limits.slice(0, 4),
    reach, 1 / camera.zero_depth, start, step, ...background, 0,
    lens.line_number, lens.slant_tan, lens.phase, boxes.firstLens,
    camera.aperture, antialiased ? 1 : 0, tolerance, camera.limits[4],
    LOG2_MIN_ALPHA, 0, MIN_TRANSMITTANCE, LOG2_MIN_ALPHA,
  ]);
  words.set([
    lens.width_px, lens.height_px, lens.views, count, ...lens.phases.flatMap(halves), lens.continuous ? 1 : 0, degree,
    boxes.across, rows[1] - rows[0], boxes.groups, rows[0], ...room,
  ], FLOATS);
  lens.cells?.forEach(({ phase, channel }, k) => words.set([...halves(phase), channel], FLOATS + WORDS + 4 * k));
  shiftsOf(lens).forEach((shift, k) => { floats[FLOATS + WORDS + 4 * k + 3] = shift; });
  return data;
}

/** The low and the high word of 64 bits, a BigInt. */
const halves = (phase) => [Number(phase & 0xffffffffn), Number(phase >> 32n)];
