// Stage order: every list by depth, ties by index. Batcher's bitonic network, in the form in which all comparisons
// ascend, sorts lists of any length up to a chunk in shared memory. Chunks of longer lists are merged, pass by pass, from
// one buffer into the other.

@group(0) @binding(9) var<storage, read_write> depths: array<u32>;
@group(0) @binding(10) var<storage, read_write> bins: array<u32>;
@group(0) @binding(11) var<storage, read_write> pairs: array<u32>;
@group(0) @binding(13) var<storage, read_write> chunks: array<u32>;
@group(0) @binding(14) var<storage, read_write> merged: array<u32>;  // where a merging pass writes

const SHORT = 512u;
const CHUNK = 1024u;
const THREADS = 256u;

var<workgroup> list: vec2u;  // start, count

fn list_of(box: u32) -> vec2u {
  let boxes = box_count();
  let start = min(bins[2u * boxes + box], P.room.x);
  return vec2u(start, min(bins[box], P.room.x - start));
}

fn key_of(id: u32) -> vec2u { return vec2u(depths[id], id); }
fn is_later(a: vec2u, b: vec2u) -> bool { return a.x > b.x || (a.x == b.x && a.y > b.y); }

// The two elements of comparison i; size and step are powers of two.
fn compared(i: u32, size: u32, step: u32) -> vec2u {
  let low = i + (i & ~(step - 1u));
  return vec2u(low, select(low | step, low ^ (size - 1u), 2u * step == size));
}

var<workgroup> keys: array<vec2u, CHUNK>;

// Sort the `n` keys of the workgroup.
fn sort_keys(n: u32, thread: u32, threads: u32) {
  for (var size = 2u; size < 2u * n; size *= 2u) {
    for (var step = size / 2u; step > 0u; step /= 2u) {
      for (var k = thread; k < (n + size) / 2u; k += threads) {
        let p = compared(k, size, step);
        if (p.y < n) {
          let a = keys[p.x]; let b = keys[p.y];
          if (is_later(a, b)) { keys[p.x] = b; keys[p.y] = a; }
        }
      }
      workgroupBarrier();
    }
  }
}

@compute @workgroup_size(64)
fn sort_short(@builtin(workgroup_id) at: vec3u, @builtin(local_invocation_index) thread: u32) {
  if (thread == 0u) { list = list_of(box_number(at.x, at.y + P.boxes.w, at.z)); }
  let own = workgroupUniformLoad(&list);
  let n = own.y;
  if (n < 2u || n > SHORT) { return; }
  for (var k = thread; k < n; k += 64u) { keys[k] = key_of(pairs[own.x + k]); }
  workgroupBarrier();
  sort_keys(n, thread, 64u);
  for (var k = thread; k < n; k += 64u) { pairs[own.x + k] = keys[k].y; }
}

@compute @workgroup_size(THREADS)
fn sort_chunk(@builtin(workgroup_id) at: vec3u, @builtin(local_invocation_index) thread: u32) {
  if (thread == 0u) {
    list = vec2u(0u);
    if (at.x < min(atomicLoad(&counters[CHUNKS]), P.room.w)) {
      let whole = list_of(chunks[2u * at.x]); let first = chunks[2u * at.x + 1u] * CHUNK;
      if (first < whole.y) { list = vec2u(whole.x + first, min(whole.y - first, CHUNK)); }
    }
  }
  let own = workgroupUniformLoad(&list);
  let n = own.y;
  for (var k = thread; k < n; k += THREADS) { keys[k] = key_of(pairs[own.x + k]); }
  workgroupBarrier();
  sort_keys(n, thread, THREADS);
  for (var k = thread; k < n; k += THREADS) { pairs[own.x + k] = keys[k].y; }
}

// Merge runs of part.count elements side by side: an element's place is its own index and its rank in the other run.
@compute @workgroup_size(THREADS)
fn merge_runs(@builtin(workgroup_id) at: vec3u, @builtin(local_invocation_index) thread: u32) {
  if (at.x >= min(atomicLoad(&counters[CHUNKS]), P.room.w)) { return; }
  let whole = list_of(chunks[2u * at.x]); let first = chunks[2u * at.x + 1u] * CHUNK;
  let run = part.count;
  for (var i = first + thread; i < min(first + CHUNK, whole.y); i += THREADS) {
    let id = pairs[whole.x + i]; let key = key_of(id);
    let own = i / run;
    let other = (own ^ 1u) * run;
    var low = min(other, whole.y); var high = min(other + run, whole.y);
    while (low < high) {
      let middle = (low + high) / 2u;
      if (is_later(key, key_of(pairs[whole.x + middle]))) { low = middle + 1u; } else { high = middle; }
    }
    let rank = low - min(other, whole.y);
    merged[whole.x + (own & ~1u) * run + (i - own * run) + rank] = id;
  }
}
