// Stage composite: every thread draws a few samples, front to back. Twin of csrc/math/over-inl.h; docs/design.md, "What a
// sample becomes". A workgroup draws a box. Batches of its list are culled against eight patches by bit masks.

@group(0) @binding(10) var<storage, read_write> bins: array<u32>;
@group(0) @binding(11) var<storage, read_write> pairs: array<u32>;
//{floats
@group(0) @binding(15) var<storage, read_write> image: array<f32>;          // red, green, blue
//floats}
//{bytes
@group(0) @binding(15) var<storage, read_write> image: array<atomic<u32>>;  // a pixel: red in the lowest byte
//bytes}

const BATCH = 128u;
const WORDS = 4u;  // of a patch's mask
// A splat as a box draws it. x is the offset of a sample, -1..1 over those of the box.
//   a: column at x = 0 from the box's origin, its change with x, row, log2 opacity
//   b: tau; S^(-1/2) as a polynomial in x; -tau where none is near enough, and S then
//   c: c0 at x = 0, c1 times the change of s with x; bits of the colour's place, FAR_FROM_CUBIC added; the root's x^3
struct Staged { a: vec4f, b: vec4f, c: vec4f };
const FAR_FROM_CUBIC = 0x80000000u;  // no cubic in x draws the colour
const ROOT_ERROR = 4e-5;             // of the root, relative: kMostRootError in csrc/cpu/direct/direct_job.h
var<workgroup> staged: array<Staged, BATCH>;
var<workgroup> lights: array<vec4f, select(1u, 3u, HARMONICS) * BATCH>;  // colours, or a cubic in x for each channel
var<workgroup> unfiltered: array<vec4f, select(1u, BATCH, COMPENSATED)>;  // D(s)
var<workgroup> masks: array<atomic<u32>, 32>;
var<workgroup> list: vec2u;
var<workgroup> open: atomic<u32>;  // whether a sample of the box still takes light
var<workgroup> open_now: u32;

// Whether a splat may touch a patch of the box: 16 x 4 pixels, or 4 lenses x 8 rows.
fn touches(s: Splat, box: vec3u, patch_index: u32, offsets: vec2f, widest: f32) -> bool {
  var top: f32; var rows: f32; var left: f32; var right: f32;
  if (BY_LENS) {
    top = f32(box.y * u32(LENS_ROWS) + (patch_index >> 2u) * 8u); rows = 8.0;
    let lens = f32(box.x * u32(LENSES) + (patch_index & 3u) * 4u) + P.lens.w;
    let shifts = cell_shifts();
    left = (lens * P.lens.x - P.lens.z - shifts.y) / 3.0 - 0.2;
    right = ((lens + 4.0) * P.lens.x - P.lens.z - shifts.x) / 3.0 + 0.53;
  } else {
    top = f32(box.y * u32(TILE_HEIGHT) + (patch_index >> 1u) * 4u); rows = 4.0;
    left = f32(box.x * u32(TILE_WIDTH) + (patch_index & 1u) * 16u) + 0.5; right = left + 15.0;
  }
  let d1 = max(top + 0.5 - MARGIN - s.a.z, -s.c.z);
  let d2 = min(top + rows - 0.5 + MARGIN - s.a.z, s.c.z);
  if (!(d1 <= d2)) { return false; }
  let x = footprint_columns(s, d1, d2, widest, shear(), offsets);
  return x.x <= right && x.y >= left;
}

// A column of pixels in the middle of a box's left edge: floats have their digits for distances from there.
fn origin_of(box: vec3u) -> i32 {
  if (!BY_LENS) { return i32(box.x) * TILE_WIDTH; }
  let lens = f32(box.x * u32(LENSES)) + P.lens.w;
  return i32((lens * P.lens.x - P.lens.z) / 3.0 - (f32(box.y) + 0.5) * f32(LENS_ROWS) * P.lens.y);
}

fn pick(c: vec4f, channel: u32) -> f32 { return select(select(c.z, c.y, channel == 1u), c.x, channel == 0u); }

