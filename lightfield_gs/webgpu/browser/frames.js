// Light-field frames: project, lists, order, composite, pass by pass over the panel's rows, in one submission once it is
// known what frames of their kind need. Twin of lightfield_gs/webgpu/frames.py; the image stays on the device.

import { BOX_ROWS, boxesOf, packParams } from "./parameters.js";
import { Buffers, Pipelines, TooLarge, Work } from "./pipelines.js";
import { Bands, CHUNK, countersOf, HEAD_BYTES, MOST_PAIRS, Plan, Room } from "./plans.js";

const THREADS = 256, LARGE_GROUPS = 256, WORKGROUPS_ACROSS = 65535, VECTOR_BYTES = 16, COLOURS_EACH = 4, MOST_PLANS = 16;

// What every frame runs after project: compiled side by side
const AFTER_PROJECT = ["count", "count_large", "allocate", "scatter", "scatter_large", "sort_short", "composite"];

/** Draws frames of one scene, one after the other. */
export class Frames {
  /** host: the sources and tables of shaders.js, and the colour_error of an exact picture.
   *  scene: {count, degree, gaussians, harmonics}, see show/scene_page/files/unpack.js. */
  constructor(device, host, scene) {
    Object.assign(this, { device, host, scene, pipelines: new Pipelines(device, host), buffers: new Buffers(device) });
    Object.assign(this, { rate: null, plans: new Map() }); // instructions a second, once bands were timed
    const { buffers } = this, { count } = scene;
    if (count > WORKGROUPS_ACROSS * THREADS) throw new TooLarge(`${count} Gaussians`);
    for (const name of ["splat_a", "splat_b", "splat_c"]) buffers.storage(name, VECTOR_BYTES * count);
    for (const name of ["depths", "large"]) buffers.storage(name, 4 * count);
    for (const name of ["gaussians", "harmonics"]) {
      buffers.storage(name, scene[name].byteLength);
      buffers.write(name, scene[name]);
    }
    this.groups = Math.ceil(count / THREADS);
    this.headBytes = HEAD_BYTES + VECTOR_BYTES * this.groups;
    buffers.storage("counters", this.headBytes);
    this.mostPairs = Math.min(buffers.mostBytes / 4, MOST_PAIRS);
  }

  /** Draws a job {camera, antialiased, background}. Of each pass `show(first, rows)` takes the rows of the panel, in the
   *  buffer "image" from its beginning on, before the next pass. */
  async draw(job, show) {
    this.begin(job);
    const { plan } = this, { lens } = job.camera;
    let isProjected = false, found = null;
    if (plan.ordinals === null) {
      plan.choose(lens, (await this.project()).costs);
      isProjected = true;
    }
    const boxes = boxesOf(lens, plan.ordinals);
    this.variant.ordinals = boxes.ordinals;
    if (!plan.rooms.has(boxes.ordinals)) {
      await Promise.all(AFTER_PROJECT.map((stage) => this.pipelines.stage(stage, this.variant)));
      plan.rooms.set(boxes.ordinals, new Room(this.passes(boxes)));
    }
    const room = plan.rooms.get(boxes.ordinals), waiting = [...room.passes].reverse();
    while (waiting.length) {
      const rows = waiting.pop();
      found = await this.drawPass(boxes, rows, room, isProjected);
      isProjected = found.colours <= plan.colours;
      if (isProjected && room.holds(found)) await show(rows[0] * BOX_ROWS, this.rowsOf(rows));
      else if (isProjected && found.pairs > this.mostPairs && rows[1] - rows[0] > 1) waiting.push(...room.split(rows).reverse());
      else waiting.push(rows);
      this.enlarge(found, room, rows);
    }
    plan.choose(lens, found.costs);
  }

  /** Draws the test picture of a lens in place of the scene, as `draw` does. */
  async drawPattern(camera, show) {
    this.begin({ camera, antialiased: false, background: [0, 0, 0] });
    const boxes = boxesOf(camera.lens, 0);
    for (const rows of this.passes(boxes)) {
      const top = rows[0] * BOX_ROWS, count = this.rowsOf(rows), work = this.work();
      this.buffers.exactly("image", 4 * count * camera.lens.width_px);
      this.writeParams(boxes, rows, new Room([]));
      await work.run("pattern", [Math.ceil(camera.lens.width_px / THREADS), count], this.part("pattern", 0, 0, top));
      work.submit();
      await show(top, count);
    }
  }

  begin(job) {
    const { lens } = job.camera, compensated = job.antialiased || job.camera.aperture > 0;
    this.job = { ...job, tolerance: this.host.colour_error };
    this.variant = { ordinals: 0, cells: Boolean(lens.cells), bgr: lens.bgr, harmonics: this.scene.degree > 0, compensated };
    const kind = [lens.width_px, lens.height_px, lens.views, lens.line_number, lens.slant_tan, lens.phase, compensated].join();
    if (!this.plans.has(kind)) this.plans.set(kind, new Plan());
    if (this.plans.size > MOST_PLANS) this.plans.delete(this.plans.keys().next().value);
    this.plan = this.plans.get(kind);
    const extra = compensated ? 1 : 0;
    this.makeColours((this.scene.degree ? COLOURS_EACH + extra : 1 + extra) * this.scene.count);
  }

  makeColours(colours) {
    const most = Math.max(colours, this.plan.colours);
    this.plan.colours = Math.floor(this.buffers.storage("colours", VECTOR_BYTES * most) / VECTOR_BYTES);
  }

