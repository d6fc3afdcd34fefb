// The page that steers a scene: this file brings its parts together.

import { buildComfort } from "./comfort.js";
import { buildControls, showHints } from "./controls.js";
import { answerOf, find, post } from "./dom.js";
import { Film } from "./film.js";
import { Frames } from "./frames.js";
import { Gallery } from "./gallery.js";
import { listen, listenToHistory } from "./hands.js";
import { buildLooks } from "./looks.js";
import { buildSaving } from "./saving.js";
import { State } from "./state.js";

const EDGE = 0.47; // of the viewing zone, whose halves are 0.5: beyond, its other end shines through
const SAID_MS = 9000;

const state = new State(), film = new Film(state), panes = Object.fromEntries([...document.querySelectorAll("figure")].map((pane) => [pane.dataset.pane, pane]));
let controls, saving, frames, sayTimer = 0;

const told = {
  /** Says something for a while. */
  say(words) {
    find("#message").textContent = words;
    find("#message").hidden = false;
    clearTimeout(sayTimer);
    sayTimer = setTimeout(() => { find("#message").hidden = true; }, SAID_MS);
  },
  /** Says what is wrong until it is not, "". */
  trouble(words) {
    find("#trouble").hidden = !words;
    find("#trouble").textContent = words === "Failed to fetch" ? "The program has ended: start it again." : words;
  },
  /** Another page has had another scene opened. */
  replaced: () => open(),
};

function show() {
  controls.show();
  saving.show();
  film.show();
  const { eye } = state.values;
  find("#eye").value = eye;
  find("#eye-place").textContent = placeOf(eye);
  find("#eye").setAttribute("aria-valuetext", placeOf(eye));
  showEdge(eye);
  showSteps();
}

function showSteps() {
  find("#undo").disabled = !state.canUndo;
  find("#redo").disabled = !state.canRedo;
  find("#reset").disabled = state.isAsAtFirst;
}

/** What a display does at the ends of its viewing zone. */
function showEdge(eye) {
  const isAtEdge = Math.abs(eye) > EDGE, side = eye < 0 ? "left" : "right";
  find("#edge").hidden = !isAtEdge;
  if (isAtEdge) find("#edge").textContent = `The ${side} end of what the display shows. The picture is double here, on the display as well: go back to the middle.`;
}

function placeOf(eye) {
  const { zone_mm, panel } = state.scene, side = eye < 0 ? "left" : "right";
  if (Math.abs(eye) < 5e-4) return "the middle";
  if (zone_mm !== null) return `${((Math.abs(eye) * zone_mm) / 10).toFixed(1)} cm to the ${side}`;
  return `${(Math.atan(2 * Math.abs(eye) * Math.tan((panel.cone_deg * Math.PI) / 360)) * (180 / Math.PI)).toFixed(1)}° to the ${side}`;
}

/** Shows the scene that the program has, from its start. */
async function open() {
  const scene = await (await answerOf("scene.json")).json(), { panel } = scene;
  document.title = `${scene.name} · lightfield-gs`;
  document.body.dataset.shape = panel.width_px > panel.height_px ? "wide" : "tall";
  document.body.style.setProperty("--aspect", panel.width_px / panel.height_px);
  find("#name").textContent = scene.name;
  find("#about").textContent = `for the display ${panel.name}, ${panel.width_px} × ${panel.height_px}`;
  const half = scene.zone_mm === null ? `${(panel.cone_deg / 2).toFixed(0)}°` : `${(scene.zone_mm / 20).toFixed(0)} cm`;
  find("#zone-left").textContent = `${half} left`;
  find("#look-from").hidden = scene.tracked;
  if (scene.tracked) find("#look-with").textContent = "your head";
  find("#zone-right").textContent = `${half} right`;
  const isFirst = !frames;
  if (isFirst) begin(scene);
  state.open(scene);
  film.open();
  controls = buildControls(find("#large"), find("#small"), state);
  find("#large").children[0].after(comfort.card);
  saving = buildSaving(state, told);
  for (const pane of Object.keys(panes)) frames.refit(pane);
  changed();
  if (isFirst) listen(state, frames, panes, told);
  if (isFirst && scene.follow_ms !== null) frames.follow();
  frames.drawHere();
  return scene;
}

const comfort = buildComfort(state);

function begin(scene) {
  state.scene = scene;
  frames = new Frames(state, panes, comfort.measure, told);
}

function changed() {
  if (!controls) return;
  show();
  frames.changed();
}

/** Has the program open the panel's page on the display, where it knows the display's place; else the link opens it. */
async function showOnDisplay(event) {
  if (!state.scene.displays) return;
  event.preventDefault();
  try {
    await post("display", state.scene.token, {});
    told.say("The picture is on the display, and follows each change.");
  } catch (error) {
    told.say(error.message);
  }
}

const eye = find("#eye");
Object.assign(eye, { min: -0.5, max: 0.5, step: 0.01 });
eye.addEventListener("input", () => state.set({ eye: eye.valueAsNumber }));
eye.addEventListener("dblclick", () => state.set({ eye: 0 }));
for (const button of document.querySelectorAll("#modes button"))
  button.addEventListener("click", () => {
    for (const other of document.querySelectorAll("#modes button")) other.setAttribute("aria-pressed", other === button);
    frames.choose(button.dataset.mode);
  });
addEventListener("resize", () => { Object.keys(panes).forEach((pane) => frames?.refit(pane)); changed(); });
find("#show").addEventListener("click", showOnDisplay);
showHints(find("aside"));
listenToHistory(state);

const scene = await open();
state.addEventListener("change", changed);
state.addEventListener("step", showSteps);
await Promise.all([scene.keeps && buildLooks(state, told), scene.opens && new Gallery(state, told, open).read()]);
for (const pane of Object.keys(panes)) frames.refit(pane);
delete document.body.dataset.loading; // all at once, so that nothing jumps
