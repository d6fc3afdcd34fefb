// What the page shows: the controls of the server (lightfield_gs/show/page/stage.py), and the way back to earlier ones.

export const KEPT = ["depth_amount", "focus", "cone_deg", "zoom", "pan_x", "pan_y", "yaw_deg", "pitch_deg", "background", "quality"];
const MOST_STEPS = 200;

export class State extends EventTarget {
  /** Begins anew with a scene. */
  open(scene) {
    const first = { ...scene.defaults, focus: scene.rig.zero_depth, cone_deg: scene.rig.cone_deg };
    this.scene = scene;
    this.first = Object.fromEntries(KEPT.map((name) => [name, first[name]]));
    this.values = { ...this.first, eye: 0, frame: 0 };
    this.steps = [{ ...this.first }];
    this.place = 0;
  }

  /** What the server takes; scene: so that it refuses questions about an earlier one. */
  get controls() { return { ...this.values, scene: this.scene.number }; }

  set(values) {
    for (const [name, value] of Object.entries(values)) {
      const [low, high] = this.scene.ranges[name] ?? [];
      this.values[name] = low === undefined ? value : Math.min(high, Math.max(low, value));
    }
    this.changed();
  }

  changed() { this.dispatchEvent(new Event("change")); }

  get kept() { return Object.fromEntries(KEPT.map((name) => [name, this.values[name]])); }

  get isAsAtFirst() { return KEPT.every((name) => this.values[name] === this.first[name]); }

  /** Ends a step: undo goes back to it. */
  commit() {
    const last = this.steps[this.place];
    if (KEPT.every((name) => last[name] === this.values[name])) return;
    this.steps = [...this.steps.slice(0, this.place + 1), this.kept].slice(-MOST_STEPS);
    this.place = this.steps.length - 1;
    this.dispatchEvent(new Event("step"));
  }

  get canUndo() { return this.place > 0 || KEPT.some((name) => this.steps[this.place][name] !== this.values[name]); }

  get canRedo() { return this.place < this.steps.length - 1; }

  undo() { this.commit(); this.go(-1); }

  redo() { this.commit(); this.go(1); }

  go(by) {
    const step = this.steps[this.place + by];
    if (!step) return;
    this.place += by;
    this.set(step);
    this.dispatchEvent(new Event("step"));
  }

  reset() { this.set(this.first); this.commit(); }
}