  /** Makes room for what a pass lacked. */
  enlarge(found, room, rows) {
    if (found.colours > this.plan.colours) this.makeColours(found.colours);
    else if (!room.holds(found)) {
      if (found.pairs > this.mostPairs && rows[1] - rows[0] === 1) throw new TooLarge(`${found.pairs} pairs in a row of boxes`);
      room.grow(found, this.mostPairs);
    }
  }

  writeParams(boxes, rows, room) {
    const sizes = [room.pairs ?? 0, this.plan.colours, this.scene.count, room.chunks];
    this.buffers.write("P", packParams(this.job, this.scene, boxes, rows, sizes), true);
  }

  /** Writes a struct Part of its own for one dispatch of a submission, and names its buffer. */
  part(key, first, count = 0, firstRow = 0) {
    this.buffers.write(`part ${key}`, new Uint32Array([first, count, firstRow, 0]), true);
    return { part: `part ${key}` };
  }

  work() { return new Work(this.pipelines, this.buffers, this.variant); }

  /** The rows of the panel in a pass. */
  rowsOf([first, end]) { return Math.min(end * BOX_ROWS, this.job.camera.lens.height_px) - first * BOX_ROWS; }

  /** Projects alone, and returns the counters. */
  async project() {
    for (;;) {
      this.writeParams(boxesOf(this.job.camera.lens, 0), [0, 1], new Room([]));
      (await this.projecting(false)).submit();
      const found = countersOf(await this.buffers.read("counters", this.headBytes));
      if (found.colours <= this.plan.colours) return found;
      this.makeColours(found.colours);
    }
  }

  /** Work that clears the counters, and projects. */
  async projecting(isProjected) {
    const work = this.work();
    if (isProjected) { // colours and splats stay counted
      work.clearWords("counters", 0, 2);
      work.clearWords("counters", 3, 2);
      return work;
    }
    work.clear("counters");
    await work.run("project", [this.groups], this.part("project", 0, this.scene.count));
    return work;
  }

  /** The rows of boxes of each pass, as many as image and lists allow. */
  passes(boxes) {
    const most = this.buffers.mostBytes, row = boxes.across * boxes.groups;
    const imageRows = Math.floor(most / (this.job.camera.lens.width_px * 4 * BOX_ROWS));
    const listRows = Math.floor(most / (12 * row)), scanRows = Math.floor((WORKGROUPS_ACROSS * THREADS) / row);
    const rows = Math.max(Math.min(imageRows, listRows, scanRows, WORKGROUPS_ACROSS, boxes.down), 1), found = [];
    for (let first = 0; first < boxes.down; first += rows) found.push([first, Math.min(first + rows, boxes.down)]);
    return found;
  }

  /** Draws rows into the image; where nothing is known of the lists, only counts them. Returns the counters. */
  async drawPass(boxes, rows, room, isProjected) {
    const { buffers } = this, own = boxes.across * boxes.groups * (rows[1] - rows[0]);
    buffers.storage("bins", 12 * own);
    buffers.storage("pairs", 4 * (room.pairs ?? 1));
    buffers.storage("chunks", 8 * Math.max(room.chunks, 1));
    if (room.chunks) buffers.storage("merged", buffers.get("pairs").size);
    this.writeParams(boxes, rows, room);
    const work = await this.projecting(isProjected);
    work.clear("bins");
    await work.run("count", [this.groups]);
    await work.run("count_large", [Math.min(LARGE_GROUPS, this.scene.count)]);
    await work.run("allocate", [Math.ceil(own / THREADS)]);
    if (room.pairs === null) work.submit();
    else {
      await this.order(work, boxes, rows, room);
      await this.composite(work, boxes, rows);
    }
    return countersOf(await buffers.read("counters", this.headBytes));
  }

  /** Fills the lists and brings each into the order of depths. */
  async order(work, boxes, rows, room) {
    await work.run("scatter", [this.groups]);
    await work.run("scatter_large", [Math.min(LARGE_GROUPS, this.scene.count)]);
    await work.run("sort_short", [boxes.across, rows[1] - rows[0], boxes.groups]);
    if (!room.chunks) return;
    await work.run("sort_chunk", [room.chunks]);
    for (let k = 0; k < room.merges; k++) { // as many there as back, so that the lists end where they began
      const there = k % 2 ? { pairs: "merged", merged: "pairs" } : {};
      await work.run("merge_runs", [room.chunks], { ...this.part(`merge ${k}`, 0, CHUNK * 2 ** k), ...there });
    }
  }

  /** Draws the samples of a pass, in dispatches that no GPU is busy with for long, and submits the work. */
  async composite(before, boxes, rows) {
    let work = before;
    const [first, end] = rows, top = first * BOX_ROWS, bands = new Bands(this.rate, this.plan.costs.get(boxes.ordinals) / boxes.down);
    this.buffers.exactly("image", 4 * this.rowsOf(rows) * this.job.camera.lens.width_px);
    if (boxes.ordinals) work.clear("image");
    for (let begin = first, atOnce; begin < end; begin += atOnce) {
      atOnce = Math.min(bands.rows(), end - begin);
      if (bands.areTimed) work = await this.flushed(work);
      await work.run("composite", [boxes.across, atOnce, boxes.groups], this.part(`band ${begin}`, begin, 0, top));
      if (!bands.areTimed) continue;
      const started = performance.now();
      work = await this.flushed(work);
      bands.took(atOnce, (performance.now() - started) / 1000);
    }
    this.rate = bands.rate;
    work.submit();
  }

  /** Submits work, waits for its end, and returns new work. */
  async flushed(work) {
    work.submit();
    await this.device.queue.onSubmittedWorkDone();
    return this.work();
  }
}
