// Pictures and films in turn on one screen: each as long as it is to be, then the next; with keys, and a fade between.

import { fullScreen } from "./display.js";
import { openFilm } from "./films.js";
import { checkPixels, lay, watchPixels } from "./pixel_word.js";

const find = (query) => document.querySelector(query);
const ALIVE_MS = 5000, NOTICE_MS = 2500, IDLE_MS = 3000;
let list = null; // what the server shows
let order = [], at = 0; // indices of slides, and the place among them
let current = null, isPaused = false, timer = 0, turn = 0;
const pictures = new Map(); // by index: elements that are loaded, or being so

// Slides

/** A slide that is loaded: {element, play, stop, close}. */
async function opened(index, mine) {
  const slide = list.slides[index];
  if (slide.kind !== "picture") {
    const over = () => mine === turn && step(1), loops = list.seconds === 0 || (list.slides.length === 1 && list.loop);
    return openFilm(slide, index, list.panel, loops, over, (words) => mine === turn && skip(words));
  }
  const element = await loaded(index);
  return { element, play() { waitForNext(); }, stop() { clearTimeout(timer); }, close() {} };
}

function loaded(index) {
  if (!pictures.has(index)) {
    const element = Object.assign(new Image(), { alt: list.slides[index].name, src: `slide.png?n=${index}` });
    pictures.set(index, element.decode().then(() => element, () => { throw new Error(`${element.alt} cannot be shown.`); }));
    pictures.get(index).catch(() => pictures.delete(index));
  }
  return pictures.get(index);
}

function waitForNext() {
  clearTimeout(timer);
  if (list.seconds > 0 && list.slides.length > 1) timer = setTimeout(() => step(1), 1000 * list.seconds);
}

/** Shows the slide at the current place. */
async function show() {
  const mine = ++turn, index = order[at];
  clearTimeout(timer);
  try {
    const slide = await opened(index, mine);
    if (mine !== turn) return slide.close();
    replace(slide);
    document.title = `${list.slides[index].name} · lightfield-gs`;
    document.body.dataset.slide = index;
    if (!isPaused) slide.play();
    failures = 0;
    preload(mine);
  } catch (error) {
    if (mine === turn) skip(error.message);
  }
}

/** Lays a slide over the one before, which goes once the fade is over. */
function replace(slide) {
  const before = current;
  current = slide;
  before?.stop();
  const { element } = slide, stage = find("#stage");
  stage.append(element);
  element.id = "picture";
  lay(element, list.panel);
  if (!before || before.element === element) return;
  before.element.removeAttribute("id");
  element.classList.add("coming");
  element.getBoundingClientRect(); // so that the fade begins
  element.classList.remove("coming");
  setTimeout(() => {
    if (current?.element !== before.element) before.element.remove();
    before.close();
  }, 1000 * list.fade);
}

/** Loads the neighbours, and lets go of all other pictures. */
function preload(mine) {
  const near = [at, at + 1, at - 1].map((place) => order[(place + order.length) % order.length]);
  for (const index of [...pictures.keys()]) if (!near.includes(index)) pictures.delete(index);
  const next = near[1];
  if (mine === turn && list.slides[next].kind === "picture") loaded(next).catch(() => {});
}

let failures = 0;

function skip(words) {
  notice(words, true);
  if (++failures < list.slides.length) timer = setTimeout(() => step(1), NOTICE_MS);
}

function step(by) {
  const end = by > 0 ? order.length : -1, past = at + by === end;
  if (past && !list.loop) return notice(by > 0 ? "This is the last." : "This is the first.");
  if (past && list.shuffle) arrange(true);
  at = (at + by + order.length) % order.length;
  show();
}

function goTo(place) {
  at = (place + order.length) % order.length;
  show();
}

/** Puts the slides in order, or by chance; never the same one twice in a row. */
function arrange(isNewRound) {
  const shown = order[at];
  order = list.slides.map((_, index) => index);
  if (!list.shuffle) {
    at = Math.max(0, order.indexOf(shown));
    return;
  }
  for (let i = order.length - 1; i > 0; i--) {
    const j = Math.floor(Math.random() * (i + 1));
    [order[i], order[j]] = [order[j], order[i]];
  }
  if (isNewRound && order[0] === shown) order.push(order.shift());
  else if (!isNewRound && shown !== undefined) [order[0], order[order.indexOf(shown)]] = [shown, order[0]];
  at = isNewRound ? order.length - 1 : 0; // the step that follows leads to the first
}

// Words and keys

let noticeTimer = 0;

function notice(words, isTrouble = false) {
  find("#notice").textContent = words;
  find("#notice").hidden = false;
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => { find("#notice").hidden = true; }, isTrouble ? 3 * NOTICE_MS : NOTICE_MS);
}

function pause() {
  isPaused = !isPaused;
  if (isPaused) current?.stop();
  else current?.play();
  notice(isPaused ? "Stopped." : "Goes on.");
}

const KEYS = {
  ArrowRight: () => step(1), PageDown: () => step(1), n: () => step(1), Enter: () => step(1),
  ArrowLeft: () => step(-1), PageUp: () => step(-1), p: () => step(-1),
  Home: () => goTo(0), End: () => goTo(-1), " ": pause, f: () => fullScreen(list.panel),
  l() { list.loop = !list.loop; notice(list.loop ? "After the last comes the first." : "It stops at the last."); },
  s() { list.shuffle = !list.shuffle; arrange(false); notice(list.shuffle ? "By chance." : "In order."); },
  h() { find("#keys").hidden = !find("#keys").hidden; },
};
KEYS["?"] = KEYS.h;

addEventListener("keydown", (event) => {
  if (!list || event.ctrlKey || event.altKey || event.metaKey || event.target.closest?.("button")) return;
  const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!act) return;
  event.preventDefault();
  act();
});

// The mouse hides itself, the screen stays on, and the page follows a server that began anew

let idleTimer = 0;

function stir() {
  document.body.classList.remove("idle");
  clearTimeout(idleTimer);
  idleTimer = setTimeout(() => document.body.classList.add("idle"), IDLE_MS);
}

for (const event of ["mousemove", "mousedown", "touchstart"]) addEventListener(event, stir);

async function stayOn() {
  try {
    await navigator.wakeLock?.request("screen");
  } catch {
    // Not allowed here: the system's own setting decides.
  }
}

document.addEventListener("visibilitychange", () => document.visibilityState === "visible" && stayOn());

function check() {
  if (list === null) return;
  for (const element of find("#stage").children) lay(element, list.panel);
  checkPixels(list.panel);
}

async function told() {
  return (await fetch("slides.json")).json();
}

async function begin() {
  list = await told();
  document.documentElement.style.setProperty("--fade", `${list.fade}s`);
  arrange(false);
  check();
  await show();
  setInterval(async () => {
    try {
      if ((await told()).run !== list.run) location.reload();
    } catch {
      // The program has ended, or begins again.
    }
  }, ALIVE_MS);
}

watchPixels(check, () => list.panel);
stir();
stayOn();
begin();
