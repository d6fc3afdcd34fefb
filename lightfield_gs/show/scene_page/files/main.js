// A scene that was sent as one file: it is drawn here, for a 3D display or for this screen.

import { openDevice } from "../../../webgpu/browser/device.js";
import { TooLarge } from "../../../webgpu/browser/pipelines.js";
import { fullScreen } from "../../page/files/display.js";
import { stripOf } from "../../page/files/strip.js";
import { listen } from "./hands.js";
import { PanelChoice } from "./panel_choice.js";
import { PixelCheck } from "./pixel_check.js";
import { Stage } from "./stage.js";
import { State } from "./state.js";
import { inflated, unpacked } from "./unpack.js";

const REST_MS = 250, IDLE_MS = 4000;
const LACKS = {
  webgpu: "This browser cannot draw 3D scenes by itself",
  adapter: "This browser found no graphics device for 3D",
  hardware: "This browser can use no graphics processor here",
  lost: "The graphics device stopped",
  large: "This scene is too large for the graphics of this device",
};
const find = (query) => document.querySelector(query);
const page = JSON.parse(find("#scene").textContent), options = new URLSearchParams(location.hash.slice(1));
const picture = find("#picture"), strip = find("#strip");
let draw = null, isDrawing = false, drawn = 0, wanted = 0, lastMove = 0, frameTime = 0;

const state = new State(page.reach_deg, changed);
const choice = new PanelChoice(page.panel, () => { check.begin(); changed(); });
const check = new PixelCheck(picture, () => state.mode === "panel", () => choice.panel);

// When it is drawn

function changed() {
  wanted += 1;
  lastMove = performance.now();
  document.body.dataset.state = "moving";
  showButtons();
  loop();
}

/** Draws what has changed, one picture after the other; at rest, once more in full. */
async function loop() {
  if (isDrawing || !draw) return;
  isDrawing = true;
  try {
    for (;;) {
      const now = await new Promise(requestAnimationFrame), number = wanted;
      const moves = state.turnsItself || now - lastMove < REST_MS;
      if (drawn === number && !moves && document.body.dataset.state === "still") break;
      if (drawn !== number || state.turnsItself || !moves) {
        state.sway(now - frameTime);
        frameTime = now;
        await draw(state, moves);
        drawn = number;
        document.body.dataset.state = moves || drawn !== wanted ? "moving" : "still";
        find("#wait").hidden = true;
        strip.hidden = document.body.dataset.drawnBy === "webgpu";
      }
    }
  } catch (error) {
    console.error(error);
    await showStrip(error instanceof TooLarge ? "large" : "lost");
  } finally {
    isDrawing = false;
  }
  if (drawn !== wanted) loop(); // what took the scene's place
}

const windowSize = () => [innerWidth, innerHeight].map((side) => Math.max(1, Math.round(side * devicePixelRatio)));

async function start() {
  const opened = options.has("pictures") ? { lacks: "webgpu" } : await openDevice(options.has("software"));
  if (opened.lacks) return showStrip(opened.lacks);
  (await stripOf(strip, page.strip))(0.5); // to be seen until the scene is drawn
  strip.hidden = false;
  opened.device.lost.then(() => showStrip("lost"));
  const scene = unpacked(page.gaussians, await inflated(find("#gaussians").textContent.trim()));
  const stage = new Stage(opened.device, picture, page, scene);
  draw = (now, moves) => stage.draw(now, choice.panel, windowSize(), moves);
  document.body.dataset.drawnBy = "webgpu";
  if (options.has("panel") && choice.panel) setMode("panel");
  changed();
}

/** Shows views that were drawn beforehand, and says why. */
async function showStrip(lacks) {
  if (document.body.dataset.drawnBy === "strip") return;
  const showPlace = await stripOf(strip, page.strip), reach = page.strip.reach_deg;
  setMode("screen");
  state.reach = reach;
  document.body.dataset.drawnBy = "strip";
  picture.hidden = true;
  strip.hidden = false;
  for (const name of ["show", "choose-here"]) find(`#${name}`).hidden = true;
  find("#note").hidden = false;
  find("#note").textContent = `${LACKS[lacks]}: these are ${page.strip.frames.length} pictures, drawn beforehand. A new ` +
    "Chrome, Edge, Safari or Firefox shows the scene from all sides.";
  draw = async ({ yaw }) => showPlace(0.5 + yaw / (2 * reach));
  changed();
}

// What can be done

function setMode(mode) {
  state.mode = document.body.dataset.mode = mode;
  if (mode === "screen") {
    state.isTest = false;
    picture.style.width = picture.style.height = "";
  }
  check.begin();
  changed();
}

async function toPanel() {
  if (!draw || document.body.dataset.drawnBy !== "webgpu") return;
  if (!choice.panel) return choice.open();
  setMode("panel");
  try {
    await fullScreen(choice.panel);
  } catch {
    // Not allowed here: the word says what to do
  }
}

async function leave() {
  if (document.fullscreenElement) await document.exitFullscreen();
  setMode("screen");
}

function toggleTest() {
  if (document.body.dataset.drawnBy !== "webgpu") return;
  state.isTest = !state.isTest;
  if (state.isTest && state.mode !== "panel") toPanel();
  changed();
}

function showButtons() {
  find("#self").setAttribute("aria-pressed", state.turnsItself);
  find("#test").setAttribute("aria-pressed", state.isTest);
}

let idleTimer = 0;

/** Hides what lies over the picture while nobody moves. */
function awake() {
  document.body.dataset.idle = "false";
  clearTimeout(idleTimer);
  idleTimer = setTimeout(() => { document.body.dataset.idle = "true"; }, IDLE_MS);
}

const toggleSelf = () => state.setItself(!state.turnsItself);
const toggleHelp = () => (find("#help").open ? find("#help").close() : find("#help").showModal());
const togglePanel = () => (state.mode === "panel" ? leave() : toPanel());

for (const [name, act] of Object.entries({
  show: togglePanel, back: leave, self: toggleSelf, front: () => state.reset(), test: toggleTest, choose: () => choice.open(), "choose-too": () => choice.open(),
  "choose-here": () => { toggleHelp(); choice.open(); }, ask: toggleHelp, full: toPanel, leave,
})) find(`#${name}`).addEventListener("click", act);
find("#help [value=close]").addEventListener("click", toggleHelp);
listen(state, [picture, strip], find("#tilt"), {
  " ": toggleSelf, f: togglePanel, F: togglePanel, t: toggleTest, T: toggleTest, "?": toggleHelp, Escape: leave,
});
for (const event of ["pointermove", "pointerdown", "keydown", "focusin"]) addEventListener(event, awake);
addEventListener("resize", changed);
document.addEventListener("fullscreenchange", () => { if (!document.fullscreenElement && state.mode === "panel") leave(); });

document.title = find("#title").textContent = page.title;
document.documentElement.style.setProperty("--ground", page.ground);
if (!matchMedia("(prefers-reduced-motion: reduce)").matches) state.setItself(true);
awake();
start();
