// Gaussians out of the page: twin of unpack in lightfield_gs/show/scene_page/packing.py, which has the layout.

const C0 = 0.28209479177387814, ROTATION_STEPS = 255, ROTATION_ZERO = 256, GAUSSIAN_FLOATS = 12;

/** The bytes of base64 of gzip: a promise. */
export async function inflated(base64) {
  const packed = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The scene as the stages take it: {count, degree, gaussians [12 count] as the struct Gaussian of
 *  csrc/webgpu/project.wgsl, harmonics [count, (degree + 1)^2, 3]}. */
export function unpacked(header, data) {
  const { count, degree } = header, coefficients = (degree + 1) ** 2, planes = [];
  for (let at = 0; at < data.length; at += count) planes.push(data.subarray(at, at + count));
  const scene = {
    count, degree, gaussians: new Float32Array(GAUSSIAN_FLOATS * count), harmonics: new Float32Array(3 * coefficients * count),
  };
  const take = (number) => planes.splice(0, number);
  unpackMeans(header, take(3 * header.bytes_each), scene.gaussians);
  const scales = take(3), rotations = take(4), [opacities] = take(1), colours = take(3);
  for (let n = 0, at = 0; n < count; n++, at += GAUSSIAN_FLOATS) {
    scene.gaussians[at + 3] = opacities[n] / 255;
    unpackRotation(rotations, n, scene.gaussians, at + 4);
    for (let axis = 0; axis < 3; axis++)
      scene.gaussians[at + 8 + axis] = Math.exp(header.least_scale + header.scale_step * scales[axis][n]);
    unpackHarmonics(header, colours, planes, n, scene.harmonics, 3 * coefficients * n);
  }
  return scene;
}

function unpackMeans({ count, low, step, bytes_each: bytes }, planes, out) {
  for (let axis = 0; axis < 3; axis++)
    for (let n = 0, place = 0; n < count; n++) {
      let folded = 0;
      for (let k = 0; k < bytes; k++) folded += planes[3 * k + axis][n] * 2 ** (8 * k);
      place += folded % 2 ? -(folded + 1) / 2 : folded / 2;
      out[GAUSSIAN_FLOATS * n + axis] = low[axis] + place * step;
    }
}

function unpackRotation([first, ...low], n, out, at) {
  const largest = first[n] & 3;
  let sum = 0;
  for (let k = 0, part = 0; part < 4; part++) {
    if (part === largest) continue;
    const steps = low[k][n] + (((first[n] >> (2 + k)) & 1) << 8) - ROTATION_ZERO, value = steps / (ROTATION_STEPS * Math.SQRT2);
    out[at + part] = value;
    sum += value * value;
    k += 1;
  }
  out[at + largest] = Math.sqrt(Math.max(0, 1 - sum));
}

function unpackHarmonics({ colours: [first, last], harmonics: most }, [green, red, blue], rest, n, out, at) {
  const g = green[n], each = (last - first) / 255;
  [(red[n] + g) & 255, g, (blue[n] + g) & 255].forEach((byte, channel) => {
    out[at + channel] = (first + byte * each - 0.5) / C0;
  });
  rest.forEach((plane, k) => { out[at + 3 + k] = (plane[n] - 128) * (most / 127); });
}
