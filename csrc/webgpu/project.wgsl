// Stage project: Gaussians become splats for all cameras of the rig at once. Twin of csrc/math/projection.h and
// csrc/math/compensation.h; docs/design.md, "One projection for all views".

struct Gaussian { mean: vec4f, quaternion: vec4f, scale: vec4f };  // mean.w: opacity
@group(0) @binding(2) var<storage, read> gaussians: array<Gaussian>;
@group(0) @binding(9) var<storage, read_write> depths: array<u32>;  // bits of positive floats, which order alike

// Largest D(s) / S(s) over the rig.
fn largest_ratio(S: vec3f, D: vec3f) -> f32 {
  let left = (D.x - D.y + D.z) / (S.x - S.y + S.z);
  let right = (D.x + D.y + D.z) / (S.x + S.y + S.z);
  var most = max(left, right);
  let bend = D.z * S.y - D.y * S.z; let half = D.z * S.x - D.x * S.z; let start = D.y * S.x - D.x * S.y;
  let square = half * half - bend * start;
  if (!(square >= 0.0)) { return most; }
  let q = select(-sqrt(square) - half, sqrt(square) - half, half < 0.0);
  for (var k = 0; k < 2; k++) {
    let root = select(start / q, q / bend, k == 0);
    if (root > -1.0 && root < 1.0) {
      most = max(most, (D.x + root * (D.y + root * D.z)) / (S.x + root * (S.y + root * S.z)));
    }
  }
  return most;
}

// A splat with what its colour is stored behind: D(s) of the compensation. Not drawn: a negative reach.
struct Projected { splat: Splat, t: vec3f, D: vec3f, pruned: bool };