// The colour seen from an offset, before it is clamped at zero.
fn colour_at(place: u32, s: f32) -> vec3f {
  let first = colours[place];
  if (first.w == CIRCLE_ORDER) {
    let one = colours[place + 1u]; let two = colours[place + 2u];
    let u = s - one.w;
    let inverse = inverseSqrt(u * u + two.w * two.w);
    let t = u * inverse; let h = two.w * inverse;
    let even = first.xyz + t * (one.xyz + t * (two.xyz + t * colours[place + 3u].xyz));
    return even + h * (colours[place + 4u].xyz + t * (colours[place + 5u].xyz + t * colours[place + 6u].xyz));
  }
  var c = vec3f(0.0);
  for (var k = u32(first.w); k > 0u; k--) { c = s * (c + colours[place + k].xyz); }
  return c + first.xyz;
}

// The cubic in x through values at Chebyshev's four nodes, from the right.
fn cubic_through(f: vec4f) -> vec4f {
  let t1 = 0.46193977 * (f.x - f.w) + 0.19134172 * (f.y - f.z);
  let t2 = 0.35355339 * (f.x - f.y - f.z + f.w);
  let t3 = 0.19134172 * (f.x - f.w) - 0.46193977 * (f.y - f.z);
  return vec4f(0.25 * (f.x + f.y + f.z + f.w) - t2, t1 - 3.0 * t3, 2.0 * t2, 4.0 * t3);
}

// Store the colour of a splat as a cubic in x for each channel; return whether it is near. In narrow cones colours are
// stored as cubics at most, and are exact then.
fn stage_colour(mine: u32, place: u32, offsets: vec2f) -> bool {
  let stored = colours[place].w;
  if (stored == CIRCLE_ORDER || stored > 3.0) { return stage_fitted_colour(mine, place, offsets); }
  let order = u32(stored); let s = offsets.x; let h = offsets.y;
  let c0 = colours[place].xyz;  // four loads at once, for each takes long
  let c1 = select(vec3f(0.0), colours[place + 1u].xyz, order > 0u);
  let c2 = select(vec3f(0.0), colours[place + 2u].xyz, order > 1u);
  let c3 = select(vec3f(0.0), colours[place + 3u].xyz, order > 2u);
  let cubics = transpose(mat4x3f(c0 + s * (c1 + s * (c2 + s * c3)), h * (c1 + s * (2.0 * c2 + 3.0 * s * c3)),
                                 h * h * (c2 + 3.0 * s * c3), h * h * h * c3));
  for (var k = 0u; k < 3u; k++) { lights[3u * mine + k] = cubics[k]; }
  return true;
}

// stage_colour through Chebyshev's nodes; the middle and both ends show whether the cubic is near. All these colours at
// once, for each of their powers is read once then.
fn stage_fitted_colour(mine: u32, place: u32, offsets: vec2f) -> bool {
  let far = 0.92387953 * offsets.y; let near = 0.38268343 * offsets.y;
  let at = vec4f(offsets.x + far, offsets.x + near, offsets.x - near, offsets.x - far);
  let ends = vec3f(offsets.x, offsets.x + offsets.y, offsets.x - offsets.y);
  let first = colours[place];
  var nodes: mat3x4f; var tests: mat3x3f;  // a column for each channel
  if (first.w == CIRCLE_ORDER) {
    let a = colour_at(place, at.x); let b = colour_at(place, at.y); let c = colour_at(place, at.z);
    nodes = transpose(mat4x3f(a, b, c, colour_at(place, at.w)));
    let middle = colour_at(place, ends.x); let right = colour_at(place, ends.y);
    tests = transpose(mat3x3f(middle, right, colour_at(place, ends.z)));
  } else {
    for (var k = u32(first.w); k > 0u; k--) {
      let c = colours[place + k];
      nodes[0] = at * (nodes[0] + c.x); nodes[1] = at * (nodes[1] + c.y); nodes[2] = at * (nodes[2] + c.z);
      tests[0] = ends * (tests[0] + c.x); tests[1] = ends * (tests[1] + c.y); tests[2] = ends * (tests[2] + c.z);
    }
    nodes[0] += first.x; nodes[1] += first.y; nodes[2] += first.z;
    tests[0] += first.x; tests[1] += first.y; tests[2] += first.z;
  }
  var error = 0.0;
  for (var k = 0u; k < 3u; k++) {
    let c = cubic_through(nodes[k]);
    lights[3u * mine + k] = c;
    let apart = abs(tests[k] - vec3f(c.x, c.x + c.y + c.z + c.w, c.x - c.y + c.z - c.w));
    error = max(error, max(apart.x, max(apart.y, apart.z)));
  }
  return error <= 2.0 * P.filters.z;
}

