// What is shown: how far the scene is turned, how near it is, and on what it is seen.

const ZOOMS = [0.25, 8], STEEPEST_DEG = 80, SWAY_MS = 9000, SWAY_DEG = 14;
// From the front; a scene that turns by itself does so about a side that it was turned to
const FRONT = { yaw: 0, pitch: 0, zoom: 1, swayedFrom: 0, phase: 0 };

export class State {
  /** reach: degrees that the scene may be turned to each side, and up and down; null: all round. */
  constructor(reach, changed) {
    Object.assign(this, { reach, changed, mode: "screen", isTest: false, turnsItself: false, ...FRONT });
  }

  reset() { Object.assign(this, FRONT); this.changed(); }

  /** Turns by degrees to the right and up. */
  turn(yaw, pitch) { this.turnTo(this.yaw + yaw, this.pitch + pitch); }

  turnTo(yaw, pitch) {
    const most = this.reach ?? 180, steepest = Math.min(this.reach ?? STEEPEST_DEG, STEEPEST_DEG);
    this.yaw = this.reach === null ? ((yaw + 540) % 360) - 180 : clamp(yaw, -most, most);
    this.pitch = clamp(pitch, -steepest, steepest);
    this.changed();
  }

  magnify(factor) { this.zoom = clamp(this.zoom * factor, ...ZOOMS); this.changed(); }

  setItself(turns) {
    Object.assign(this, { turnsItself: turns, swayedFrom: this.yaw, phase: 0 });
    this.changed();
  }

  /** Goes on turning by itself, for so many milliseconds. */
  sway(elapsed) {
    if (!this.turnsItself) return;
    this.phase += (Math.min(elapsed, 200) / SWAY_MS) * 2 * Math.PI;
    const side = Math.min(this.reach ?? SWAY_DEG, SWAY_DEG), most = this.reach ?? 180;
    this.yaw = clamp(this.swayedFrom, side - most, most - side) + side * Math.sin(this.phase);
  }
}

export const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
