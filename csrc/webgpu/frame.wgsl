// What all stages of a light-field frame share: its parameters, its splats and the constants of the field. The stages
// are those of csrc/stages/stages.h, and the formulas those of docs/design.md, "The formulas". Core WebGPU only.
//
// The host joins these files and puts constants before them (lightfield_gs/webgpu/shaders.py):
//   BY_LENS      boxes are of lenses, else tiles of pixels
//   ORDINALS     sub-pixels of a lens that a box of lenses has
//   CELLS, BGR   which channel a place of a pixel has
//   HARMONICS    colours vary over the rig
//   COMPENSATED  opacities are lowered where footprints are widened
//   FLOATS       the image has floats, else bytes
//   ENDS_EARLY   the splat at which a sample ends takes the light that is left, else the background
// It repeats lines between //{q and //q} for each sample of a thread: q becomes 0, 1, .., and x[q] x_0, x_1, .. So
// samples stay in registers.

struct Params {
  // Rows of factors of (mean, 1), bits of sixteen doubles, low and high words: they give u0 Z, v0 Z, Z and du Z
  pose: array<vec4u, 8>,
  turn0: vec4f, turn1: vec4f, turn2: vec4f,  // rotation from world to camera axes
  optics: vec4f,      // fx, fy, cx, cy, pixels
  limits: vec4f,      // of X/Z and Y/Z in the Jacobian: x low, high, y low, high
  rig: vec4f,         // sweep, 1/Z0, s at x = 0, ds/dx
  background: vec4f,
  lens: vec4f,        // width along a row in sub-pixels, tan(slant), D_0, number of the first lens of the boxes
  filters: vec4f,     // aperture in scene units; 1 in anti-aliased scenes; error of colours; offset of the limits
  // Of the quality, csrc/math/quality.h: log2 of the alpha that a splat must have in a patch; the least sum of its alphas
  // over the pixels; the least transmittance of a sample; log2 of the least alpha at a sample
  cuts: vec4f,
  size: vec4u,        // width, height, views, Gaussians
  phase0: vec4u,      // s0 low, high; sx low, high
  phase1: vec4u,      // sy low, high; 1 for continuous views; degree of the harmonics
  boxes: vec4u,       // of the pass: across, down, groups of ordinals; the first row
  room: vec4u,        // for pairs, colours, large splats, chunks of long lists
  // By row mod 4 and sub-pixel mod 12: phase beyond the stripe's low, high; channel. The fourth word of the first and the
  // second cell: bits of the least and the most shift of a cell against its stripe, in sub-pixels
  cells: array<vec4u, 48>,
};

// A part of a frame: of the Gaussians, or of the image.
struct Part {
  first: u32,      // Gaussian; or row of boxes that a dispatch draws
  count: u32,      // of Gaussians; or elements of a run that is merged
  first_row: u32,  // of the panel in the image buffer
  group: u32,      // the part's first workgroup, of all that project
};

// Counters of a frame.
const PAIRS = 0u;       // intersections of splats and boxes
const LONGEST = 1u;     // list
const COLOURS = 2u;     // vectors of the pool of colours in use
const CHUNKS = 3u;      // of long lists
const LARGE = 4u;       // splats that touch many boxes
const DRAWN = 5u;       // splats
const ERROR = 6u;       // of the colours, bits of a float
const PRUNED = 7u;      // splats of too little light
const COSTS = 16u;      // where the sums of cost_of_splat begin, four for each workgroup

@group(0) @binding(0) var<uniform> P: Params;
@group(0) @binding(1) var<uniform> part: Part;
@group(0) @binding(4) var<storage, read_write> splat_a: array<vec4f>;  // u0, du, v0, log2 opacity
@group(0) @binding(5) var<storage, read_write> splat_b: array<vec4f>;  // S0, S1, S2, tau
@group(0) @binding(6) var<storage, read_write> splat_c: array<vec4f>;  // c0, c1, reach_y, bits of the place of its colour
@group(0) @binding(7) var<storage, read_write> colours: array<vec4f>;
@group(0) @binding(8) var<storage, read_write> counters: array<atomic<u32>>;

// csrc/math/constants.h
const BLUR = 0.3;
const MAX_ALPHA = 0.99;
const LOG2_MAX_ALPHA = -0.014499569695115;
const MIN_ALPHA = 1.0 / 255.0;
const NEAR_DEPTH = 0.01;
const LOG2_MIN_ALPHA = -7.994353436858858;
const HALF_LOG2E = 0.7213475204444817;
const CIRCLE_ORDER = -1.0;  // stored as the order of a colour on a circle, csrc/math/colour_circle.h

// A projected Gaussian: docs/design.md, "One projection for all views".
struct Splat { a: vec4f, b: vec4f, c: vec4f };

fn reach_y(s: Splat) -> f32 { return s.c.z; }
fn load_splat(i: u32) -> Splat { return Splat(splat_a[i], splat_b[i], splat_c[i]); }

// The least and the most shift of a cell against its stripe, in sub-pixels.
fn cell_shifts() -> vec2f { return bitcast<vec2f>(vec2u(P.cells[0].w, P.cells[1].w)); }
