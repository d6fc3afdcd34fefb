// Scenes in a row: a button that plays them, and a slider for the one that is shown. The program draws each.

import { find } from "./dom.js";

export class Film {
  constructor(state) {
    this.state = state;
    find("#play").addEventListener("click", () => (this.isPlaying ? this.pause() : this.play()));
    find("#frame").addEventListener("input", () => {
      this.pause();
      state.set({ frame: find("#frame").valueAsNumber });
    });
    addEventListener("keydown", (event) => {
      const isFree = !event.target.closest?.("button, input, select, textarea, summary, a");
      if (event.key !== " " || !isFree || find("#film").hidden) return;
      event.preventDefault();
      find("#play").click();
    });
  }

  get isPlaying() { return find("#play").getAttribute("aria-pressed") === "true"; }

  /** Begins anew with what the program has opened. */
  open() {
    this.pause();
    const { film } = this.state.scene;
    find("#film").hidden = film === null;
    if (film) Object.assign(find("#frame"), { min: 0, max: film.count - 1, step: 1 });
  }

  show() {
    const { film } = this.state.scene, { frame } = this.state.values;
    if (!film) return;
    const place = `${frame + 1} of ${film.count}`;
    find("#frame").value = frame;
    find("#frame").setAttribute("aria-valuetext", place);
    find("#frame-place").textContent = place;
  }

  play() {
    const { film } = this.state.scene, first = this.state.values.frame, began = performance.now();
    this.press(true);
    const step = (now) => {
      if (!this.isPlaying) return;
      const frame = (first + Math.floor((Math.max(0, now - began) / 1000) * film.fps)) % film.count;
      if (frame !== this.state.values.frame) this.state.set({ frame });
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  pause() { this.press(false); }

  press(isPlaying) {
    find("#play").setAttribute("aria-pressed", isPlaying);
    find("#play").textContent = isPlaying ? "Stop" : "Play";
    document.body.toggleAttribute("data-playing", isPlaying);
  }
}
