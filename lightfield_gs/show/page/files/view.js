// The page that steers a scene. One request at a time for what moves, each with the whole state; when nothing has moved
// for a while, the same in full. Older answers are dropped, so that the page never lags behind the hand.

import { buildControls, element } from "./controls.js";
import { openDrawing } from "./drawing.js";
import { answerOf, fit, pictureOf, show, showTimes } from "./pictures.js";

const REST_MS = 250; // without a move, before the picture is drawn in full
const FRAME_MS = { slow: 60, quick: 25 }; // a coarse picture becomes smaller above the one, larger below the other
const WIDTHS_PX = [240, 1280];
const DEGREES_A_PX = 0.3;
const PANS = [-2, 2]; // in widths and heights of the panel

const find = (query) => document.querySelector(query);
const scene = await (await fetch("scene.json")).json();
const state = { ...scene.defaults, mode: "eye", width: scene.live ? 1280 : 640, x: 0.5, y: 0.5 };
const panes = Object.fromEntries([...document.querySelectorAll("figure")].map((pane) => [pane.dataset.pane, pane]));
let moves = 0, drawn = 0, rested = 0, isDrawing = false, restTimer = 0, stopRest = new AbortController();
const channel = new BroadcastChannel("lightfield-gs view"); // a panel's page in this browser follows at once
let drawing = null;
const rate = []; // times of the last coarse pictures, ms

// What is asked for

function query(pane, still) {
  const { mode, width, ...controls } = state;
  const values = { ...controls, show: pane, still: still ? 1 : 0, width };
  if (pane === "native") Object.assign(values, size(panes.native));
  return new URLSearchParams(values);
}

/** What the server knows of the state: the controls. */
function kept() {
  const { mode, width, x, y, ...controls } = state;
  return controls;
}

/** Has the panel show this state. */
const settle = (signal) => answerOf("rest", signal,
  { method: "POST", headers: { "X-Token": scene.token }, body: new URLSearchParams(kept()) });

/** Room for native pixels in a pane: pixels of the screen. */
function size(pane) {
  const { clientWidth, clientHeight } = pane.querySelector(".picture");
  const pixels = (length) => Math.min(4096, Math.max(16, Math.floor(length * devicePixelRatio)));
  return { width: pixels(clientWidth), height: pixels(clientHeight) };
}

/** A picture of a pane: drawn here where this browser can, else by the server. */
async function draw(pane, still, signal) {
  const isHere = drawing && !drawing.isLost && (pane === "native" || (pane === "eye" && !still));
  if (!isHere) return pictureOf(`frame?${query(pane, still)}`, signal);
  const began = performance.now(), { width, height } = size(panes.native);
  try {
    const picture = pane === "eye" ? await drawing.eye(state, state.width) : await drawing.native(state, state.x, state.y, width, height);
    return { ...picture, stages: [["drawn in the browser", performance.now() - began]] };
  } catch (error) {
    console.error(error); // too large, or lost: the server can
    drawing = null;
    introduce();
    showWords();
    return draw(pane, still, signal);
  }
}

/** Has this browser draw, once it is ready. */
async function drawHere() {
  try {
    const opened = await openDrawing();
    await opened?.eye(state, WIDTHS_PX[0]); // compiles
    drawing = opened;
  } catch (error) {
    console.error(error);
  }
  document.body.dataset.draws = drawing ? "here" : "server";
  if (!drawing) return;
  introduce();
  changed();
}

// When it is asked for

function changed() {
  moves += 1;
  stopRest.abort();
  clearTimeout(restTimer);
  restTimer = setTimeout(rest, REST_MS);
  find("#panes").setAttribute("aria-busy", "true");
  showWords();
  channel.postMessage(kept());
  moving();
}

async function moving() {
  if (isDrawing) return;
  isDrawing = true;
  try {
    while (drawn !== moves) {
      const now = moves, began = performance.now(), pane = state.mode === "split" ? "eye" : state.mode;
      const picture = await draw(pane, false);
      drawn = now;
      if (rested === now) continue; // the picture at rest was quicker
      lay(pane, picture, false);
      adapt(performance.now() - began);
    }
    trouble("");
  } catch (error) {
    drawn = moves;
    trouble(error.message);
  } finally {
    isDrawing = false;
  }
}

async function rest() {
  const now = moves;
  stopRest = new AbortController();
  const wanted = state.mode === "split" ? ["eye", "sheet", "native"] : [state.mode];
  try {
    for (const pane of wanted) {
      const picture = await draw(pane, true, stopRest.signal);
      if (now !== moves) return;
      rested = now;
      lay(pane, picture, true);
      if (pane === wanted[0]) await settle(stopRest.signal);
    }
    await showDepth(stopRest.signal);
    if (now !== moves) return;
    find("#panes").setAttribute("aria-busy", "false");
    rate.length = 0;
  } catch (error) {
    if (error.name === "AbortError" || now !== moves) return;
    // Another page of this program was quicker, or many are being answered
    if (error.status === 409 || error.status === 503) restTimer = setTimeout(rest, REST_MS);
    else trouble(error.message);
  }
}

/** Makes coarse pictures as large as the machine can draw while the hand moves. */
function adapt(tookMs) {
  rate.push(tookMs);
  if (rate.length > 30) rate.shift();
  const mean = rate.reduce((sum, each) => sum + each, 0) / rate.length;
  find("#rate").textContent = `while moving: ${(1000 / mean).toFixed(0)} pictures a second`;
  if (scene.live || rate.length < 4 || state.mode !== "eye") return;
  const factor = mean > FRAME_MS.slow ? 0.8 : mean < FRAME_MS.quick ? 1.2 : 1;
  const width = Math.round(Math.min(WIDTHS_PX[1], Math.max(WIDTHS_PX[0], state.width * factor)));
  if (width !== state.width) rate.length = 0;
  state.width = width;
}

