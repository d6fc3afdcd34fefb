// Where the alpha of a splat may be above 1/255: twin of csrc/math/footprint.h, docs/design.md, "What a splat touches".
// Bounds err on the wide side. A box is a piece of the image with a list of its own: a tile of pixels, or lenses x rows
// x a group of ordinals of sub-pixels, which shears with the lens.

const LENSES = 16; const LENS_ROWS = 16;
const TILE_WIDTH = 32; const TILE_HEIGHT = 16;
const BOX_ROWS = select(TILE_HEIGHT, LENS_ROWS, BY_LENS);
const MARGIN = 0.01;

// Largest S(s) over the rig.
fn widest(s: Splat) -> f32 { return max(s.b.x - s.b.y + s.b.z, s.b.x + s.b.y + s.b.z); }

fn box_count() -> u32 { return P.boxes.x * P.boxes.y * P.boxes.z; }
fn box_number(column: u32, row: u32, group: u32) -> u32 {
  return (group * P.boxes.y + row - P.boxes.w) * P.boxes.x + column;
}

// How much a box leans per row, in pixels.
fn shear() -> f32 { return select(0.0, P.lens.y, BY_LENS); }

// The offsets of the samples of a group: the middle, and half their range.
fn offsets_of(group: u32) -> vec2f {
  if (!BY_LENS) { return vec2f(0.0, 1.0); }
  let per = f32(P.size.z) / P.lens.x;
  let shifts = cell_shifts();
  let spread = (shifts.y - shifts.x) * per + 1.0;
  let low = max(f32(group * u32(ORDINALS)) * per - spread, 0.0);
  let high = min(f32((group + 1u) * u32(ORDINALS)) * per + spread, f32(P.size.z));
  return vec2f(P.rig.z + P.rig.w * 0.5 * (low + high), abs(P.rig.w) * 0.5 * (high - low));
}

// The interval of x + shear (y - 1/2) that a splat covers at distances d1..d2 of rows, from all these offsets.
fn footprint_columns(s: Splat, d1: f32, d2: f32, widest: f32, shear: f32, offsets: vec2f) -> vec2f {
  let nearest = select(select(0.0, -d2, d2 < 0.0), d1, d1 > 0.0);
  let middle = 0.5 * (d1 + d2); let spread = 0.5 * (d2 - d1);
  var half = sqrt(max(0.0, s.b.w * (s.c.z - nearest) * (s.c.z + nearest) * widest)) + 2.0 * MARGIN;
  let sweep = s.a.y + s.c.y * middle;
  half += abs(s.c.x + shear + offsets.x * s.c.y) * spread + offsets.y * (abs(sweep) + abs(s.c.y) * spread);
  let centre = s.a.x + s.c.x * middle + offsets.x * sweep + shear * (s.a.z + middle - 0.5);
  return vec2f(centre - half, centre + half);
}

// The rows of boxes of this pass that a splat touches: first, and one behind the last.
fn box_rows(s: Splat) -> vec2i {
  if (!(s.c.z >= 0.0)) { return vec2i(0, 0); }
  let top = max(s.a.z - s.c.z - MARGIN, 0.0);
  let bottom = min(s.a.z + s.c.z + MARGIN, f32(P.size.y));
  if (!(top <= bottom)) { return vec2i(0, 0); }
  let first = i32(P.boxes.w);
  let rows = vec2i(max(i32(top) / BOX_ROWS, first), min(i32(bottom) / BOX_ROWS + 1, first + i32(P.boxes.y)));
  return vec2i(rows.x, max(rows.x, rows.y));
}

// The boxes of a row and a group that a splat touches: first, and one behind the last.
fn box_columns(s: Splat, row: i32, group: u32, widest: f32) -> vec2u {
  let d1 = max(f32(row * BOX_ROWS) + 0.5 - MARGIN - s.a.z, -s.c.z);
  let d2 = min(f32((row + 1) * BOX_ROWS) - 0.5 + MARGIN - s.a.z, s.c.z);
  if (!(d1 <= d2)) { return vec2u(0u); }
  let x = footprint_columns(s, d1, d2, widest, shear(), offsets_of(group));
  var low = (x.x - 0.5) / f32(TILE_WIDTH); var high = (x.y - 0.5) / f32(TILE_WIDTH);
  if (BY_LENS) {
    let shifts = cell_shifts();
    low = (((x.x - 0.5) * 3.0 + shifts.x + P.lens.z) / P.lens.x - P.lens.w) / f32(LENSES);
    high = (((x.y - 0.5) * 3.0 + 2.0 + shifts.y + P.lens.z) / P.lens.x - P.lens.w) / f32(LENSES);
  }
  if (!(high >= 0.0 && low < f32(P.boxes.x))) { return vec2u(0u); }
  return vec2u(u32(max(low, 0.0)), u32(min(high, f32(P.boxes.x - 1u))) + 1u);
}
