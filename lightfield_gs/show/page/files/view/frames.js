// Asks for pictures. One request at a time for what moves, each with the whole state; when nothing has moved for a while,
// the same in full. Older answers are dropped, so that the page never lags behind the hand.

import { answerOf, find, post } from "./dom.js";
import { openDrawing } from "./drawing.js";
import { fit, pictureOf, show, showTimes } from "./pictures.js";

const REST_MS = 250; // without a move, before the picture is drawn in full
const FRAME_MS = { slow: 60, quick: 25 }; // a coarse picture becomes smaller above the one, larger below the other
const WIDTHS_PX = [240, 1280];

export class Frames {
  /** measure: asks how deep the picture at rest is; told: {trouble, replaced} are called with an error's words, and where
   *  another scene is shown by now. */
  constructor(state, panes, measure, told) {
    Object.assign(this, { state, panes, measure, told, mode: "eye", x: 0.5, y: 0.5, drawing: null, times: [] });
    Object.assign(this, { moves: 0, drawn: 0, rested: 0, isDrawing: false, isHeld: false, stopRest: new AbortController() });
    this.channel = new BroadcastChannel("lightfield-gs view"); // a panel's page in this browser follows at once
    this.width = state.scene.on_gpu ? WIDTHS_PX[1] : 640;
  }

  /** The parameters of a picture of a pane. */
  query(pane, still) {
    const values = { ...this.state.controls, show: pane, still: still ? 1 : 0, width: this.width, x: this.x, y: this.y };
    if (pane === "native") Object.assign(values, this.size());
    return new URLSearchParams(values);
  }

  /** Room for native pixels in their pane: pixels of the screen. */
  size() {
    const { clientWidth, clientHeight } = this.panes.native.querySelector(".picture");
    const pixels = (length) => Math.min(4096, Math.max(16, Math.floor(length * devicePixelRatio)));
    return { width: pixels(clientWidth), height: pixels(clientHeight) };
  }

  /** A picture of a pane: drawn here where this browser can, else by the server. */
  async draw(pane, still, signal) {
    if (!this.drawing || this.drawing.isLost) return pictureOf(`frame?${this.query(pane, still)}`, signal);
    const began = performance.now(), { width, height } = this.size(), { controls } = this.state;
    try {
      const { drawing } = this, picture = await {
        eye: () => drawing.eye(controls, this.width, still),
        sheet: () => drawing.sheet(controls, still),
        native: () => drawing.native(controls, this.x, this.y, width, height),
      }[pane]();
      return { ...picture, stages: [["drawn in the browser", performance.now() - began]] };
    } catch (error) {
      console.error(error); // too large, or lost: the server can
      this.drawing = null;
      this.sayWhoDraws();
      return this.draw(pane, still, signal);
    }
  }

  /** Has this browser draw the scene, once it is ready. */
  async drawHere() {
    const { number } = this.state.scene;
    this.drawing?.close();
    this.drawing = null;
    try {
      const opened = await openDrawing();
      await opened?.eye(this.state.controls, WIDTHS_PX[0]); // compiles
      if (number === this.state.scene.number && opened?.scene.scene === number) this.drawing = opened;
      else opened?.close(); // another scene came in between
    } catch (error) {
      console.error(error);
    }
    this.sayWhoDraws();
    if (this.drawing) this.changed();
  }

  sayWhoDraws() {
    document.body.dataset.draws = this.drawing ? "here" : "server";
    const { scene } = this.state, words = this.drawing ? "this browser" : scene.on_gpu ? "the graphics card, by the program" : "the processor, by the program";
    find("#drawn-by").textContent = `${scene.gaussians.toLocaleString("en")} Gaussians, drawn by ${words}.`;
  }

  changed() {
    this.moves += 1;
    this.stopRest.abort();
    clearTimeout(this.restTimer);
    this.restTimer = setTimeout(() => this.rest(), REST_MS);
    find("#panes").setAttribute("aria-busy", "true");
    this.channel.postMessage(this.state.controls);
    this.moving();
  }

