// Tells aloud where the picture on the panel is not the panel's, pixel for pixel.

import { measured, measuresInWords, reasons } from "../../page/files/display.js";

const CHECK_MS = 1000; // a window moved to another screen tells nothing
const find = (query) => document.querySelector(query);

export class PixelCheck {
  /** canvas: where the native picture is; isOnPanel and panel say what it is for. */
  constructor(canvas, isOnPanel, panel) {
    Object.assign(this, { canvas, isOnPanel, panel, isHidden: false, drawn: null });
    for (const event of ["resize", "fullscreenchange", "focus"]) addEventListener(event, () => this.check());
    visualViewport?.addEventListener("resize", () => this.check());
    setInterval(() => this.check(), CHECK_MS);
    try {
      new ResizeObserver(([entry]) => {
        const [{ inlineSize, blockSize }] = entry.devicePixelContentBoxSize;
        this.drawn = [inlineSize, blockSize];
        this.check();
      }).observe(canvas, { box: "device-pixel-content-box" });
    } catch {
      // Safari does not know the pixels of a box: the measures of screen and window are left
    }
    find("#hide").addEventListener("click", () => { this.isHidden = true; this.check(); });
  }

  begin() { this.isHidden = false; this.check(); }

  check() {
    const panel = this.panel(), isOnPanel = this.isOnPanel();
    if (!isOnPanel || !panel) {
      find("#word").hidden = true;
      delete document.body.dataset.exact;
      return;
    }
    const { style } = this.canvas, now = measured(), found = reasons(panel, now);
    style.width = `${panel.width_px / devicePixelRatio}px`;
    style.height = `${panel.height_px / devicePixelRatio}px`;
    if (!found.length && this.drawn && (this.drawn[0] !== panel.width_px || this.drawn[1] !== panel.height_px))
      found.push(`The picture takes ${this.drawn[0]} × ${this.drawn[1]} pixels of the screen in place of ` +
        `${panel.width_px} × ${panel.height_px}: set the zoom of the browser to 100 % (Ctrl + 0).`);
    if (matchMedia("(color-gamut: p3)").matches)
      found.push("The system takes this display for one of wide colours and mixes them, which mixes the views too: set " +
        "the colour profile of the 3D display to sRGB in the settings of the system.");
    find("#word").hidden = this.isHidden || found.length === 0;
    document.body.dataset.exact = found.length === 0;
    find("#reasons").replaceChildren(...found.map((words) => Object.assign(document.createElement("li"), { textContent: words })));
    find("#measures").textContent = measuresInWords(now);
  }
}
