// The colour of a Gaussian as seen from everywhere along the rig: csrc/math/harmonics.h, csrc/math/colour_polynomial.h
// and csrc/math/colour_circle.h. docs/design.md, "Colours over the rig".

@group(0) @binding(3) var<storage, read> harmonics: array<f32>;  // [Gaussians of the part, (degree + 1)^2, 3]

const ORDER = 8;            // of the polynomials, at most
const CIRCLE_TERMS = 7u;
// Chebyshev nodes of ORDER, and the angles of the circle: WGSL's own sin and cos may err by 1/2048
const NODES = ORDER + 1;
const NODE = array<f32, NODES>(0.984807753, 0.8660254038, 0.6427876097, 0.3420201433, 0.0,
  -0.3420201433, -0.6427876097, -0.8660254038, -0.984807753);
const COSINE = array<f32, CIRCLE_TERMS>(1.0, 0.6234898019, -0.222520934, -0.9009688679,
  -0.9009688679, -0.222520934, 0.6234898019);
const SINE = array<f32, CIRCLE_TERMS>(0.0, 0.7818314825, 0.9749279122, 0.4338837391,
  -0.4338837391, -0.9749279122, -0.7818314825);

fn coefficient(i: u32, k: u32) -> vec3f {
  let degree = P.phase1.w;
  let at = 3u * (i * (degree + 1u) * (degree + 1u) + k);
  return vec3f(harmonics[at], harmonics[at + 1u], harmonics[at + 2u]);
}

// The colour seen in the unit direction d, before it is clamped at zero.
fn colour_towards(i: u32, d: vec3f) -> vec3f {
  let degree = P.phase1.w;
  let x = d.x; let y = d.y; let z = d.z;
  var c = vec3f(0.5) + 0.28209479177387814 * coefficient(i, 0u);
  if (degree < 1u) { return c; }
  c += 0.4886025119029199 * (-y * coefficient(i, 1u) + z * coefficient(i, 2u) - x * coefficient(i, 3u));
  if (degree < 2u) { return c; }
  c += 1.0925484305920792 * (x * y * coefficient(i, 4u) - y * z * coefficient(i, 5u) - x * z * coefficient(i, 7u));
  c += 0.31539156525252005 * (2.0 * z * z - x * x - y * y) * coefficient(i, 6u);
  c += 0.5462742152960396 * (x * x - y * y) * coefficient(i, 8u);
  if (degree < 3u) { return c; }
  c += -0.5900435899266435 * y * (3.0 * x * x - y * y) * coefficient(i, 9u);
  c += 2.890611442640554 * x * y * z * coefficient(i, 10u);
  c += -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y) * coefficient(i, 11u);
  c += 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y) * coefficient(i, 12u);
  c += -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y) * coefficient(i, 13u);
  c += 1.445305721320277 * z * (x * x - y * y) * coefficient(i, 14u);
  c += -0.5900435899266435 * x * (x * x - 3.0 * y * y) * coefficient(i, 15u);
  return c;
}

// From camera to world axes.
fn to_world(v: vec3f) -> vec3f { return v.x * P.turn0.xyz + v.y * P.turn1.xyz + v.z * P.turn2.xyz; }

// t: the mean in camera axes; s: the camera's offset.
fn colour_from(i: u32, t: vec3f, s: f32) -> vec3f {
  return colour_towards(i, to_world(normalize(t - vec3f(s * P.rig.x, 0.0, 0.0))));
}

// place, distance: the foot of the perpendicular from the mean to the rig, and how far it is, in units of s.
fn circle_of(t: vec3f) -> vec2f { return vec2f(t.x, length(t.yz)) / P.rig.x; }

// Bounds of the amplitudes of the circle's first three harmonics, the largest over the channels.
fn circle_amplitudes(i: u32) -> vec3f {
  let count = (P.phase1.w + 1u) * (P.phase1.w + 1u);
  var first = vec3f(0.0); var second = vec3f(0.0); var third = vec3f(0.0);
  for (var k = 1u; k < count; k++) {
    let c = coefficient(i, k);
    if (k < 4u) { first += c * c; } else if (k < 9u) { second += c * c; } else { third += c * c; }
  }
  third = sqrt(third);
  let a = 0.48860252 * sqrt(first) + 0.45704580 * third;
  let b = 0.54627422 * sqrt(second);
  let c = 0.59004360 * third;
  return vec3f(max(a.x, max(a.y, a.z)), max(b.x, max(b.y, b.z)), max(c.x, max(c.y, c.z)));
}

// A bound of the error of the polynomial of order ORDER; derived at circle_tail in csrc/math/colour_circle.h.
fn circle_tail(amplitudes: vec3f, circle: vec2f) -> f32 {
  let half_axis = 0.5 * (length(vec2f(circle.x - 1.0, circle.y)) + length(vec2f(circle.x + 1.0, circle.y)));
  let root = sqrt(half_axis * half_axis - 1.0);
  if (!(root > 0.0)) { return 1e30; }
  let y = 1.0 / (half_axis + root);
  let x = y * y; let left = 1.0 - x; let n = f32(ORDER + 1);
  var power = 1.0;
  for (var k = 0; k <= ORDER; k++) { power *= y; }
  let tail = power / (1.0 - y);
  let s1 = 1.1283792; let s3 = 3.3851376; let per_root = inverseSqrt(left);
  let first = s1 / sqrt(n) * (1.0 + s1 * x / left);
  let second = 2.0 * (1.0 + x) / left;
  let third = s3 * sqrt(n) * (1.0 + y / (2.0 * n * (1.0 - y))) *
    (1.0 + s3 * x * per_root / left * (1.0 + sqrt(1.0 + x) / (2.0 * n * left)));
  return 4.0 * tail * dot(amplitudes, vec3f(first, second, third));
}

