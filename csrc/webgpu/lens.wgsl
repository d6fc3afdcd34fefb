// Which view every sub-pixel shows, exactly: twin of csrc/scene/lens.h. docs/design.md, "Which view a sub-pixel shows".
// WGSL has no 64-bit integers, so that phases are pairs of words, low and high.

fn mul_high(a: u32, b: u32) -> u32 {
  let al = a & 0xffffu; let ah = a >> 16u; let bl = b & 0xffffu; let bh = b >> 16u;
  let mid = ah * bl + ((al * bl) >> 16u);
  let mid2 = al * bh + (mid & 0xffffu);
  return ah * bh + (mid >> 16u) + (mid2 >> 16u);
}

fn add64(a: vec2u, b: vec2u) -> vec2u {
  let low = a.x + b.x;
  return vec2u(low, a.y + b.y + select(0u, 1u, low < a.x));
}

fn times64(a: vec2u, n: i32) -> vec2u {
  let m = u32(abs(n));
  let p = vec2u(a.x * m, a.y * m + mul_high(a.x, m));
  if (n >= 0) { return p; }
  return add64(~p, vec2u(1u, 0u));
}

// The phase of a sub-pixel as if it stood in its stripe.
fn phase_at(row: i32, subpixel: i32) -> vec2u {
  return add64(P.phase0.xy, add64(times64(P.phase0.zw, subpixel), times64(P.phase1.xy, row)));
}

fn cell_at(row: i32, subpixel: i32) -> vec4u { return P.cells[(row & 3) * 12 + (subpixel % 12 + 12) % 12]; }

// The normalized offset, -1..1, of the camera that sees a sub-pixel. stripe: its phase as if it stood in its stripe.
fn offset_at(row: i32, subpixel: i32, stripe: vec2u) -> f32 {
  var phase = stripe;
  if (CELLS) { phase = add64(phase, cell_at(row, subpixel).xy); }
  let views = P.size.z;
  let low = phase.y * views;
  let part_low = low + mul_high(phase.x, views);
  let view = mul_high(phase.y, views) + select(0u, 1u, part_low < low);
  let within = select(0.5, f32(part_low) * (1.0 / 4294967296.0), P.phase1.z != 0u);
  return P.rig.z + P.rig.w * (f32(view) + within);
}

// The channel of a place in a pixel, on a panel with stripes.
fn stripe_channel(place: u32) -> u32 { return select(place, 2u - place, BGR); }

// The channel of a sub-pixel, whose place in its pixel is known.
fn channel_at(row: i32, subpixel: i32, place: u32) -> u32 {
  if (CELLS) { return cell_at(row, subpixel).z; }
  return stripe_channel(place);
}

// The first sub-pixel of a lens in a row, where lenses have 6 sub-pixels or more and cells lie in the order of the stripes.
// It is estimated to within one and what cells are shifted by, and made exact with the phase.
fn first_of_lens(row: i32, lens: f32) -> i32 {
  let shifts = cell_shifts();
  let middle = lens * P.lens.x - P.lens.z - 3.0 * f32(row) * P.lens.y;
  var subpixel = i32(ceil(middle - shifts.y)) - 1;
  let last = i32(ceil(middle - shifts.x)) + 1;
  while (subpixel < last) {
    var phase = phase_at(row, subpixel);
    if (CELLS) { phase = add64(phase, cell_at(row, subpixel).xy); }
    if (phase.y < 0x80000000u) { break; }
    subpixel++;
  }
  return subpixel;
}
