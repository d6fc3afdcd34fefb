// Light-field frames: project, lists, order, composite, pass by pass over the panel's rows. Twin of
// lightfield_gs/webgpu/frames.py, whose comments say why; the image stays on the device.

import { BOX_ROWS, boxesOf, cheapest, packParams } from "./parameters.js";
import { Buffers, Pipelines, TooLarge, Work } from "./pipelines.js";

const THREADS = 256, CHUNK = 1024, LARGE_GROUPS = 256, WORKGROUPS_ACROSS = 65535;
const MOST_PAIRS = (1 << 25) - (1 << 20);
const GAUSSIAN_FLOATS = 12, VECTOR_BYTES = 16, COLOURS_EACH = 4, HEAD_BYTES = 64;
const FIRST_BAND = 4e9, BAND_GROWTH = 4, BAND_SECONDS = 0.05;

/** Draws frames of one scene, one after the other. */
export class Frames {
  /** host: the sources and tables of shaders.js, and the colour_error of an exact picture.
   *  scene: {count, degree, gaussians [12 count], harmonics}, see show/scene_page/files/unpack.js. */
  constructor(device, host, scene) {
    Object.assign(this, { device, host, scene, pipelines: new Pipelines(device, host), buffers: new Buffers(device) });
    this.rate = null; // instructions a second, once bands were timed
    const { buffers } = this, { count } = scene;
    if (count > WORKGROUPS_ACROSS * THREADS) throw new TooLarge(`${count} Gaussians`);
    for (const name of ["splat_a", "splat_b", "splat_c"]) buffers.storage(name, VECTOR_BYTES * count);
    for (const name of ["depths", "large"]) buffers.storage(name, 4 * count);
    buffers.storage("gaussians", 4 * GAUSSIAN_FLOATS * count);
    buffers.storage("harmonics", scene.harmonics.byteLength);
    buffers.write("gaussians", scene.gaussians);
    buffers.write("harmonics", scene.harmonics);
    this.groups = Math.ceil(count / THREADS);
    buffers.storage("counters", HEAD_BYTES + VECTOR_BYTES * this.groups);
    this.room = { pairs: 0, colours: 0, chunks: CHUNK };
  }

  /** Draws a job {camera, antialiased, background}. Of each pass `show(first, rows)` takes the rows of the panel, in the
   *  buffer "image" from its beginning on. */
  async draw(job, show) {
    const { lens } = job.camera;
    this.job = { ...job, tolerance: this.host.colour_error };
    this.variant = {
      ordinals: 0, cells: Boolean(lens.cells), bgr: lens.bgr, harmonics: this.scene.degree > 0,
      compensated: job.antialiased || job.camera.aperture > 0,
    };
    const { ordinals, cost } = cheapest(lens, await this.project());
    const boxes = boxesOf(lens, ordinals);
    this.variant.ordinals = ordinals;
    for (const rows of this.passes(boxes)) await this.drawRows(boxes, rows, cost, show);
  }

  writeParams(boxes, rows) {
    const room = [this.room.pairs, this.room.colours, this.scene.count, this.room.chunks];
    this.buffers.write("P", packParams(this.job, this.scene, boxes, rows, room), true);
  }

  /** Writes a struct Part of its own for one dispatch of this frame, and returns the name of its buffer. */
  writePart(key, first, count = 0, firstRow = 0) {
    this.buffers.write(`part ${key}`, new Uint32Array([first, count, firstRow, 0]), true);
    return { part: `part ${key}` };
  }

  work() { return new Work(this.pipelines, this.buffers, this.variant); }

  /** Projects all Gaussians, and returns the costs of the tilings. */
  async project() {
    const { buffers, scene, room } = this, extra = this.variant.compensated ? 1 : 0;
    let colours = (scene.degree ? COLOURS_EACH + extra : 1 + extra) * scene.count;
    for (;;) {
      room.colours = buffers.storage("colours", VECTOR_BYTES * colours) / VECTOR_BYTES;
      this.writeParams(boxesOf(this.job.camera.lens, 0), [0, 1]);
      const work = this.work();
      work.clear("counters");
      await work.run("project", [this.groups], this.writePart("project", 0, scene.count));
      work.submit();
      const head = await buffers.read("counters", HEAD_BYTES + VECTOR_BYTES * this.groups), used = counted(head).colours;
      if (used <= room.colours) return sums(new Float32Array(head, HEAD_BYTES));
      colours = used;
    }
  }

  /** The rows of boxes of each pass, as many as image and lists allow: [first, end]. */
  passes(boxes) {
    const most = this.buffers.mostBytes, row = boxes.across * boxes.groups;
    const imageRows = Math.floor(most / (this.job.camera.lens.width_px * 4 * BOX_ROWS));
    const listRows = Math.floor(most / (12 * row)), scanRows = Math.floor((WORKGROUPS_ACROSS * THREADS) / row);
    const rows = Math.max(Math.min(imageRows, listRows, scanRows, WORKGROUPS_ACROSS, boxes.down), 1), found = [];
    for (let first = 0; first < boxes.down; first += rows) found.push([first, Math.min(first + rows, boxes.down)]);
    return found;
  }