// What is shown

function lay(pane, picture, still) {
  show(panes[pane], picture, still);
  refit(pane);
  if (picture.stages.length) showTimes(find("#times tbody"), picture.stages);
}

function refit(pane) {
  fit(panes[pane], pane === "eye" ? scene.panel.width_px / scene.panel.height_px : null);
}

/** How deep the picture is on the panel, and what is wrong with that. */
async function showDepth(signal) {
  const { lines, warnings } = await (await answerOf(`depth.json?${new URLSearchParams(kept())}`, signal)).json();
  const items = (words) => words.map((textContent) => element("li", { textContent }));
  find("#warnings").replaceChildren(...items(warnings));
  find("#depth").replaceChildren(...items(lines));
}

function showWords() {
  controls.show();
  find("#turned").textContent = `${state.yaw_deg.toFixed(0)}° across, ${state.pitch_deg.toFixed(0)}° up`;
  find("#eye-dot").style.left = `${100 * (state.eye + 0.5)}%`;
  for (const link of find("#exports").children) link.href = `export/${link.download}?${new URLSearchParams(kept())}`;
}

function trouble(words) {
  find("#trouble").hidden = !words;
  find("#trouble").textContent = words === "Failed to fetch" ? "The program has ended: start it again" : words;
}

// Hands

const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

function listen() {
  for (const name of ["eye", "sheet", "native"]) {
    const room = panes[name].querySelector(".picture");
    room.addEventListener("pointerdown", (event) => {
      room.setPointerCapture(event.pointerId);
      room.classList.add("held");
    });
    for (const end of ["pointerup", "pointercancel"]) room.addEventListener(end, () => room.classList.remove("held"));
    room.addEventListener("pointermove", (event) => move(name, room, event));
    room.addEventListener("wheel", (event) => wheel(event), { passive: false });
  }
  panes.eye.querySelector(".picture").addEventListener("dblclick", focusAt);
  panes.eye.querySelector(".picture").addEventListener("contextmenu", (event) => event.preventDefault());
  for (const button of document.querySelectorAll("nav button")) button.addEventListener("click", () => choose(button));
  find("#reset").addEventListener("click", () => { controls.reset(); changed(); });
  addEventListener("resize", () => { Object.keys(panes).forEach(refit); changed(); });
}

function move(pane, room, event) {
  if (room.classList.contains("held") && event.buttons) {
    if (pane === "native") {
      state.x = clamp(state.x - (event.movementX * devicePixelRatio) / scene.panel.width_px, 0, 1);
      state.y = clamp(state.y - (event.movementY * devicePixelRatio) / scene.panel.height_px, 0, 1);
    } else if (event.shiftKey || event.buttons === 2) {
      const { width, height } = room.querySelector("canvas").getBoundingClientRect();
      state.pan_x = clamp(state.pan_x + event.movementX / width, ...PANS);
      state.pan_y = clamp(state.pan_y + event.movementY / height, ...PANS);
    } else {
      state.yaw_deg = ((state.yaw_deg - event.movementX * DEGREES_A_PX + 540) % 360) - 180;
      state.pitch_deg = clamp(state.pitch_deg + event.movementY * DEGREES_A_PX, -89, 89);
    }
    changed();
  } else if (pane === "eye") {
    const { left, width } = room.querySelector("canvas").getBoundingClientRect();
    state.eye = clamp((event.clientX - left) / width - 0.5, -0.5, 0.5);
    changed();
  }
}

/** Lays what is seen at the mouse in the panel's plane. */
async function focusAt(event) {
  const { left, top, width, height } = panes.eye.querySelector("canvas").getBoundingClientRect();
  const point = { x: (event.clientX - left) / width, y: (event.clientY - top) / height };
  try {
    const answer = await answerOf(`focus.json?${new URLSearchParams({ ...kept(), ...point })}`);
    state.focus = (await answer.json()).focus;
  } catch (error) {
    return trouble(error.message);
  }
  changed();
}

function wheel(event) {
  event.preventDefault();
  state.zoom = clamp(state.zoom * Math.exp(-event.deltaY / 800), ...controls.limits.zoom);
  changed();
}

function choose(button) {
  for (const other of document.querySelectorAll("nav button")) other.setAttribute("aria-pressed", other === button);
  state.mode = find("#panes").dataset.mode = button.dataset.mode;
  rate.length = 0;
  changed();
}

// The start

function introduce() {
  const { panel } = scene;
  document.title = `${scene.name} · lightfield-gs`;
  find("#name").textContent = scene.name;
  find("#about").textContent = `${scene.gaussians.toLocaleString("en")} Gaussians · panel ${panel.name}, ` +
    `${panel.width_px} × ${panel.height_px}, ${panel.views} views · ${drawing ? "drawn in this browser" : scene.live ? "GPU" : "CPU"}`;
  const half = scene.zone_mm === null ? `${(panel.cone_deg / 2).toFixed(0)}°` : `${(scene.zone_mm / 2).toFixed(0)} mm`;
  find("#zone-left").textContent = `${half} left`;
  find("#zone-right").textContent = `${half} right`;
  find("#exports").replaceChildren(...scene.exports.map((name) =>
    element("a", { className: "button", textContent: name, download: name })));
}

const controls = buildControls(find("#sliders"), scene, state, changed);
introduce();
listen();
changed();
drawHere();