  async moving() {
    if (this.isDrawing) return;
    this.isDrawing = true;
    try {
      while (this.drawn !== this.moves) {
        const now = this.moves, began = performance.now(), pane = this.mode === "split" ? "eye" : this.mode;
        const picture = await this.draw(pane, false);
        this.drawn = now;
        if (this.rested === now) continue; // the picture at rest was quicker
        this.lay(pane, picture, false);
        this.adapt(performance.now() - began);
      }
      this.told.trouble("");
    } catch (error) {
      this.drawn = this.moves;
      this.failed(error);
    } finally {
      this.isDrawing = false;
    }
  }

  /** Draws again what changes by itself, unless the hand moves something: as soon as eyes have moved, or at times. */
  async follow() {
    const { follow_ms } = this.state.scene;
    for (let version = -1; ; ) {
      try {
        if (follow_ms) await new Promise((done) => setTimeout(done, follow_ms));
        else ({ version } = await (await answerOf(`panel.json?after=${version}`)).json());
        if (this.isDrawing || this.drawn !== this.moves) continue;
        const pane = this.mode === "split" ? "eye" : this.mode, began = performance.now();
        this.lay(pane, await this.draw(pane, false), false);
        this.adapt(performance.now() - began);
        if (!follow_ms && this.rested === this.moves) { // in full again when the eyes rest
          clearTimeout(this.restTimer);
          this.restTimer = setTimeout(() => this.rest(), REST_MS);
        }
      } catch {
        await new Promise((done) => setTimeout(done, 1000)); // another picture opens, or the program has ended
      }
    }
  }

  async rest() {
    const now = this.moves, { signal } = (this.stopRest = new AbortController());
    if (!this.isHeld) this.state.commit();
    const wanted = this.mode === "split" ? ["eye", "sheet", "native"] : [this.mode];
    try {
      for (const pane of wanted) {
        const picture = await this.draw(pane, true, signal);
        if (now !== this.moves) return;
        this.rested = now;
        this.lay(pane, picture, true);
        if (pane === wanted[0]) await post("rest", this.state.scene.token, this.state.controls, signal);
      }
      await this.measure(signal);
      if (now !== this.moves) return;
      find("#panes").setAttribute("aria-busy", "false");
      this.times.length = 0;
    } catch (error) {
      if (error.name === "AbortError" || now !== this.moves) return;
      // Another page of this program was quicker, or many are being answered
      if (error.status === 409 || error.status === 503) this.restTimer = setTimeout(() => this.rest(), REST_MS);
      else this.failed(error);
    }
  }

  failed(error) {
    if (error.status === 410) this.told.replaced();
    else this.told.trouble(error.message);
  }

  /** Makes coarse pictures as large as the machine can draw while the hand moves. */
  adapt(tookMs) {
    const { times } = this;
    times.push(tookMs);
    if (times.length > 30) times.shift();
    const mean = times.reduce((sum, each) => sum + each, 0) / times.length;
    find("#rate").textContent = `While moving: ${(1000 / mean).toFixed(0)} pictures a second.`;
    if (this.state.scene.on_gpu || times.length < 4 || this.mode !== "eye") return;
    const factor = mean > FRAME_MS.slow ? 0.8 : mean < FRAME_MS.quick ? 1.2 : 1;
    const width = Math.round(Math.min(WIDTHS_PX[1], Math.max(WIDTHS_PX[0], this.width * factor)));
    if (width !== this.width) times.length = 0;
    this.width = width;
  }

  lay(pane, picture, still) {
    show(this.panes[pane], picture);
    this.refit(pane);
    find("#said").textContent = `${this.panes[pane].dataset.name}${still ? "" : ", coarse while it moves"}: ${picture.said}.`;
    if (picture.stages.length) showTimes(find("#times tbody"), picture.stages);
  }

  refit(pane) {
    const { panel } = this.state.scene;
    fit(this.panes[pane], pane === "eye" ? panel.width_px / panel.height_px : null);
  }

  choose(mode) {
    this.mode = find("#panes").dataset.mode = mode;
    this.times.length = 0;
    this.changed();
  }
}