  async drawRows(boxes, rows, cost, show) {
    const counters = await this.list(boxes, rows), [first, end] = rows;
    if (counters.pairs > Math.min(this.buffers.mostBytes / 4, MOST_PAIRS) && end - first > 1) {
      const middle = (first + end) >> 1;
      await this.drawRows(boxes, [first, middle], cost, show);
      return this.drawRows(boxes, [middle, end], cost, show);
    }
    await this.sort(boxes, rows, counters);
    await this.composite(boxes, rows, cost, show);
  }

  /** Counts the lists of a pass and gives them their places. */
  async list(boxes, rows) {
    const { buffers, room } = this, own = boxes.across * boxes.groups * (rows[1] - rows[0]);
    buffers.storage("bins", 12 * own);
    buffers.storage("pairs", 4);
    for (;;) {
      room.chunks = Math.floor(buffers.storage("chunks", 8 * room.chunks) / 8);
      this.writeParams(boxes, rows);
      const work = this.work();
      work.clear("counters", "bins");
      await work.run("count", [this.groups]);
      await work.run("count_large", [Math.min(LARGE_GROUPS, this.scene.count)]);
      await work.run("allocate", [Math.ceil(own / THREADS)]);
      work.submit();
      const counters = counted(await buffers.read("counters", HEAD_BYTES));
      if (counters.chunks <= room.chunks) return counters;
      room.chunks = counters.chunks;
    }
  }

  /** Fills the lists and brings each into the order of depths. */
  async sort(boxes, rows, counters) {
    this.room.pairs = Math.floor(this.buffers.storage("pairs", 4 * counters.pairs) / 4);
    this.writeParams(boxes, rows);
    const work = this.work();
    await work.run("scatter", [this.groups]);
    await work.run("scatter_large", [Math.min(LARGE_GROUPS, counters.large)]);
    await work.run("sort_short", [boxes.across, rows[1] - rows[0], boxes.groups]);
    if (counters.chunks) {
      await work.run("sort_chunk", [counters.chunks]);
      await this.merge(work, counters);
    }
    work.submit();
  }

  /** Merges the chunks of long lists; as many passes there as back, so that they end where they began. */
  async merge(work, counters) {
    this.buffers.storage("merged", this.buffers.get("pairs").size);
    const passes = Math.max(Math.ceil(Math.log2(counters.longest / CHUNK)), 0);
    for (let k = 0; k < passes + (passes % 2); k++) {
      const there = k % 2 ? { pairs: "merged", merged: "pairs" } : {};
      await work.run("merge_runs", [counters.chunks], { ...this.writePart(`merge ${k}`, 0, CHUNK << k), ...there });
    }
  }

  /** Draws the samples of a pass, in dispatches that no GPU is busy with for long. */
  async composite(boxes, [first, end], cost, show) {
    const { lens } = this.job.camera, top = first * BOX_ROWS, bottom = Math.min(end * BOX_ROWS, lens.height_px);
    const rowCost = Math.max(cost / boxes.down, 1), isTimed = this.rate === null;
    let budget = isTimed ? FIRST_BAND : this.rate * BAND_SECONDS;
    this.buffers.exactly("image", 4 * (bottom - top) * lens.width_px);
    for (let begin = first; begin < end; ) {
      const rows = Math.min(Math.max(Math.floor(budget / rowCost), 1), end - begin), work = this.work();
      if (begin === first && boxes.ordinals) work.clear("image");
      await work.run("composite", [boxes.across, rows, boxes.groups], this.writePart(`band ${begin}`, begin, 0, top));
      const started = performance.now();
      work.submit();
      if (isTimed) {
        await this.device.queue.onSubmittedWorkDone();
        const own = (rows * rowCost) / Math.max((performance.now() - started) / 1000, 1e-4);
        this.rate = this.rate === null ? own : Math.min(this.rate, own);
        budget = Math.min(BAND_GROWTH * budget, this.rate * BAND_SECONDS);
      }
      begin += rows;
    }
    show(top, bottom - top);
  }

  /** Draws the test picture of a lens in place of the scene, as `draw` does. */
  async drawPattern(camera, show) {
    const { lens } = camera;
    this.job = { camera, antialiased: false, background: [0, 0, 0], tolerance: 0 };
    this.variant = { ordinals: 0, cells: Boolean(lens.cells), bgr: lens.bgr, harmonics: false, compensated: false };
    const boxes = boxesOf(lens, 0);
    for (const [first, end] of this.passes(boxes)) {
      const top = first * BOX_ROWS, rows = Math.min(end * BOX_ROWS, lens.height_px) - top;
      this.buffers.exactly("image", 4 * rows * lens.width_px);
      this.writeParams(boxes, [first, end]);
      const work = this.work();
      await work.run("pattern", [Math.ceil(lens.width_px / THREADS), rows], this.writePart("pattern", 0, 0, top));
      work.submit();
      show(top, rows);
    }
  }
}

/** The first counters of csrc/webgpu/frame.wgsl. */
function counted(head) {
  const [pairs, longest, colours, chunks, large] = new Uint32Array(head, 0, 5);
  return { pairs, longest, colours, chunks, large };
}

function sums(costs) {
  const total = [0, 0, 0, 0];
  costs.forEach((cost, k) => { total[k % 4] += cost; });
  return total;
}
