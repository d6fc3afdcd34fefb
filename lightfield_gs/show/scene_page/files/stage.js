// Draws the state by WebGPU: the panel's native picture, or one view as large as the window.

import { fitted, orbited, panelCamera, plainCamera, zoomed } from "../../../panels/browser/rig.js";
import { Frames } from "../../../webgpu/browser/frames.js";
import { Picture } from "../../../webgpu/browser/picture.js";

const SLOW_MS = 60, QUICK_MS = 25, LEAST_SCALE = 0.25, RADIANS = Math.PI / 180;

export class Stage {
  /** page: the page's data; scene: its Gaussians, unpacked. */
  constructor(device, canvas, page, scene) {
    Object.assign(this, { page, canvas, frames: new Frames(device, page.host, scene), picture: new Picture(device, canvas) });
    this.scale = 1; // of the window's pixels that are drawn while the scene moves
  }

  /** Draws the state. size: of the window in pixels of the screen. moves: it may be coarse on slow GPUs. */
  async draw(state, panel, size, moves) {
    const began = performance.now(), isPanel = state.mode === "panel";
    const scale = isPanel || !moves ? 1 : this.scale;
    const [width, height] = isPanel ? [panel.width_px, panel.height_px] : size.map((side) => Math.max(1, Math.round(side * scale)));
    const camera = isPanel ? this.onPanel(state, panel) : this.onScreen(state, width, height);
    this.picture.begin(width, height);
    const take = (first, rows) => this.picture.take(first, rows, this.frames.buffers.get("image"));
    if (isPanel && state.isTest) await this.frames.drawPattern(camera, take);
    else await this.frames.draw({ camera, antialiased: this.page.antialiased, background: this.page.background }, take);
    this.picture.end();
    if (!isPanel && moves) this.adapt(performance.now() - began);
  }

  /** Fewer pixels where the GPU is slow, more where it is quick. */
  adapt(took) {
    const factor = took > SLOW_MS ? 0.8 : took < QUICK_MS ? 1.2 : 1;
    this.scale = Math.min(1, Math.max(LEAST_SCALE, this.scale * factor));
  }

  onPanel({ yaw, pitch, zoom }, panel) {
    const rig = zoomed(fitted(this.page.rig, panel.width_px, panel.height_px), zoom);
    return panelCamera(panel, orbited(rig, yaw, pitch), this.page.view_filter);
  }

  /** Scenes turn. Before a photo the eye moves, as before a window, so that its frame stays. */
  onScreen({ yaw, pitch, zoom }, width, height) {
    const { rig: wide, upright_rig: upright, cone_deg: cone } = this.page;
    const rig = zoomed(fitted(width < height && upright ? upright : wide, width, height), zoom);
    if (this.page.reach_deg === null) return plainCamera(orbited(rig, yaw, pitch), cone, 0, 0);
    const [right, down] = [yaw, -pitch].map((deg) => rig.zero_depth * Math.tan(deg * RADIANS));
    return plainCamera(rig, cone, right, down);
  }
}