fn pick_cubic(red: vec4f, green: vec4f, blue: vec4f, channel: u32) -> vec4f {
  return select(select(blue, green, channel == 1u), red, channel == 0u);
}

fn cubic(c: vec4f, x: f32) -> f32 { return c.x + x * (c.y + x * (c.z + x * c.w)); }

// A splat for the offsets of a box, their middle and half their range, and from its origin.
fn staged_splat(s: Splat, offsets: vec2f, origin: f32) -> Staged {
  // S as a parabola in x; its root as a cubic, or in tiles, which are for narrow cones, as a parabola; and their errors
  // where Chebyshev's next polynomials are largest
  let S = vec3f(s.b.x + offsets.x * (s.b.y + offsets.x * s.b.z), offsets.y * (s.b.y + 2.0 * offsets.x * s.b.z),
                offsets.y * offsets.y * s.b.z);
  let nodes = vec4f(0.92387953, 0.38268343, -0.38268343, -0.92387953);
  var root = cubic_through(inverseSqrt(S.x + nodes * (S.y + nodes * S.z)));
  if (!BY_LENS) { root = vec4f(root.x, root.y + 0.75 * root.w, root.z, 0.0); }
  let x = select(vec4f(-1.0, -0.5, 0.5, 1.0), vec4f(-1.0, -0.70710678, 0.70710678, 1.0), BY_LENS);
  let apart = abs((root.x + x * (root.y + x * (root.z + x * root.w))) * sqrt(S.x + x * (S.y + x * S.z)) - 1.0);
  let is_near = max(max(apart.x, apart.y), max(apart.z, apart.w)) <= ROOT_ERROR;
  if (!is_near) { root = vec4f(S, 0.0); }
  var out: Staged;
  out.a = vec4f(s.a.x - origin + offsets.x * s.a.y, offsets.y * s.a.y, s.a.zw);
  out.b = vec4f(select(-s.b.w, s.b.w, is_near), root.xyz);
  out.c = vec4f(s.c.x + offsets.x * s.c.y, offsets.y * s.c.y, s.c.w, root.w);
  return out;
}

fn to_byte(c: f32) -> u32 { return u32(round(clamp(c, 0.0, 1.0) * 255.0)); }

