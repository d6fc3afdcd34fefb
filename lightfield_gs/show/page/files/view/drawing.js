// Draws the scene of `view` in the browser: what an eye sees, twelve views, and native pixels. The controls are those of
// the server (lightfield_gs/show/page/stage.py), and so are the pictures, to 1/255.

import { PERIOD } from "../../../../panels/browser/lens.js";
import { apertureOf, cutOut, eyeOffset, looked, orbited, panelCamera, plainCamera, reduced } from "../../../../panels/browser/rig.js";
import { eyeBefore } from "../../../../panels/browser/simulate.js";
import { openDevice } from "../../../../webgpu/browser/device.js";
import { Frames } from "../../../../webgpu/browser/frames.js";
import { Picture } from "../../../../webgpu/browser/picture.js";
import { Seen } from "../../../../webgpu/browser/seen.js";

const STILL_WIDTH_PX = 1920; // of one view, on panels before which no eye can be placed
const SHEET_VIEWS = 12, SHEET_WIDTH_PX = 1920; // as in lightfield_gs/show/preview.py

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

  /** What an eye sees. still: through the lenses, if the panel knows where its eyes are; else through perfect lenses, as
   *  one view. */
  async eye(controls, width, still) {
    const eye = still ? eyeBefore(this.scene.panel, controls.eye) : null;
    if (eye) return this.throughLenses(controls, eye);
    const camera = this.viewCamera(controls, still ? STILL_WIDTH_PX : width, controls.eye);
    const bitmap = await this.bitmap(camera, controls), { width_px: across, height_px: down } = camera.lens;
    return { bitmap, said: `one view, ${across} x ${down}` };
  }

  async throughLenses(controls, eye) {
    const [across, down] = eye.samples, job = this.job(this.panelCamera(controls), controls);
    const bitmap = await this.inTurn(async () => {
      const seen = new Seen(this.frames, eye, this.scene.panel.width_px);
      await this.frames.draw(job, (first, rows) => seen.take(first, rows));
      await seen.end();
      this.picture.begin(across, down);
      this.picture.take(0, down, this.frames.buffers.get("seen"));
      this.picture.end();
      return this.canvas.transferToImageBitmap();
    });
    return { bitmap, said: `through the lenses, ${across} x ${down} samples` };
  }

  /** Twelve views side by side, the left-most camera's first, at a smaller size unless still. */
  async sheet(controls, still) {
    const { views, width_px, height_px } = this.scene.panel, columns = height_px > width_px ? 6 : 4;
    const width = Math.floor(SHEET_WIDTH_PX / columns / (still ? 1 : 2)), inner = 0.5 - 0.5 / views;
    let sheet = null;
    for (let k = 0; k < SHEET_VIEWS; k++) {
      const camera = this.viewCamera(controls, width, inner * ((2 * k) / (SHEET_VIEWS - 1) - 1)), { lens } = camera;
      const bitmap = await this.bitmap(camera, controls);
      sheet ??= new OffscreenCanvas(columns * lens.width_px, (SHEET_VIEWS / columns) * lens.height_px);
      sheet.getContext("2d").drawImage(bitmap, (k % columns) * lens.width_px, Math.floor(k / columns) * lens.height_px);
      bitmap.close();
    }
    return { bitmap: sheet.transferToImageBitmap(), said: `${SHEET_VIEWS} views from left to right` };
  }

  /** The camera of an eye behind perfect lenses, whose picture is so wide. */
  viewCamera(controls, width, place) {
    const { panel, view_filter } = this.scene, rig = this.rig(controls), small = reduced(rig, width);
    const right = eyeOffset(small, panel.cone_deg, place);
    return plainCamera(small, panel.cone_deg, right, 0, apertureOf(panel, rig, view_filter));
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
  onPanel(controls) { return this.inTurn(() => this.draw(this.panelCamera(controls), controls)); }

  panelCamera(controls) { return panelCamera(this.scene.panel, this.rig(controls), this.scene.view_filter); }

  bitmap(camera, controls) {
    return this.inTurn(async () => {
      await this.draw(camera, controls);
      return this.canvas.transferToImageBitmap();
    });
  }

  async draw(camera, controls) {
    this.picture.begin(camera.lens.width_px, camera.lens.height_px);
    await this.frames.draw(this.job(camera, controls), (first, rows) => this.picture.take(first, rows, this.frames.buffers.get("image")));
    this.picture.end();
  }

  job(camera, { background: chosen }) {
    const { antialiased, background } = this.scene;
    return { camera, antialiased, background: chosen ? fractions(chosen) : background };
  }

  /** Draws one picture after the other. */
  inTurn(work) {
    this.last = this.last.catch(() => {}).then(work);
    return this.last;
  }
}

/** Red, green and blue of #rrggbb, 0..1. */
const fractions = (colour) => [1, 3, 5].map((start) => parseInt(colour.slice(start, start + 2), 16) / 255);
