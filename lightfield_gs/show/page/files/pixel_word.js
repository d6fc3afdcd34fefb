// The loud word on a page that is not the panel's picture pixel for pixel.

import { fullScreen, measured, measuresInWords, reasons } from "./display.js";

const find = (query) => document.querySelector(query);
let isHidden = false;

/** Shows or hides the word for a panel as it is now. */
export function checkPixels(panel) {
  const now = measured(), found = reasons(panel, now);
  find("#word").hidden = isHidden || found.length === 0;
  document.body.dataset.exact = found.length === 0;
  find("#reasons").replaceChildren(...found.map((words) => Object.assign(document.createElement("li"), { textContent: words })));
  find("#measures").textContent = measuresInWords(now);
}

/** Calls `check` whenever the pixels may have changed, and lets the word's buttons work. */
export function watchPixels(check, panelNow) {
  for (const event of ["resize", "fullscreenchange", "focus"]) addEventListener(event, check);
  visualViewport?.addEventListener("resize", check);
  setInterval(check, 1000); // a window moved to another screen tells nothing
  find("#full").addEventListener("click", () => fullScreen(panelNow()));
  find("#hide").addEventListener("click", () => { isHidden = true; check(); });
  document.addEventListener("dblclick", () => fullScreen(panelNow()));
}

/** Lays an element over the panel: at one pixel of the screen each, or over the whole screen. */
export function lay(element, panel) {
  element.style.width = panel.fills ? "100vw" : `${panel.width_px / devicePixelRatio}px`;
  element.style.height = panel.fills ? "100vh" : `${panel.height_px / devicePixelRatio}px`;
}
