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
var<workgroup> staged: array<Splat, BATCH>;
var<workgroup> lights: array<vec4f, BATCH>;  // colours of scenes without harmonics
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
    left = (lens * P.lens.x - P.lens.z) / 3.0 - 0.2; right = ((lens + 4.0) * P.lens.x - P.lens.z) / 3.0 + 0.53;
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

fn pick(c: vec4f, channel: u32) -> f32 { return select(select(c.z, c.y, channel == 1u), c.x, channel == 0u); }

// The colour on its circle, one channel.
fn light_on_circle(place: u32, channel: u32, s: f32) -> f32 {
  let one = colours[place + 1u]; let two = colours[place + 2u];
  let u = s - one.w;
  let inverse = inverseSqrt(u * u + two.w * two.w);
  let t = u * inverse; let h = two.w * inverse;
  let even = pick(colours[place], channel) + t * (pick(one, channel) + t * (pick(two, channel) +
    t * pick(colours[place + 3u], channel)));
  return even + h * (pick(colours[place + 4u], channel) + t * (pick(colours[place + 5u], channel) +
    t * pick(colours[place + 6u], channel)));
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
    m_end = first_of_lens(row, lens + 1.0);
  } else {
    row = i32(box.y) * TILE_HEIGHT + i32((patch_index >> 1u) * 4u + (lane >> 3u));
    m0 = 3 * (i32(box.x) * TILE_WIDTH + i32(((patch_index & 1u) * 8u + (lane & 7u)) * 2u));
    m_end = m0 + 6;
  }
  m_end = select(min(m_end, 3 * i32(P.size.x)), m0, row >= i32(P.size.y));
  let py = f32(row) + 0.5;
  let offsets = offsets_of(box.z);
  //{q
  let there[q] = m0 + q >= 0 && m0 + q < m_end;
  let m[q] = select(0, m0 + q, there[q]);
  let column[q] = m[q] / 3;
  let place[q] = select(u32(q) % 3u, u32(m[q] - 3 * column[q]), BY_LENS);
  let channel[q] = channel_at(row, m[q], place[q]);
  let px[q] = f32(column[q]) + 0.5;
  let s[q] = offset_at(row, m[q]);
  var T[q] = select(0.0, 1.0, there[q]);
  var rest[q] = T[q];
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
      let splat = load_splat(pairs[own.x + begin + mine]);
      if (thread < BATCH) {
        staged[mine] = splat;
        let place = bitcast<u32>(splat.c.w);
        if (COMPENSATED) { unfiltered[mine] = colours[place]; }
        if (!HARMONICS) { lights[mine] = colours[place + select(0u, 1u, COMPENSATED)]; }
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
        let top = a.w - b.w * dy * dy;
        if (top < LOG2_MIN_ALPHA) { continue; }
        let middle = a.x + c.x * dy; let sweep = a.y + c.y * dy;
        var highest = -100.0;
        //{q
        let d[q] = px[q] - (middle + s[q] * sweep);
        let S[q] = b.x + s[q] * (b.y + s[q] * b.z);
        var p[q] = top - d[q] * d[q] / S[q];
        if (COMPENSATED) {
          let D[q] = unfiltered[h].x + s[q] * (unfiltered[h].y + s[q] * unfiltered[h].z);
          p[q] += 0.5 * log2(max(D[q], 1e-30) / S[q]);
        }
        highest = max(highest, p[q]);
        //q}
        if (highest < LOG2_MIN_ALPHA) { continue; }
        var light = lights[h];
        //{q
        var light[q] = pick(light, channel[q]);
        //q}
        if (HARMONICS) {
          let first = bitcast<u32>(c.w) + select(0u, 1u, COMPENSATED);
          light = colours[first];
          if (light.w == CIRCLE_ORDER) {
            //{q
            light[q] = max(light_on_circle(first, channel[q], s[q]), 0.0);
            //q}
          } else {
            //{q
            light[q] = 0.0;
            //q}
            for (var k = u32(light.w); k > 0u; k--) {
              let power = colours[first + k];
              //{q
              light[q] = s[q] * (light[q] + pick(power, channel[q]));
              //q}
            }
            //{q
            light[q] = max(light[q] + pick(light, channel[q]), 0.0);
            //q}
          }
        }
        //{q
        let alpha[q] = select(0.0, min(exp2(p[q]), MAX_ALPHA), p[q] >= LOG2_MIN_ALPHA);
        let w[q] = alpha[q] * T[q];
        let after[q] = T[q] - w[q];
        let ends[q] = after[q] < MIN_TRANSMITTANCE;
        C[q] += select(w[q], 0.0, ends[q]) * light[q];
        rest[q] = select(rest[q], T[q], ends[q] && T[q] > 0.0);
        T[q] = select(after[q], 0.0, ends[q]);
        //q}
      }
    }
    workgroupBarrier();
  }

  // What is left of the light is the background's
  let first_pixel = (u32(row) - part.first_row) * P.size.x;
  //{q
  C[q] += select(rest[q], T[q], T[q] > 0.0) * pick(P.background, channel[q]);
  //q}
  //{floats
  //{q
  if (there[q]) { image[3u * (first_pixel + u32(column[q])) + channel[q]] = C[q]; }
  //q}
  //floats}
  //{bytes
  //{q
  let byte[q] = to_byte(C[q]) << (8u * channel[q]);
  //q}
  if (BY_LENS) {
    //{q
    if (there[q]) { atomicOr(&image[first_pixel + u32(column[q])], byte[q]); }
    //q}
  }
  //{pixels
  if (there_0) { atomicStore(&image[first_pixel + u32(column_0)], byte_0 | byte_1 | byte_2); }
  if (there_3) { atomicStore(&image[first_pixel + u32(column_3)], byte_3 | byte_4 | byte_5); }
  //pixels}
  //bytes}
}
