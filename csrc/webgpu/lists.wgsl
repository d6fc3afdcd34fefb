// Stages count, allocate and scatter: every box gets a list of the splats that touch it. Where lists lie is in no order;
// sort.wgsl puts each in the order of depths.

@group(0) @binding(10) var<storage, read_write> bins: array<atomic<u32>>;  // counts, then cursors, then starts, of boxes
@group(0) @binding(11) var<storage, read_write> pairs: array<u32>;         // splats, list by list
@group(0) @binding(12) var<storage, read_write> large: array<u32>;         // splats that whole workgroups visit
@group(0) @binding(13) var<storage, read_write> chunks: array<u32>;        // boxes of long lists, once for each chunk

const LARGE_STRIPS = 32u;  // rows of boxes times groups: from here on a workgroup visits the splat
const SHORT = 512u;        // longest list that is sorted in one piece
const CHUNK = 1024u;       // of longer lists

fn put(box: u32, id: u32, counting: bool) {
  if (counting) { atomicAdd(&bins[box], 1u); return; }
  let at = atomicAdd(&bins[box_count() + box], 1u);
  if (at < P.room.x) { pairs[at] = id; }
}

// Visit the boxes of a splat; strips `first`, `first` + `step`, ...
fn visit(s: Splat, id: u32, rows: vec2i, first: u32, step: u32, counting: bool) {
  let widest = widest(s);
  let down = u32(rows.y - rows.x);
  for (var strip = first; strip < down * P.boxes.z; strip += step) {
    let group = strip / down; let row = rows.x + i32(strip % down);
    let columns = box_columns(s, row, group, widest);
    for (var column = columns.x; column < columns.y; column++) {
      put(box_number(column, u32(row), group), id, counting);
    }
  }
}

fn is_large(rows: vec2i) -> bool { return u32(rows.y - rows.x) * P.boxes.z >= LARGE_STRIPS; }

@compute @workgroup_size(256)
fn count(@builtin(global_invocation_id) at: vec3u) {
  if (at.x >= P.size.w) { return; }
  let s = load_splat(at.x); let rows = box_rows(s);
  if (is_large(rows)) {
    let place = atomicAdd(&counters[LARGE], 1u);
    if (place < P.room.z) { large[place] = at.x; }
    return;
  }
  visit(s, at.x, rows, 0u, 1u, true);
}

@compute @workgroup_size(256)
fn scatter(@builtin(global_invocation_id) at: vec3u) {
  if (at.x >= P.size.w) { return; }
  let s = load_splat(at.x); let rows = box_rows(s);
  if (!is_large(rows)) { visit(s, at.x, rows, 0u, 1u, false); }
}

fn visit_large(group: u32, groups: u32, thread: u32, counting: bool) {
  let end = min(atomicLoad(&counters[LARGE]), P.room.z);
  for (var place = group; place < end; place += groups) {
    let s = load_splat(large[place]);
    visit(s, large[place], box_rows(s), thread, 64u, counting);
  }
}

@compute @workgroup_size(64)
fn count_large(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
               @builtin(local_invocation_index) thread: u32) {
  visit_large(group.x, groups.x, thread, true);
}

@compute @workgroup_size(64)
fn scatter_large(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
                 @builtin(local_invocation_index) thread: u32) {
  visit_large(group.x, groups.x, thread, false);
}

var<workgroup> sums: array<u32, 256>;
var<workgroup> base: u32;

// Give every list its place, and long lists their chunks.
@compute @workgroup_size(256)
fn allocate(@builtin(global_invocation_id) at: vec3u, @builtin(local_invocation_index) thread: u32) {
  let boxes = box_count(); let box = at.x;
  var n = 0u;
  if (box < boxes) { n = atomicLoad(&bins[box]); }
  sums[thread] = n;
  workgroupBarrier();
  for (var step = 1u; step < 256u; step *= 2u) {
    var other = 0u;
    if (thread >= step) { other = sums[thread - step]; }
    workgroupBarrier();
    sums[thread] += other;
    workgroupBarrier();
  }
  if (thread == 255u) { base = atomicAdd(&counters[PAIRS], sums[255]); }
  workgroupBarrier();
  if (box >= boxes) { return; }
  let start = base + sums[thread] - n;
  atomicStore(&bins[boxes + box], start);
  atomicStore(&bins[2u * boxes + box], start);
  atomicMax(&counters[LONGEST], n);
  if (n > SHORT) {
    let own = (n + CHUNK - 1u) / CHUNK;
    let first = atomicAdd(&counters[CHUNKS], own);
    for (var k = 0u; k < own; k++) {
      if (first + k < P.room.w) { chunks[2u * (first + k)] = box; chunks[2u * (first + k) + 1u] = k; }
    }
  }
}
