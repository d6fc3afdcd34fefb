// Where means are seen, as the CPU finds it in double precision: so ties of depth fall alike, and edges of footprints lie
// alike to less than a digit of a float. WGSL has no doubles, its divisions err, and compilers may reorder sums of floats:
// integers of 96 bits add the products. docs/design.md, "Frames by WebGPU".

// Integers of 96 bits, two's complement: low, middle, high word.
fn add96(a: vec3u, b: vec3u) -> vec3u {
  let low = add64(a.xy, b.xy);
  let carry = low.y < a.y || (low.y == a.y && low.x < a.x);
  return vec3u(low, a.z + b.z + select(0u, 1u, carry));
}

fn negated96(a: vec3u) -> vec3u { return add96(~a, vec3u(1u, 0u, 0u)); }

// a / 2^bits, a not negative.
fn halved96(a: vec3u, bits: u32) -> vec3u {
  var v = select(a, vec3u(a.yz, 0u), bits >= 32u);
  v = select(v, vec3u(a.z, 0u, 0u), bits >= 64u);
  let n = bits & 31u;
  if (bits >= 96u) { return vec3u(0u); }
  if (n == 0u) { return v; }
  return (v >> vec3u(n)) | vec3u(v.yz << vec2u(32u - n), 0u);
}

// a 2^bits, modulo 2^96, bits below 96.
fn doubled96(a: vec3u, bits: u32) -> vec3u {
  var v = select(a, vec3u(0u, a.xy), bits >= 32u);
  v = select(v, vec3u(0u, 0u, a.x), bits >= 64u);
  let n = bits & 31u;
  if (n == 0u) { return v; }
  return (v << vec3u(n)) | vec3u(0u, v.xy >> vec2u(32u - n));
}

// A number: sum 2^exponent.
struct Wide { sum: vec3u, exponent: i32 };

fn is_negative96(a: vec3u) -> bool { return a.z >= 0x80000000u; }
fn size96(a: vec3u) -> vec3u { return select(a, negated96(a), vec3<bool>(is_negative96(a))); }

fn leading_zeros96(a: vec3u) -> u32 {
  if (a.z != 0u) { return countLeadingZeros(a.z); }
  return 32u + select(countLeadingZeros(a.y), 32u + countLeadingZeros(a.x), a.y == 0u);
}

// The float nearest to a number, ties to even; the least ones become zero.
fn nearest_float(a: Wide) -> f32 {
  let negative = is_negative96(a.sum); let size = size96(a.sum);
  if (all(size == vec3u(0u))) { return 0.0; }
  let leading = leading_zeros96(size);
  let v = doubled96(size, leading);
  var mantissa = v.z >> 8u;
  let rest = v.z & 0xffu;
  let above = rest > 0x80u || (rest == 0x80u && (v.y | v.x) != 0u);
  if (above || (rest == 0x80u && (mantissa & 1u) == 1u)) { mantissa += 1u; }
  var power = a.exponent + 95 - i32(leading) + 127;  // biased
  if (mantissa == 0x1000000u) { mantissa = 0x800000u; power += 1; }
  if (power <= 0) { return 0.0; }
  let bits = select((u32(power) << 23u) | (mantissa & 0x7fffffu), 0x7f7fffffu, power >= 255);
  return bitcast<f32>(bits | select(0u, 0x80000000u, negative));
}

// The float nearest to a / b, ties but for the last digits of the numbers. b is above zero, and near is its nearest float.
fn quotient(a: Wide, b: Wide, near: f32) -> f32 {
  let signed = nearest_float(a) / near; let estimate = abs(signed);
  if (!(estimate > 1e-30 && estimate < 1e30)) { return signed; }
  // What is left of a, |a| - estimate b; b with at most 71 bits
  let drop = u32(max(25 - i32(leading_zeros96(b.sum)), 0));
  let c = halved96(b.sum, drop);
  let m = (bitcast<u32>(estimate) & 0x7fffffu) | 0x800000u;
  let product = vec3u(c.x * m, add64(vec2u(mul_high(c.x, m), 0u), vec2u(c.y * m, mul_high(c.y, m) + c.z * m)));
  let exponent = b.exponent + i32(drop) + i32(bitcast<u32>(estimate) >> 23u) - 150;
  let shift = exponent - a.exponent;
  let aligned = select(doubled96(size96(a.sum), u32(-shift)), halved96(size96(a.sum), u32(shift)), vec3<bool>(shift >= 0));
  let rest = nearest_float(Wide(add96(aligned, negated96(product)), exponent));
  return select(1.0, -1.0, signed < 0.0) * (estimate + rest / near);
}

// A number of the pose, bits of a double: mantissa low and high, biased exponent, 1 for negative ones.
fn pose_number(k: u32) -> vec4u {
  let pair = P.pose[k / 2u];
  let bits = select(pair.xy, pair.zw, (k & 1u) == 1u);
  return vec4u(bits.x, (bits.y & 0xfffffu) | 0x100000u, (bits.y >> 20u) & 0x7ffu, bits.y >> 31u);
}

// A row of the pose times (mean, 1).
fn posed(row: u32, mean: vec3f) -> Wide {
  let factors = bitcast<vec4u>(vec4f(mean, 1.0));
  var exponents: array<i32, 4>;  // biased by 127 + 1023; 0: the product is zero
  var top = 0;
  for (var k = 0u; k < 4u; k++) {
    let a = (factors[k] >> 23u) & 0xffu; let b = pose_number(4u * row + k).z;
    exponents[k] = select(i32(a + b), 0, a == 0u || b == 0u);
    top = max(top, exponents[k]);
  }
  var sum = vec3u(0u);
  for (var k = 0u; k < 4u; k++) {
    if (exponents[k] == 0) { continue; }
    let a = (factors[k] & 0x7fffffu) | 0x800000u; let b = pose_number(4u * row + k);
    let product = vec3u(a * b.x, add64(vec2u(mul_high(a, b.x), 0u), vec2u(a * b.y, mul_high(a, b.y))));  // of 77 bits
    let term = halved96(doubled96(product, 15u), u32(top - exponents[k]));
    sum = add96(sum, select(term, negated96(term), vec3<bool>((factors[k] >> 31u) != b.w)));
  }
  return Wide(sum, top - 127 - 1023 - 23 - 52 - 15);
}
