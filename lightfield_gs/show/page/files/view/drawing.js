// Draws the scene of `view` in the browser: what an eye sees while it moves, and native pixels. The controls are those of
// the server (lightfield_gs/show/page/stage.py), and so are the pictures, to 1/255.

import { apertureOf, cutOut, eyeOffset, looked, orbited, panelCamera, plainCamera, reduced } from "../../../../panels/browser/rig.js";
import { openDevice } from "../../../../webgpu/browser/device.js";
import { Frames } from "../../../../webgpu/browser/frames.js";
import { Picture } from "../../../../webgpu/browser/picture.js";

const PERIOD = 4; // of cells of the panel, in rows and columns

/** What draws here; null where the server draws, or this browser cannot. canvas: where pictures appear; none: nowhere. */
export async function openDrawing(canvas = new OffscreenCanvas(1, 1)) {
  const scene = await (await fetch("drawing.json")).json();
  if (scene === null) return null;
  const { device } = await openDevice(new URLSearchParams(location.hash.slice(1)).has("software"));
  if (!device) return null;
  const answer = await fetch(`drawing.bin?scene=${scene.scene}`);
  if (!answer.ok) return null; // another scene is shown by now
  const floats = new Float32Array(await answer.arrayBuffer()), split = 12 * scene.count;
  const values = { count: scene.count, degree: scene.degree, gaussians: floats.subarray(0, split), harmonics: floats.subarray(split) };
  return new Drawing(device, canvas, scene, values);
}

class Drawing {
  constructor(device, canvas, scene, values) {
    Object.assign(this, { device, scene, canvas, isLost: false, last: Promise.resolve() });
    Object.assign(this, { frames: new Frames(device, scene.host, values), picture: new Picture(device, canvas) });
    device.lost.then(() => { this.isLost = true; });
  }

  /** Gives its memory back, before another scene is drawn. */
  close() { this.device.destroy(); }

  rig(controls) {
    const { rig, panel } = this.scene;
    return looked(orbited(rig, controls.yaw_deg, controls.pitch_deg), controls, panel.cone_deg);
  }

  /** One view, as an eye sees it through perfect lenses. */
  async eye(controls, width) {
    const { panel, view_filter } = this.scene, rig = this.rig(controls), small = reduced(rig, width);
    const right = eyeOffset(small, panel.cone_deg, controls.eye), [across, down] = small.size_px;
    const camera = plainCamera(small, panel.cone_deg, right, 0, apertureOf(panel, rig, view_filter));
    const bitmap = await this.bitmap(camera, controls);
    return { bitmap, said: `one view, ${across} x ${down}` };
  }

  /** Native pixels about a point of the panel, 0..1. */
  async native(controls, x, y, wide, high) {
    const { panel } = this.scene, width = Math.min(wide, panel.width_px);
    let height = Math.min(high, panel.height_px);
    height -= (((height - panel.height_px) % PERIOD) + PERIOD) % PERIOD;
    const place = (share, size, all) => Math.floor(Math.min(Math.max(0, Math.round(share * all - size / 2)), all - size) / PERIOD) * PERIOD;
    const left = place(x, width, panel.width_px), top = place(y, height, panel.height_px);
    const bitmap = await this.bitmap(cutOut(this.panelCamera(controls), left, top, width, height), controls);
    return { bitmap, said: `native pixels ${left}..${left + width - 1} x ${top}..${top + height - 1}` };
  }

  /** The native picture, on the canvas. */
  onPanel(controls) { return this.draw(this.panelCamera(controls), controls); }

  panelCamera(controls) { return panelCamera(this.scene.panel, this.rig(controls), this.scene.view_filter); }

  async bitmap(camera, controls) {
    await this.draw(camera, controls);
    return this.canvas.transferToImageBitmap();
  }

  /** Draws one picture after the other. */
  draw(camera, { background: chosen }) {
    const work = async () => {
      const { lens } = camera, { antialiased } = this.scene, background = chosen ? fractions(chosen) : this.scene.background;
      this.picture.begin(lens.width_px, lens.height_px);
      const take = (first, rows) => this.picture.take(first, rows, this.frames.buffers.get("image"));
      await this.frames.draw({ camera, antialiased, background }, take);
      this.picture.end();
    };
    this.last = this.last.catch(() => {}).then(work);
    return this.last;
  }
}

/** Red, green and blue of #rrggbb, 0..1. */
const fractions = (colour) => [1, 3, 5].map((start) => parseInt(colour.slice(start, start + 2), 16) / 255);
