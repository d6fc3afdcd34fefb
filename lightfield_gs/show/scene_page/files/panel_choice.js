// Which 3D display the picture is for: the one that the page was made for, or the one of a dropped visual.json, which is
// kept on this device.

import { panelOfCalibration } from "../../../panels/browser/calibration.js";

const KEPT = "lightfield-gs panel";

export class PanelChoice {
  /** own: the panel of the page, or null. changed: called with the panel. */
  constructor(own, changed) {
    Object.assign(this, { own, changed, dropped: kept(), dialog: document.querySelector("#display") });
    const { dialog } = this, find = (query) => dialog.querySelector(query);
    find("#file").addEventListener("change", (event) => this.read(event.target.files[0]));
    find("#own").addEventListener("click", () => this.choose(null, []));
    find("[value=close]").addEventListener("click", () => dialog.close());
    addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("drop"); });
    for (const name of ["dragleave", "drop"]) addEventListener(name, () => document.body.classList.remove("drop"));
    addEventListener("drop", (event) => {
      event.preventDefault();
      this.open();
      if (event.dataTransfer.files[0]) this.read(event.dataTransfer.files[0]);
    });
    this.show([]);
  }

  get panel() { return this.dropped ?? this.own; }

  open() {
    if (!this.dialog.open) this.dialog.showModal();
  }

  async read(file) {
    try {
      const { panel, notes } = panelOfCalibration(await file.text());
      this.choose(panel, notes);
    } catch (error) {
      this.show([error.message]);
    }
  }

  choose(panel, notes) {
    this.dropped = panel;
    keep(panel);
    this.show(notes);
    this.changed(this.panel);
  }

  show(words) {
    const { panel, dialog } = this, find = (query) => dialog.querySelector(query);
    const whose = this.dropped ? "Your calibration is in use" : "The page was made for this display";
    find("#display-now").textContent = panel ? `${whose}: ${panel.name}, ${panel.width_px} × ${panel.height_px} pixels.`
      : "This page was made for no display yet.";
    find("#own").hidden = !this.dropped || !this.own;
    find("#display-word").textContent = words.join(" ");
  }
}

function kept() {
  try {
    return JSON.parse(localStorage.getItem(KEPT));
  } catch {
    return null; // files may have no storage
  }
}

function keep(panel) {
  try {
    if (panel) localStorage.setItem(KEPT, JSON.stringify(panel));
    else localStorage.removeItem(KEPT);
  } catch {
    // Then it is dropped again next time
  }
}