// q: w, x, y, z.
fn rotation_matrix(q: vec4f) -> mat3x3f {
  let w = q.x; let x = q.y; let y = q.z; let z = q.w;
  return mat3x3f(
    vec3f(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
    vec3f(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
    vec3f(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)));
}

fn projected(g: Gaussian) -> Projected {
  var out: Projected;
  out.splat.c.z = -1.0;
  let depth = posed(2u, g.mean.xyz); let z = nearest_float(depth);
  let magnitudes = abs(g.quaternion);
  let largest = max(max(magnitudes.x, magnitudes.y), max(magnitudes.z, magnitudes.w));
  out.t.z = z;
  if (!(z >= NEAR_DEPTH) || !(g.mean.w * 255.0 >= 1.0) || !(largest > 0.0)) { return out; }

  // Covariance in camera axes: the factor is the rotation times the scales
  let local = rotation_matrix(normalize(g.quaternion / largest));
  var factor = transpose(mat3x3f(P.turn0.xyz, P.turn1.xyz, P.turn2.xyz)) * local;
  factor[0] *= g.scale.x; factor[1] *= g.scale.y; factor[2] *= g.scale.z;
  let rows = transpose(factor);
  let vyy = dot(rows[1], rows[1]); let vyz = dot(rows[1], rows[2]); let vzz = dot(rows[2], rows[2]);
  let vxy = dot(rows[0], rows[1]); let vxz = dot(rows[0], rows[2]);

  // Jacobian, its slopes clamped at the rig's centre
  let iz = 1.0 / z;
  let u0 = quotient(posed(0u, g.mean.xyz), depth, z); let v0 = quotient(posed(1u, g.mean.xyz), depth, z);
  let t = vec3f((u0 - P.optics.z) / P.optics.x, (v0 - P.optics.w) / P.optics.y, 1.0) * z;
  out.t = t;
  let offset = P.filters.w;
  let kx = clamp((t.x + offset) * iz, P.limits.x, P.limits.y);
  let ky = clamp(t.y * iz, P.limits.z, P.limits.w);
  let a = P.optics.x * iz; let b = -P.optics.x * (kx - offset * iz) * iz;
  let c = P.optics.y * iz; let e = -P.optics.y * ky * iz;
  let g1 = P.rig.x * P.optics.x * iz * iz;

  // Projected covariance, conditional on the row; S(s) as a sum of squares of minors
  let yz = c * vyz + e * vzz;
  let xy0 = a * (c * vxy + e * vxz) + b * yz;
  let xy1 = g1 * yz;
  let yy = c * c * vyy + 2.0 * c * e * vyz + e * e * vzz + BLUR;
  let iy = 1.0 / yy;
  let down = sqrt(iy) * (c * rows[1] + e * rows[2]);
  let across = a * rows[0] + b * rows[2];
  let m0 = cross(across, down);
  let m1 = g1 * cross(rows[2], down);
  let unfiltered = vec3f(dot(m0, m0), 2.0 * dot(m0, m1), dot(m1, m1)) / HALF_LOG2E;
  let blurred = vec3f(1.0 + dot(across, across) * iy, 2.0 * g1 * dot(across, rows[2]) * iy, g1 * g1 * vzz * iy);
  var S = unfiltered + BLUR * blurred / HALF_LOG2E;
  let tau = HALF_LOG2E * iy;
  var log2_opacity = log2(g.mean.w);
  if (COMPENSATED) {
    out.D = select(S, unfiltered, P.filters.y != 0.0);
    let per_offset = P.optics.x * P.filters.x; let shift = P.rig.y - iz;
    S.x += per_offset * per_offset * (shift * shift + iz * iz * iz * iz * vzz) / HALF_LOG2E;
    let most = largest_ratio(S, out.D);
    if (!(most > 0.0)) { return out; }
    out.D /= most;
    log2_opacity += 0.5 * log2(most);
    if (!(log2_opacity >= LOG2_MIN_ALPHA)) { return out; }
  }
  out.splat.a = vec4f(u0, quotient(posed(3u, g.mean.xyz), depth, z), v0, log2_opacity);
  out.splat.b = vec4f(S, tau);
  out.pruned = alpha_integral(out.splat) < P.cuts.y;
  out.splat.a.w = raised(out.splat);
  if (!(out.splat.a.w >= P.cuts.x)) { return out; }
  out.splat.c = vec4f(xy0 * iy, xy1 * iy, sqrt((out.splat.a.w - P.cuts.x) / tau), 0.0);
  return out;
}

// The sum of a splat's alphas over the pixels for the camera that sees it widest: alpha_integral in csrc/math/footprint.h.
fn alpha_integral(s: Splat) -> f32 { return exp2(s.a.w) * 4.532360 * sqrt(widest(s) / s.b.w); }

// Log2 of a splat's opacity, raised for the ring that the opacity cut leaves out: raise_cut and fraction_left_out there.
const PATCH_MARGIN = 6.0;
fn raised(s: Splat) -> f32 {
  let opacity = s.a.w;
  if (P.cuts.x <= LOG2_MIN_ALPHA) { return opacity; }
  var fraction = 1.0;
  if (P.cuts.w < P.cuts.x) {
    let ring = sqrt(sqrt(s.b.x / s.b.w)) * (sqrt(opacity - LOG2_MIN_ALPHA) - sqrt(max(opacity - P.cuts.x, 0.0)));
    fraction = select(1.0, ring / (ring + PATCH_MARGIN), ring > 0.0);
  }
  return min(log2(exp2(opacity) + fraction * (exp2(P.cuts.x) - MIN_ALPHA)), max(LOG2_MAX_ALPHA, opacity));
}

// Whether a splat touches no pixel from any camera, or its numbers overflowed.
fn is_outside(s: Splat) -> bool {
  let sum = s.a.x + s.a.z + s.c.z + s.b.x;
  if (!(abs(sum) < 1e30)) { return true; }
  let d1 = max(0.5 - MARGIN - s.a.z, -s.c.z);
  let d2 = min(f32(P.size.y) - 0.5 + MARGIN - s.a.z, s.c.z);
  if (!(d1 <= d2)) { return true; }
  let x = footprint_columns(s, d1, d2, widest(s), 0.0, vec2f(0.0, 1.0));
  return !(x.y >= 0.0 && x.x <= f32(P.size.x));
}

// What a splat costs in each tiling, in instructions of a thread: tiles of pixels, and boxes of 2, 3 and 6 ordinals. A
// patch is what 32 threads draw. A sample's weight is counted; the others are fitted to the times of an H100 (sheet:128,
// sheet:512, cloud:262144, SH 0 and 3, narrow and 40 degrees, every tiling). The choice is within 2 % of the best there,
// and the best for guitar.ply, which was not fitted. Colours that no cubic draws, for cameras of a box see the splat from
// angles that differ too much, cost more.
const PATCH_COST = 1500.0;
const SAMPLE_COST = 512.0 + select(0.0, 410.0, HARMONICS);
const PAIR_COST = 10000.0 + select(0.0, 9500.0, HARMONICS);
const FAR_COST = 4700.0;
const CUBIC_ANGLE = 0.2;  // half of the range
fn sample_cost(angle: f32) -> f32 { return SAMPLE_COST + select(0.0, FAR_COST, HARMONICS && angle > CUBIC_ANGLE); }

fn cost_of_splat(s: Splat, depth: f32) -> vec4f {
  let height = min(2.0 * s.c.z, f32(P.size.y));
  let width = min(2.0 * sqrt(s.b.w * s.c.z * s.c.z * widest(s)), f32(P.size.x));
  let sweep = 2.0 * abs(s.a.y);
  let tile_patches = (min(width + sweep, f32(P.size.x)) + 16.0) / 16.0 * (height + 4.0) / 4.0;
  let tile_pairs = (min(width + sweep, f32(P.size.x)) + 32.0) / 32.0 * (height + 16.0) / 16.0;
  let angle = P.rig.x / depth;
  var out = vec4f(tile_patches * (PATCH_COST + 6.0 * sample_cost(angle)) + tile_pairs * PAIR_COST);
  let lens = P.lens.x / 3.0;  // pixels
  for (var k = 1; k < 4; k++) {
    let ordinals = select(select(2.0, 3.0, k == 2), 6.0, k == 3);
    let groups = ceil(P.lens.x / ordinals);
    let across = min(width + sweep * ordinals / P.lens.x, f32(P.size.x));
    let patches = groups * (across + 4.0 * lens) / (4.0 * lens) * (height + 8.0) / 8.0;
    let pairs = groups * (across + 16.0 * lens) / (16.0 * lens) * (height + 16.0) / 16.0;
    out[k] = patches * (PATCH_COST + ordinals * sample_cost(angle * ordinals / P.lens.x)) + pairs * PAIR_COST;
  }
  return out;
}

var<workgroup> costs: array<vec4f, 256>;

@compute @workgroup_size(256)
fn project(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  let i = group.x * 256u + thread;
  var cost = vec4f(0.0);
  if (i < part.count) {
    var found = projected(gaussians[i]);
    let id = part.first + i;
    if (found.splat.c.z >= 0.0 && is_outside(found.splat)) { found.splat.c.z = -1.0; }
    if (found.splat.c.z >= 0.0 && found.pruned) {
      found.splat.c.z = -1.0;
      atomicAdd(&counters[PRUNED], 1u);
    }
    if (found.splat.c.z >= 0.0) {
      cost = cost_of_splat(found.splat, found.t.z);
      atomicAdd(&counters[DRAWN], 1u);
      let place = store_colour(i, found.t, select(0u, 1u, COMPENSATED));
      if (COMPENSATED) { colours[place] = vec4f(found.D, 0.0); }
      found.splat.c.w = bitcast<f32>(place);
    }
    splat_a[id] = found.splat.a; splat_b[id] = found.splat.b; splat_c[id] = found.splat.c;
    depths[id] = bitcast<u32>(found.t.z);
  }
  costs[thread] = cost;
  workgroupBarrier();
  for (var step = 128u; step > 0u; step /= 2u) {
    if (thread < step) { costs[thread] += costs[thread + step]; }
    workgroupBarrier();
  }
  if (thread < 4u) {
    atomicStore(&counters[COSTS + 4u * (part.group + group.x) + thread], bitcast<u32>(costs[0][thread]));
  }
}
