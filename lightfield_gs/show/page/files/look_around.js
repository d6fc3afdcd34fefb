// The eye goes with the mouse, a finger, or the tilt of the device; until one of them moves, it sways by itself, or rests
// in a page within another.

import { stripOf } from "./strip.js";
import { followTilt } from "./tilt.js";

const TILT_DEG = 25, SWAY_MS = 3000;
const find = (query) => document.querySelector(query);
const views = JSON.parse(find("#views").textContent), canvas = find("canvas"), slider = find("input");
const showPlace = await stripOf(canvas, views);
let isTaken = false;

function show(place) {
  const number = showPlace(place);
  slider.value = Math.min(1, Math.max(0, place));
  const count = `${number + 1} of ${views.frames.length}`;
  find("#place").textContent = views.is_within ? count : `view ${count}, from the left`;
}

function take(place) { isTaken = true; show(place); }

function sway(time) {
  if (isTaken) return;
  show(0.5 + 0.5 * Math.sin(time / SWAY_MS * Math.PI));
  requestAnimationFrame(sway);
}

document.title = find("#title").textContent = views.title;
document.body.classList.toggle("within", views.is_within);
addEventListener("pointermove", (event) => {
  if (event.target === slider) return;
  take(event.clientX / innerWidth); // the picture fills the window
});
const full = find("#full");
full.hidden = !document.fullscreenEnabled;
full.addEventListener("click", () => document.documentElement.requestFullscreen());
slider.addEventListener("input", () => take(slider.valueAsNumber));
followTilt(find("#tilt"), (across) => take(0.5 - across / (2 * TILT_DEG))); // tilted to the right, it shows what an eye on the left sees
if (views.is_within) show(0.5);
else requestAnimationFrame(sway);
