// What frames of a kind have needed so far: boxes and room for lists; and bands that take no GPU long. Twin of
// lightfield_gs/webgpu/plans.py, which says why.

import { ORDINALS, tilings } from "./parameters.js";

export const HEAD_BYTES = 64;
export const CHUNK = 1024;
export const MOST_PAIRS = (1 << 25) - (1 << 20);
const SLACK = 1.25, LEAST_PAIRS = 1 << 12, CHEAPER = 0.9;
const FIRST_BAND = 4e9, BAND_GROWTH = 4, BAND_SECONDS = 0.05;

/** What the stages counted: {pairs, longest, colours, chunks, costs}. */
export function countersOf(data) {
  const [pairs, longest, colours, chunks] = new Uint32Array(data, 0, 4), costs = [0, 0, 0, 0];
  new Float32Array(data, HEAD_BYTES).forEach((cost, k) => { costs[k % costs.length] += cost; });
  return { pairs, longest, colours, chunks, costs };
}

/** Room for the lists of a pass. passes: [first row of boxes, one behind the last]. */
export class Room {
  constructor(passes) { Object.assign(this, { passes, pairs: null, chunks: 0, merges: 0 }); }

  /** Whether the lists were complete, and in order. */
  holds(found) {
    return this.pairs !== null && found.pairs <= this.pairs && found.chunks <= this.chunks &&
      found.longest <= CHUNK * 2 ** this.merges;
  }

  grow(found, most) {
    this.pairs = Math.max(this.pairs ?? 0, Math.min(Math.floor(SLACK * found.pairs) + LEAST_PAIRS, most));
    if (!found.chunks) return;
    this.chunks = Math.max(this.chunks, Math.min(Math.floor(SLACK * found.chunks) + 1, Math.floor((2 * most) / CHUNK)));
    const runs = Math.floor(Math.max(found.longest - 1, 0) / CHUNK), bits = runs ? Math.floor(Math.log2(runs)) + 1 : 0;
    this.merges = Math.max(this.merges, bits + (bits % 2));
  }

  /** Draws a pass in halves from now on, and returns them. */
  split(rows) {
    const middle = (rows[0] + rows[1]) >> 1, halves = [[rows[0], middle], [middle, rows[1]]];
    this.passes.splice(this.passes.indexOf(rows), 1, ...halves);
    return halves;
  }
}

/** What the next frame of a kind takes. */
export class Plan {
  constructor() { Object.assign(this, { ordinals: null, colours: 0, rooms: new Map(), costs: new Map() }); }

  /** Chooses the boxes of the next frame by the costs of this one. */
  choose(lens, costs) {
    this.costs = new Map(ORDINALS.map((ordinals, k) => [ordinals, costs[k]]));
    const best = tilings(lens).reduce((a, b) => (this.costs.get(b) < this.costs.get(a) ? b : a));
    if (this.ordinals === null || this.costs.get(best) < CHEAPER * this.costs.get(this.ordinals)) this.ordinals = best;
  }
}

/** The bands of a composite: how many rows of boxes are drawn at once. rate: instructions a second; null: they are timed. */
export class Bands {
  constructor(rate, rowCost) {
    Object.assign(this, { rate, areTimed: rate === null, rowCost: Math.max(rowCost, 1) });
    this.budget = rate === null ? FIRST_BAND : rate * BAND_SECONDS;
  }

  rows() { return Math.max(Math.floor(this.budget / this.rowCost), 1); }

  took(rows, seconds) {
    const own = (rows * this.rowCost) / Math.max(seconds, 1e-4);
    this.rate = this.rate === null ? own : Math.min(this.rate, own);
    this.budget = Math.min(BAND_GROWTH * this.budget, this.rate * BAND_SECONDS);
  }
}
