// Stage pack: pixels of four bytes become pixels of three, so that the host reads what it needs.

@group(0) @binding(15) var<storage, read_write> image: array<u32>;
@group(0) @binding(16) var<storage, read_write> packed: array<u32>;

@compute @workgroup_size(256)
fn pack(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
        @builtin(local_invocation_index) thread: u32) {
  let four = (group.y * groups.x + group.x) * 256u + thread;  // pixels
  if (4u * four + 3u >= arrayLength(&image)) { return; }
  let a = image[4u * four]; let b = image[4u * four + 1u]; let c = image[4u * four + 2u]; let d = image[4u * four + 3u];
  packed[3u * four] = a | (b << 24u);
  packed[3u * four + 1u] = (b >> 8u) | (c << 16u);
  packed[3u * four + 2u] = (c >> 16u) | (d << 8u);
}
