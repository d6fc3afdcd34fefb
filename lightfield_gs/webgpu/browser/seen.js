// What an eye sees through the lenses, from the rows of a native picture as they come.

import { Work } from "./pipelines.js";

const THREADS = 64, KIND = { ordinals: 0, cells: false, bgr: false, harmonics: false, compensated: false };

export class Seen {
  /** frames: those that draw the picture. eye: see eyeBefore of panels/browser/simulate.js. width: of the panel. */
  constructor(frames, eye, width) {
    Object.assign(this, { frames, eye, size: eye.samples });
    const { buffers } = frames, [across, down] = eye.samples, numbers = new Uint32Array([across, down, width, 0]);
    new Float32Array(numbers.buffer)[3] = eye.sharpness;
    buffers.write("eye", numbers, true);
    for (const name of ["borders", "turns"]) {
      buffers.storage(name, eye[name].byteLength);
      buffers.write(name, eye[name]);
    }
    buffers.storage("lit", 32 * across * down);
    buffers.exactly("seen", 4 * across * down);
    this.isEmpty = true;
  }

  /** Adds rows of the picture, which lie at the beginning of the buffer "image". */
  async take(first, rows) {
    const work = this.work();
    if (this.isEmpty) work.clear("lit");
    this.isEmpty = false;
    await this.run(work, "see", this.frames.part(`seen ${first}`, 0, rows, first));
  }

  /** Makes the picture, in the buffer "seen". */
  async end() { await this.run(this.work(), "join_seen", {}); }

  async run(work, stage, names) {
    await work.run(stage, [Math.ceil(this.size[0] / THREADS), this.size[1]], names);
    work.submit();
  }

  work() { return new Work(this.frames.pipelines, this.frames.buffers, KIND); }
}
