// What an eye sees through the lenses of a panel: twin of lightfield_gs/panels/simulate.py; docs/design.md, "What an eye
// sees". A sample is about a lens wide and high: the mean of its pixels, weighted by their light in the eye's direction.

struct Eye {
  samples: vec2u,    // across, down
  width: u32,        // of the panel, pixels
  sharpness: f32,    // of the light of a lens: its Gaussian is exp(-(sharpness turn)^2)
};

@group(0) @binding(15) var<storage, read_write> image: array<u32>;  // a pixel: red in the lowest byte
@group(0) @binding(17) var<uniform> eye: Eye;
@group(0) @binding(18) var<storage, read> borders: array<u32>;  // of the samples, in pixels: across, then down
// Where the eye meets the lens of a sub-pixel, in lens widths: of each column by row mod 4 and channel, then of each row
@group(0) @binding(19) var<storage, read> turns: array<f32>;
@group(0) @binding(20) var<storage, read_write> lit: array<vec4f>;   // of each sample: light, then its weight
@group(0) @binding(21) var<storage, read_write> seen: array<u32>;    // as the image

const LEAST_LIGHT = 1e-20;  // a sample keeps a colour even if all its sub-pixels are dark

// Add the rows that the image buffer holds, part.count from part.first_row on, to the samples.
@compute @workgroup_size(64)
fn see(@builtin(global_invocation_id) at: vec3u) {
  if (at.x >= eye.samples.x) { return; }
  let down = eye.samples.x + 1u + at.y;
  let top = max(borders[down], part.first_row); let bottom = min(borders[down + 1u], part.first_row + part.count);
  var light = vec3f(0.0); var weight = vec3f(0.0);
  for (var y = top; y < bottom; y++) {
    let along = (y & 3u) * 3u * eye.width; let of_row = turns[12u * eye.width + y];
    for (var x = borders[at.x]; x < borders[at.x + 1u]; x++) {
      let turn = vec3f(turns[along + x], turns[along + eye.width + x], turns[along + 2u * eye.width + x]) + of_row;
      let aside = eye.sharpness * (fract(turn) - 0.5);
      let own = exp(-aside * aside) + LEAST_LIGHT;
      weight += own;
      light += own * unpack4x8unorm(image[(y - part.first_row) * eye.width + x]).rgb;
    }
  }
  let place = 2u * (at.y * eye.samples.x + at.x);
  lit[place] += vec4f(light, 0.0);
  lit[place + 1u] += vec4f(weight, 0.0);
}

// Join each sample with its neighbours by the weights 1 2 1 both ways.
@compute @workgroup_size(64)
fn join_seen(@builtin(global_invocation_id) at: vec3u) {
  if (at.x >= eye.samples.x) { return; }
  var light = vec3f(0.0); var weight = vec3f(0.0);
  for (var k = 0u; k < 9u; k++) {
    let other = at.xy + vec2u(k % 3u, k / 3u);  // one beyond, so that it is not negative
    if (any(other < vec2u(1u)) || any(other > eye.samples)) { continue; }
    let share = select(1.0, 2.0, k % 3u == 1u) * select(1.0, 2.0, k / 3u == 1u);
    let place = 2u * ((other.y - 1u) * eye.samples.x + other.x - 1u);
    light += share * lit[place].rgb;
    weight += share * lit[place + 1u].rgb;
  }
  let bytes = vec3u(clamp(light / weight, vec3f(0.0), vec3f(1.0)) * 255.0 + 0.5);
  seen[at.y * eye.samples.x + at.x] = bytes.x | (bytes.y << 8u) | (bytes.z << 16u);
}
