// Means in camera axes as the CPU finds them, in double precision, so that ties of depth fall alike. WGSL has no doubles,
// and compilers may reorder sums of floats: integers of 96 bits add the products. docs/design.md, "Frames by WebGPU".

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

// The float nearest to sum 2^exponent, ties to even; the least ones become zero.
fn rounded96(sum: vec3u, exponent: i32) -> f32 {
  let negative = sum.z >= 0x80000000u;
  let size = select(sum, negated96(sum), vec3<bool>(negative));
  if (all(size == vec3u(0u))) { return 0.0; }
  var leading = countLeadingZeros(size.z);
  if (size.z == 0u) { leading = 32u + select(countLeadingZeros(size.y), 32u + countLeadingZeros(size.x), size.y == 0u); }
  let v = doubled96(size, leading);
  var mantissa = v.z >> 8u;
  let rest = v.z & 0xffu;
  let above = rest > 0x80u || (rest == 0x80u && (v.y | v.x) != 0u);
  if (above || (rest == 0x80u && (mantissa & 1u) == 1u)) { mantissa += 1u; }
  var power = exponent + 95 - i32(leading) + 127;  // biased
  if (mantissa == 0x1000000u) { mantissa = 0x800000u; power += 1; }
  if (power <= 0) { return 0.0; }
  let bits = select((u32(power) << 23u) | (mantissa & 0x7fffffu), 0x7f7fffffu, power >= 255);
  return bitcast<f32>(bits | select(0u, 0x80000000u, negative));
}

// A number of the pose, bits of a double: mantissa low and high, biased exponent, 1 for negative ones.
fn pose_number(k: u32) -> vec4u {
  let pair = P.pose[k / 2u];
  let bits = select(pair.xy, pair.zw, (k & 1u) == 1u);
  return vec4u(bits.x, (bits.y & 0xfffffu) | 0x100000u, (bits.y >> 20u) & 0x7ffu, bits.y >> 31u);
}

// A row of the pose [R|t] times (mean, 1).
fn posed(row: u32, mean: vec3f) -> f32 {
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
  return rounded96(sum, top - 127 - 1023 - 23 - 52 - 15);
}
