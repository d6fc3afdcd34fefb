// The test picture of a panel, by which an eye sees at once whether pixels and lenses fit. Its middle is red for cameras
// left of the centre and blue to the right: each eye before the panel sees one even colour. Above and below are lines of
// one pixel, across and down: a picture that is scaled by anything but one has broad bands there.

@group(0) @binding(15) var<storage, read_write> image: array<u32>;  // a pixel: red in the lowest byte

@compute @workgroup_size(256)
fn pattern(@builtin(global_invocation_id) at: vec3u) {
  if (at.x >= P.size.x) { return; }
  let row = part.first_row + at.y;
  let is_line = row * 6u < P.size.y || row * 6u >= 5u * P.size.y;
  var pixel = select(0u, 0xffffffu, ((select(row, at.x, at.x * 2u < P.size.x)) & 1u) == 1u);
  if (!is_line) {
    pixel = 0u;
    for (var place = 0u; place < 3u; place++) {
      let subpixel = i32(3u * at.x + place);
      let channel = channel_at(i32(row), subpixel, place);
      let lit = select(0u, 2u, offset_at(i32(row), subpixel, phase_at(i32(row), subpixel)) > 0.0);
      pixel |= select(0u, 0xffu, channel == lit) << (8u * channel);
    }
  }
  image[at.y * P.size.x + at.x] = pixel;
}