@compute @workgroup_size(256)
fn composite(@builtin(workgroup_id) at: vec3u, @builtin(local_invocation_index) thread: u32) {
  let box = vec3u(at.x, at.y + part.first, at.z);
  if (thread == 0u) {
    let boxes = box_count(); let number = box_number(box.x, box.y, box.z);
    let start = min(bins[2u * boxes + number], P.room.x);
    list = vec2u(start, min(bins[number], P.room.x - start));
  }
  let own = workgroupUniformLoad(&list);
  let n = own.y;

  // The samples of this thread: two pixels, or ORDINALS sub-pixels of a lens in a row
  let lane = thread & 31u; let patch_index = thread >> 5u;
  var row: i32; var m0: i32; var m_end: i32;
  if (BY_LENS) {
    row = i32(box.y) * LENS_ROWS + i32((patch_index >> 2u) * 8u + (lane >> 2u));
    let lens = f32(box.x * u32(LENSES) + (patch_index & 3u) * 4u + (lane & 3u)) + P.lens.w;
    m0 = first_of_lens(row, lens) + i32(box.z) * ORDINALS;
    m_end = m0 + ORDINALS;
    let shifts = cell_shifts();
    if (f32((box.z + 1u) * u32(ORDINALS)) > P.lens.x - (shifts.y - shifts.x) - 1.0) { m_end = min(m_end, first_of_lens(row, lens + 1.0)); }
  } else {
    row = i32(box.y) * TILE_HEIGHT + i32((patch_index >> 1u) * 4u + (lane >> 3u));
    m0 = 3 * (i32(box.x) * TILE_WIDTH + i32(((patch_index & 1u) * 8u + (lane & 7u)) * 2u));
    m_end = m0 + 6;
  }
  m_end = select(min(m_end, 3 * i32(P.size.x)), m0, row >= i32(P.size.y));
  let py = f32(row) + 0.5;
  let offsets = offsets_of(box.z); let origin = origin_of(box); let cut = P.cuts.w;
  let per_offset = select(0.0, 1.0 / offsets.y, offsets.y > 0.0);
  let place0 = select(0u, u32(m0 - 3 * ((m0 + 3000) / 3 - 1000)), BY_LENS);
  let channels = vec3u(stripe_channel(place0), stripe_channel((place0 + 1u) % 3u), stripe_channel((place0 + 2u) % 3u));
  let column0 = (m0 - i32(place0)) / 3;
  var phase = phase_at(row, m0);
  //{q
  let there[q] = m0 + q >= 0 && m0 + q < m_end;
  let column[q] = column0 + (i32(place0) + q) / 3;
  let px[q] = f32(column[q] - origin) + 0.5;
  let channel[q] = select(channels[q % 3], cell_at(row, m0 + q).z, CELLS);
  let x[q] = (offset_at(row, m0 + q, phase) - offsets.x) * per_offset;
  phase = add64(phase, P.phase0.zw);
  var T[q] = select(0.0, 1.0, there[q]);  // negative once it has fallen below the least: the light that is left then
  var C[q] = 0.0;
  //q}

  for (var begin = 0u; begin < n; begin += BATCH) {
    // Stage a batch and find what touches each patch, unless all samples have ended
    if (thread == 0u) { atomicStore(&open, 0u); }
    if (thread < 32u) { atomicStore(&masks[thread], 0u); }
    workgroupBarrier();
    var most = 0.0;
    //{q
    most = max(most, T[q]);
    //q}
    if (most > 0.0) { atomicStore(&open, 1u); }
    let mine = thread & (BATCH - 1u);
    if (begin + mine < n) {
      var splat = load_splat(pairs[own.x + begin + mine]);
      if (thread < BATCH) {
        var place = bitcast<u32>(splat.c.w);
        if (COMPENSATED) { unfiltered[mine] = colours[place]; place += 1u; }
        if (!HARMONICS) { lights[mine] = colours[place]; }
        if (HARMONICS) { place |= select(FAR_FROM_CUBIC, 0u, stage_colour(mine, place, offsets)); }
        splat.c.w = bitcast<f32>(place);
        staged[mine] = staged_splat(splat, offsets, f32(origin));
      }
      let half = (thread >> 7u) * 4u;
      let widest = widest(splat);
      for (var p = half; p < half + 4u; p++) {
        if (touches(splat, box, p, offsets, widest)) {
          atomicOr(&masks[p * WORDS + (mine >> 5u)], 1u << (mine & 31u));
        }
      }
    }
    workgroupBarrier();
    if (thread == 0u) { open_now = atomicLoad(&open); }
    if (workgroupUniformLoad(&open_now) == 0u) { break; }

    for (var word = 0u; word < WORDS; word++) {
      var bits = select(0u, atomicLoad(&masks[patch_index * WORDS + word]), most > 0.0);
      while (bits != 0u) {
        let h = word * 32u + firstTrailingBit(bits);
        bits &= bits - 1u;
        let a = staged[h].a; let b = staged[h].b; let c = staged[h].c;
        let dy = py - a.z;
        let top = a.w - abs(b.x) * dy * dy;
        if (top < cut) { continue; }
        let middle = a.x + c.x * dy; let sweep = a.y + c.y * dy;
        //{q
        var root[q] = b.y + x[q] * (b.z + x[q] * select(b.w, b.w + x[q] * c.w, BY_LENS));
        //q}
        if (b.x < 0.0) {
          //{q
          root[q] = inverseSqrt(root[q]);
          //q}
        }
        var highest = -100.0;
        //{q
        let d[q] = ((px[q] - middle) - x[q] * sweep) * root[q];
        var p[q] = top - d[q] * d[q];
        if (COMPENSATED) {
          let s[q] = offsets.x + x[q] * offsets.y;
          let D[q] = unfiltered[h].x + s[q] * (unfiltered[h].y + s[q] * unfiltered[h].z);
          p[q] += 0.5 * log2(max(D[q], 1e-30) * root[q] * root[q]);
        }
        highest = max(highest, p[q]);
        //q}
        if (highest < cut) { continue; }
        var constant = vec4f(0.0);
        if (!HARMONICS) { constant = lights[h]; }
        let by_place = vec3f(pick(constant, channels.x), pick(constant, channels.y), pick(constant, channels.z));
        //{q
        var light[q] = select(by_place[q % 3], pick(constant, channel[q]), CELLS);
        //q}
        if (HARMONICS) {
          let place = bitcast<u32>(c.z);
          if (place >= FAR_FROM_CUBIC) {
            //{q
            let all[q] = colour_at(place - FAR_FROM_CUBIC, offsets.x + x[q] * offsets.y);
            light[q] = max(pick(vec4f(all[q], 0.0), channel[q]), 0.0);
            //q}
          } else if (CELLS) {
            //{q
            light[q] = max(cubic(lights[3u * h + channel[q]], x[q]), 0.0);
            //q}
          } else {
            let red = lights[3u * h]; let green = lights[3u * h + 1u]; let blue = lights[3u * h + 2u];
            let cubics = mat3x4f(pick_cubic(red, green, blue, channels.x), pick_cubic(red, green, blue, channels.y),
                                 pick_cubic(red, green, blue, channels.z));
            //{q
            light[q] = max(cubic(cubics[q % 3], x[q]), 0.0);
            //q}
          }
        }
        //{q
        let alpha[q] = select(0.0, min(exp2(p[q]), MAX_ALPHA), p[q] >= cut);
        let w[q] = alpha[q] * T[q];
        let after[q] = T[q] - w[q];
        let ends[q] = after[q] < P.cuts.z;
        C[q] += select(w[q], select(0.0, T[q], ENDS_EARLY), ends[q]) * light[q];
        T[q] = select(after[q], select(-abs(T[q]), 0.0, ENDS_EARLY), ends[q]);
        //q}
      }
    }
    workgroupBarrier();
  }

  // What is left of the light is the background's
  let first_pixel = (u32(row) - part.first_row) * P.size.x;
  //{q
  C[q] += abs(T[q]) * pick(P.background, channel[q]);
  //q}
  //{floats
  //{q
  if (there[q]) { image[3u * (first_pixel + u32(column[q])) + channel[q]] = C[q]; }
  //q}
  //floats}
  //{bytes
  //{q
  let byte[q] = select(0u, to_byte(C[q]) << (8u * channel[q]), there[q]);
  //q}
  if (BY_LENS) {
    // The bytes of a pixel together: sample q is in pixel q / 3 from column0 on, or the next one
    var words = vec3u(0u);
    //{q
    if (place0 + u32(q) % 3u < 3u) { words[q / 3] |= byte[q]; } else { words[q / 3 + 1] |= byte[q]; }
    //q}
    if (words.x != 0u) { atomicOr(&image[first_pixel + u32(column0)], words.x); }
    if (words.y != 0u) { atomicOr(&image[first_pixel + u32(column0 + 1)], words.y); }
    if (words.z != 0u) { atomicOr(&image[first_pixel + u32(column0 + 2)], words.z); }
  }
  //{pixels
  if (there_0) { atomicStore(&image[first_pixel + u32(column_0)], byte_0 | byte_1 | byte_2); }
  if (there_3) { atomicStore(&image[first_pixel + u32(column_3)], byte_3 | byte_4 | byte_5); }
  //pixels}
  //bytes}
}
