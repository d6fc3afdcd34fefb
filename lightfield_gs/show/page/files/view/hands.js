// Mouse, fingers and keys on the pictures.

import { answerOf, clamp, element, find } from "./dom.js";

const DEGREES_A_PX = 0.3, CLICK_PX = 5;
const KEYS = { turn_deg: 5, move: 0.02, zoom: 1.05, eye: 0.02, native: 0.02 };

export function listen(state, frames, panes, told) {
  for (const [name, pane] of Object.entries(panes)) {
    const room = pane.querySelector(".picture"), hand = new Hand(name, room, state, frames, told);
    for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel"]) room.addEventListener(kind, (event) => hand[kind](event));
    room.addEventListener("wheel", (event) => {
      event.preventDefault();
      state.set({ zoom: state.values.zoom * Math.exp(-event.deltaY / 800) });
    }, { passive: false });
    room.addEventListener("contextmenu", (event) => event.preventDefault());
    room.addEventListener("keydown", (event) => { if (key(name, event, hand, state)) event.preventDefault(); });
  }
}

class Hand {
  constructor(name, room, state, frames, told) {
    Object.assign(this, { name, room, state, frames, told, fingers: new Map(), gone: 0 });
  }

  pointerdown(event) {
    this.room.setPointerCapture(event.pointerId);
    this.room.classList.add("held");
    this.fingers.set(event.pointerId, event);
    this.gone = this.fingers.size > 1 ? Infinity : 0; // two fingers are no click
    this.frames.isHeld = true;
  }

  pointerup(event) {
    const isClick = this.fingers.has(event.pointerId) && this.gone < CLICK_PX && event.button === 0 && !event.shiftKey;
    this.pointercancel(event);
    if (isClick && this.name === "eye") this.focusAt(event.clientX, event.clientY);
    else this.state.commit();
  }

  pointercancel(event) {
    this.fingers.delete(event.pointerId);
    if (this.fingers.size) return;
    this.room.classList.remove("held");
    this.frames.isHeld = false;
  }

  pointermove(event) {
    const before = this.fingers.get(event.pointerId);
    if (!before) {
      if (event.pointerType === "mouse" && this.name === "eye") this.look(event);
      return;
    }
    const across = event.clientX - before.clientX, down = event.clientY - before.clientY;
    this.gone = Math.max(this.gone, Math.hypot(across, down));
    if (this.gone < CLICK_PX) return;
    if (this.fingers.size === 2) this.pinch(before, event);
    else if (this.name === "native") this.moveNative(across, down);
    else if (event.shiftKey || event.buttons === 2) this.move(across, down);
    else this.turn(across * DEGREES_A_PX, down * DEGREES_A_PX);
    this.fingers.set(event.pointerId, event);
  }

  get box() { return this.room.querySelector("canvas").getBoundingClientRect(); }

  look(event) {
    const { left, width } = this.box;
    this.state.set({ eye: (event.clientX - left) / width - 0.5 });
  }

  turn(across, down) {
    const { yaw_deg, pitch_deg } = this.state.values;
    this.state.set({ yaw_deg: ((yaw_deg - across + 540) % 360) - 180, pitch_deg: clamp(pitch_deg + down, -89, 89) });
  }

  move(across, down) {
    const { width, height } = this.box, { pan_x, pan_y } = this.state.values;
    this.state.set({ pan_x: pan_x + across / width, pan_y: pan_y + down / height });
  }

  moveNative(across, down) {
    const { panel } = this.state.scene, { frames } = this;
    frames.x = clamp(frames.x - (across * devicePixelRatio) / panel.width_px, 0, 1);
    frames.y = clamp(frames.y - (down * devicePixelRatio) / panel.height_px, 0, 1);
    this.state.changed();
  }

  /** Two fingers: nearer by their distance, and moved by their middle. */
  pinch(before, event) {
    const other = [...this.fingers.values()].find(({ pointerId }) => pointerId !== event.pointerId);
    const apart = (one) => Math.max(10, Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY));
    const { width, height } = this.box, { zoom, pan_x, pan_y } = this.state.values;
    this.state.set({
      zoom: (zoom * apart(event)) / apart(before), pan_x: pan_x + (event.clientX - before.clientX) / 2 / width,
      pan_y: pan_y + (event.clientY - before.clientY) / 2 / height,
    });
  }

  /** Makes what is seen at a point of the window the sharpest. */
  async focusAt(clientX, clientY) {
    const { left, top, width, height } = this.box, outer = this.room.getBoundingClientRect();
    const point = { x: (clientX - left) / width, y: (clientY - top) / height };
    if (point.x < 0 || point.x > 1 || point.y < 0 || point.y > 1) return;
    const ring = element("span", { className: "focused" });
    Object.assign(ring.style, { left: `${clientX - outer.left}px`, top: `${clientY - outer.top}px` });
    ring.addEventListener("animationend", () => ring.remove());
    this.room.append(ring);
    try {
      const answer = await answerOf(`focus.json?${new URLSearchParams({ ...this.state.controls, ...point })}`);
      this.state.set({ focus: (await answer.json()).focus });
      this.state.commit();
    } catch (error) {
      this.told.say(error.status === 400 ? "There is nothing at this place that could be sharp." : error.message);
    }
  }

  focusMiddle() {
    const { left, top, width, height } = this.box;
    this.focusAt(left + width / 2, top + height / 2);
  }
}

/** Does what a key asks for, and returns whether it asks for anything. */
function key(name, event, hand, state) {
  if (event.ctrlKey || event.metaKey || event.altKey) return false;
  const across = { ArrowLeft: -1, ArrowRight: 1 }[event.key] ?? 0, down = { ArrowUp: -1, ArrowDown: 1 }[event.key] ?? 0;
  const size = { "+": 1, "=": 1, "-": -1, "−": -1 }[event.key], eye = { ",": -1, ".": 1 }[event.key];
  if (across || down) {
    if (name === "native") hand.moveNative(-across * KEYS.native * state.scene.panel.width_px, -down * KEYS.native * state.scene.panel.height_px);
    else if (event.shiftKey) state.set({ pan_x: state.values.pan_x + across * KEYS.move, pan_y: state.values.pan_y + down * KEYS.move });
    else hand.turn(across * KEYS.turn_deg, down * KEYS.turn_deg); // as dragging would
  } else if (size) state.set({ zoom: state.values.zoom * KEYS.zoom ** size });
  else if (eye) state.set({ eye: state.values.eye + eye * KEYS.eye });
  else if (event.key === "Enter" && name === "eye") hand.focusMiddle();
  else return false;
  return true;
}

/** Undo and redo by their keys, but in fields that have their own. */
export function listenToHistory(state) {
  addEventListener("keydown", (event) => {
    if (!(event.ctrlKey || event.metaKey) || event.altKey || event.target.matches?.("input:not([type=range])")) return;
    const letter = event.key.toLowerCase();
    if (letter !== "z" && letter !== "y") return;
    event.preventDefault();
    if (letter === "y" || event.shiftKey) state.redo();
    else state.undo();
  });
  find("#undo").addEventListener("click", () => state.undo());
  find("#redo").addEventListener("click", () => state.redo());
  find("#reset").addEventListener("click", () => state.reset());
}
