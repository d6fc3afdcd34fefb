// A pattern on the display, and what moves its lens until it looks right: one number at a time.

import { fullScreen, measured, reasons } from "./display.js";
import { drawPattern } from "./pattern.js";

const RAINBOW = "red, yellow, lime, cyan, blue, magenta";
const STEPS = {
  pitch: {
    unit: "%", moves: [1, 0.3, 0.1, 0.03, 0.01, 0.003], title: "One colour from left to right",
    task: "Close one eye and look from straight in front. Move the pitch until the display has one colour from its left " +
      "edge to its right edge. Which colour does not matter.",
    right: "lime", wrong: `linear-gradient(90deg, ${RAINBOW})`,
  },
  slope: {
    unit: "%", moves: [3, 1, 0.3, 0.1, 0.03], title: "One colour from top to bottom",
    task: "From the same place: move the slope until the colour is the same at the top and at the bottom.",
    right: "lime", wrong: `linear-gradient(180deg, ${RAINBOW})`,
  },
  centre: {
    unit: "lens widths", moves: [0.2, 0.1, 0.05, 0.02, 0.01], title: "White from straight in front",
    task: "Still with one eye, exactly before the middle: move the centre until the display is as white as it gets, and " +
      "turns dark alike to the left and to the right as you move your head.",
    right: "white", wrong: "linear-gradient(90deg, black 30%, white 75%, white)",
  },
};
const NAMES = Object.keys(STEPS), find = (query) => document.querySelector(query), canvas = find("#pattern");
const guide = await (await fetch("guide.json")).json();
const past = [], moveAt = { pitch: 2, slope: 1, centre: 1 };
let values = { pitch: 0, slope: 0, centre: 0 }, step = "pitch", drawing = false, isStale = false;

Object.assign(canvas, { width: guide.width_px, height: guide.height_px });
if (guide.distance_mm) STEPS.pitch.task = `From ${Math.round(guide.distance_mm / 10)} cm away. ${STEPS.pitch.task}`;
find("[data-step=slope]").disabled = !guide.has_slope; // upright lenses have none

function words(value, name) {
  const digits = Number(value.toFixed(4));
  return `${digits > 0 ? "+" : ""}${digits} ${STEPS[name].unit}`;
}

function show() {
  const { title, task, right, wrong, moves } = STEPS[step];
  find("#title").textContent = title;
  find("#task").textContent = task;
  find("#right").style.background = right;
  find("#wrong").style.background = wrong;
  find("#value").textContent = `${step} ${words(values[step], step)}`;
  find("#move").textContent = words(moves[moveAt[step]], step).replace("+", "");
  find("#undo").disabled = past.length === 0;
  find("#save").disabled = NAMES.every((name) => values[name] === 0);
  find("#next").disabled = step === "centre";
  for (const button of document.querySelectorAll("nav button")) {
    if (button.dataset.step === step) button.setAttribute("aria-current", "step");
    else button.removeAttribute("aria-current");
  }
}

// The newest lens is drawn; those in between are left out while a key is held
async function draw() {
  isStale = true;
  if (drawing) return;
  drawing = true;
  while (isStale) {
    isStale = false;
    const asked = { ...values, step }; // keys may change both meanwhile
    const lens = await (await fetch(`lens.json?${new URLSearchParams(values)}`)).json();
    find("#warning").textContent = lens.warning;
    drawPattern(canvas, asked.step === "centre" ? "centre" : "hues", guide.views, lens);
    canvas.dataset.drawn = JSON.stringify(asked);
    await new Promise(requestAnimationFrame);
  }
  drawing = false;
}

function go(name) {
  if (name === "slope" && !guide.has_slope) name = "centre";
  step = name;
  show();
  draw();
}

function change(next) {
  values = next;
  find("#saved").textContent = "";
  show();
  draw();
}

function move(direction) {
  past.push(values);
  const sum = values[step] + direction * STEPS[step].moves[moveAt[step]];
  change({ ...values, [step]: Number(sum.toFixed(6)) });
}

function resize(direction) {
  moveAt[step] = Math.min(STEPS[step].moves.length - 1, Math.max(0, moveAt[step] + direction));
  show();
}

function undo() { if (past.length) change(past.pop()); }

async function save() {
  if (find("#save").disabled) return;
  const warning = find("#warning").textContent;
  if (warning && !confirm(`${warning}. Save it all the same?`)) return;
  const answer = await fetch("save", { method: "POST", headers: { "X-Token": guide.token }, body: new URLSearchParams(values) });
  find("#saved").textContent = answer.ok ? (await answer.json()).lines.join(" ") : await answer.text();
}

function check() {
  for (const side of ["width", "height"]) canvas.style[side] = `${guide[`${side}_px`] / devicePixelRatio}px`;
  const found = reasons(guide, measured());
  find("#word").hidden = found.length === 0;
  find("#reasons").replaceChildren(...found.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
}

const hide = () => { find("main").hidden = !find("main").hidden; };
const KEYS = {
  ArrowLeft: () => move(-1), ArrowRight: () => move(1), ArrowUp: () => resize(-1), ArrowDown: () => resize(1),
  1: () => go("pitch"), 2: () => go("slope"), 3: () => go("centre"), u: undo, s: save, h: hide, f: () => fullScreen(guide),
};
addEventListener("keydown", (event) => {
  const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!act || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  act();
});
for (const button of document.querySelectorAll("nav button")) button.addEventListener("click", () => go(button.dataset.step));
for (const [name, act] of Object.entries({
  less: () => move(-1), more: () => move(1), undo, save, full: () => fullScreen(guide),
  next: () => go(NAMES[NAMES.indexOf(step) + 1]),
})) find(`#${name}`).addEventListener("click", act);
for (const event of ["resize", "fullscreenchange", "focus"]) addEventListener(event, check);
setInterval(check, 1000); // a window moved to another screen tells nothing
check();
go("pitch");