// Take `count` vectors of the pool. The host enlarges a pool that ran out and projects again.
fn take_colours(count: u32) -> u32 {
  let at = atomicAdd(&counters[COLOURS], count);
  return select(0u, at, at + count <= P.room.y);
}

// Store the colour on its circle, where a polynomial would err too much.
fn store_on_circle(i: u32, t: vec3f, circle: vec2f, place: u32) {
  let foot_length = length(t.yz);
  let foot = to_world(select(vec3f(0.0, 0.0, 1.0), vec3f(0.0, t.yz / foot_length), foot_length > 0.0));
  let along = P.turn0.xyz;
  var cosines = COSINE; var sines = SINE;
  var terms: array<vec3f, 7>;
  for (var j = 0u; j < CIRCLE_TERMS; j++) {
    let sine = sines[j]; let cosine = cosines[j];
    let value = colour_towards(i, cosine * foot - sine * along);
    let c2 = 1.0 - 2.0 * sine * sine; let c3 = cosine * (1.0 - 4.0 * sine * sine);
    let s2 = 2.0 * sine * cosine; let s3 = sine * (3.0 - 4.0 * sine * sine); let each = 2.0 / 7.0;
    terms[0] += each * (0.5 + c2) * value;
    terms[1] += each * (sine + 3.0 * s3) * value;
    terms[2] += -2.0 * each * c2 * value;
    terms[3] += -4.0 * each * s3 * value;
    terms[4] += each * (cosine + c3) * value;
    terms[5] += 2.0 * each * s2 * value;
    terms[6] += -4.0 * each * c3 * value;
  }
  for (var m = 0u; m < CIRCLE_TERMS; m++) {
    let fourth = select(select(select(0.0, circle.y, m == 2u), circle.x, m == 1u), CIRCLE_ORDER, m == 0u);
    colours[place + m] = vec4f(terms[m], fourth);
  }
}

// Store the colour of drawn splat i of this part behind `before` vectors, and return where. t: its mean in camera axes.
fn store_colour(i: u32, t: vec3f, before: u32) -> u32 {
  if (!HARMONICS) {
    let place = (part.first + i) * (before + 1u);
    colours[place + before] = vec4f(max(colour_towards(i, vec3f(0.0, 0.0, 1.0)), vec3f(0.0)), 0.0);
    return place;
  }
  let circle = circle_of(t);
  let tolerance = P.filters.z;
  let error = select(0.0, circle_tail(circle_amplitudes(i), circle), P.rig.x > 0.0);
  if (error > tolerance) {
    let place = take_colours(before + CIRCLE_TERMS);
    store_on_circle(i, t, circle, place + before);
    return place;
  }

  // Chebyshev coefficients from values at the nodes, and then powers of s of as many as the tolerance asks for
  var nodes = NODE;
  var chebyshev: array<vec3f, 9>;
  for (var j = 0; j < NODES; j++) {
    let node = nodes[j];
    let value = colour_from(i, t, node) / f32(NODES);
    var one = 1.0; var next = node;  // T_k and T_(k+1) at the node
    for (var k = 0; k < NODES; k++) {
      chebyshev[k] += select(2.0, 1.0, k == 0) * one * value;
      let after = 2.0 * node * next - one;
      one = next; next = after;
    }
  }
  var kept = ORDER;
  var dropped = 0.0;
  for (; kept > 0; kept--) {
    let c = abs(chebyshev[kept]);
    let more = dropped + max(c.x, max(c.y, c.z));
    if (more > tolerance) { break; }
    dropped = more;
  }
  atomicMax(&counters[ERROR], bitcast<u32>(error + dropped));
  let place = take_colours(before + u32(kept) + 1u);
  var powers: array<vec3f, 9>;
  var one: array<f32, 9>; var next: array<f32, 9>;  // powers of T_k and T_(k+1)
  one[0] = 1.0; next[1] = 1.0;
  for (var k = 0; k <= kept; k++) {
    for (var p = 0; p <= k; p++) { powers[p] += one[p] * chebyshev[k]; }
    for (var p = k + 2; p >= 0; p--) {
      if (p > ORDER) { continue; }
      var after = -one[p];
      if (p > 0) { after += 2.0 * next[p - 1]; }
      one[p] = after;  // T_(k+2), in the place of T_k
    }
    let swap = one; one = next; next = swap;
  }
  for (var p = 0; p <= kept; p++) {
    let c = select(powers[p], max(powers[0], vec3f(0.0)), kept == 0);
    colours[place + before + u32(p)] = vec4f(c, select(0.0, f32(kept), p == 0));
  }
  return place;
}
