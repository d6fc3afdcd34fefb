// Mouse, fingers, keys and the tilt of the device turn the scene.

import { followTilt } from "../../page/files/tilt.js";

const DEGREES_A_PX = 0.3, KEY_DEG = 3, KEY_ZOOM = 1.1, WHEEL_PX = 800, LEAST_TILT_DEG = 0.3;

/** Listens to hands on these canvases; `keys` has what else keys do, by key. */
export function listen(state, canvases, tiltButton, keys) {
  for (const canvas of canvases) dragged(state, canvas);
  addEventListener("keydown", (event) => pressed(state, event, keys));
  let before = null;
  followTilt(tiltButton, (across, along) => {
    if (before && Math.hypot(across - before[0], along - before[1]) < LEAST_TILT_DEG) return;
    if (before) stopped(state).turn(-(across - before[0]), along - before[1]);
    before = [across, along];
  });
}

/** The state, once it has stopped to turn by itself. */
function stopped(state) {
  if (state.turnsItself) state.setItself(false);
  return state;
}

function dragged(state, canvas) {
  const fingers = new Map();
  const apart = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const finger = fingers.get(event.pointerId);
    if (!finger) return;
    const before = fingers.size === 2 ? apart() : 0, x = event.clientX - finger.x, y = event.clientY - finger.y;
    Object.assign(finger, { x: event.clientX, y: event.clientY });
    if (fingers.size === 2) stopped(state).magnify(apart() / Math.max(before, 1));
    else stopped(state).turn(-x * DEGREES_A_PX, y * DEGREES_A_PX);
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    state.magnify(Math.exp(-event.deltaY / WHEEL_PX));
  }, { passive: false });
}

function pressed(state, event, keys) {
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  const onButton = event.target.closest?.("button, label, input");
  const turns = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const own = {
    "+": () => state.magnify(KEY_ZOOM), "=": () => state.magnify(KEY_ZOOM), "-": () => state.magnify(1 / KEY_ZOOM),
    "0": () => state.reset(), Home: () => state.reset(), ...keys,
  };
  if (turns[event.key]) stopped(state).turn(...turns[event.key].map((way) => way * KEY_DEG));
  else if (own[event.key] && !(onButton && event.key === " ")) own[event.key]();
  else return;
  event.preventDefault();
}
