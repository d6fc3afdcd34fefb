// Sliders with a number to type, colours and a choice: each changes one value of the state, in an owner's words and units.

import { clamp, element } from "./dom.js";

const straight = { to: (value) => value, from: (value) => value };
const logarithmic = { to: Math.log, from: Math.exp };

/** The sliders of a scene. shown, value: from the state's value to the number that is read and typed, and back. low, high:
 *  of that number, on the slider. */
function sliders(scene) {
  const percent = (whole, away = 0) => ({ unit: "%", shown: (value) => 100 * (value / whole - away), value: (read) => whole * (read / 100 + away) });
  const degrees = { unit: "°", shown: (value) => value, value: (read) => read };
  return {
    large: [
      { name: "depth_amount", label: "Depth", low: 0, high: 200, ...percent(1),
        hint: "How far things stand out of the display and lie in it. 100 % is as the picture opened, 0 % is flat." },
      { name: "focus", label: "Focus", aside: "click on the picture", low: 40, high: 250, scale: logarithmic, ...percent(scene.rig.zero_depth),
        hint: "What lies in the surface of the display, where it is sharpest. Less is nearer to you, more is farther away." },
      { name: "yaw_deg", label: "Turn", aside: "drag the picture", low: -180, high: 180, ...degrees,
        hint: "Go around the scene, to the right or to the left. A photo shows only what it has of its sides." },
      { name: "zoom", label: "Size", aside: "wheel, or two fingers", low: 25, high: 400, scale: logarithmic, ...percent(1),
        hint: "How large the picture is. 100 % is as it opened." },
    ],
    small: [
      { name: "pitch_deg", label: "Tilt", low: -89, high: 89, ...degrees, hint: "See the scene from above, or from below." },
      { name: "pan_x", label: "Move to the right", low: -100, high: 100, ...percent(1), hint: "In widths of the display. Or drag with Shift." },
      { name: "pan_y", label: "Move down", low: -100, high: 100, ...percent(1), hint: "In heights of the display. Or drag with Shift." },
      { name: "cone_deg", label: "Angle of the views", low: 1, high: Math.max(60, Math.ceil(1.5 * scene.rig.cone_deg)), ...degrees,
        hint: "How far apart the first and the last view look at the scene. Less is calmer and sharper, and less deep." },
    ],
  };
}

/** Builds the controls of a scene; show() of the answer brings them up to date with the state. */
export function buildControls(large, small, state) {
  const kinds = sliders(state.scene);
  const rows = [...kinds.large, ...kinds.small].map((kind) => slider(kind, state));
  const [first, ...others] = rows.slice(0, kinds.large.length).map((row) => row.row);
  const colours = background(state), quality = choice(state);
  large.replaceChildren(first, ...others, colours.row);
  small.replaceChildren(...rows.slice(kinds.large.length).map((row) => row.row), ...(state.scene.qualities.length ? [quality.row] : []));
  return { show: () => [...rows, colours, quality].forEach((row) => row.show()) };
}

function slider({ name, label, aside = "", unit, low, high, scale = straight, shown, value, hint }, state) {
  const described = `${name}-hint`, step = high - low > 150 || scale !== straight ? 1 : 0.5;
  const input = element("input", { type: "range", id: name, min: scale.to(low), max: scale.to(high), step: scale === straight ? step : "any" });
  const typed = element("input", { type: "number", id: `${name}-typed`, step: "any", ariaLabel: `${label}, in ${unit === "%" ? "percent" : "degrees"}` });
  input.setAttribute("aria-describedby", described);
  const set = (read) => state.set({ [name]: value(read) });
  input.addEventListener("input", () => set(scale.from(input.valueAsNumber)));
  input.addEventListener("dblclick", () => state.set({ [name]: state.first[name] }));
  input.addEventListener("keydown", (event) => { if (scale !== straight) logarithmicKey(event, state, name); });
  typed.addEventListener("change", () => Number.isFinite(typed.valueAsNumber) ? set(typed.valueAsNumber) : show());
  const show = () => {
    const read = shown(state.values[name]), words = String(Number(read.toFixed(Math.abs(read) < 100 && unit === "°" ? 1 : 0)));
    input.value = scale.to(clamp(read, low, high));
    input.setAttribute("aria-valuetext", `${words} ${unit}`);
    if (document.activeElement !== typed || typed.valueAsNumber !== read) typed.value = words;
  };
  const row = element("div", { className: "control" },
    element("label", { htmlFor: name }, label, ...(aside ? [element("small", { textContent: aside })] : [])),
    element("span", { className: "typed" }, typed, element("i", { textContent: unit, ariaHidden: "true" })), input,
    element("span", { className: "hint", id: described, textContent: hint, role: "tooltip" }));
  return { row, show };
}

/** Arrow keys on a slider without steps: by 2 percent. */
function logarithmicKey(event, state, name) {
  const by = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
  if (!by) return;
  event.preventDefault();
  state.set({ [name]: state.values[name] * 1.02 ** by });
}

/** The colours behind the picture. */
function background(state) {
  const own = element("button", { className: "own", textContent: "As it is", type: "button" });
  const colours = [["White", "#ffffff"], ["Grey", "#808080"], ["Black", "#000000"]].map(([label, colour]) => {
    const button = element("button", { ariaLabel: label, title: label, type: "button" });
    button.style.background = colour;
    return [button, colour];
  });
  const other = element("input", { type: "color", ariaLabel: "Another colour", title: "Another colour" });
  for (const [button, colour] of [[own, ""], ...colours]) button.addEventListener("click", () => { state.set({ background: colour }); state.commit(); });
  other.addEventListener("input", () => state.set({ background: other.value }));
  const show = () => {
    const now = state.values.background;
    for (const [button, colour] of [[own, ""], ...colours]) button.setAttribute("aria-pressed", now === colour);
    other.value = now || state.scene.background;
  };
  const row = element("div", { className: "control", role: "group", ariaLabel: "Background" },
    element("span", { className: "label", textContent: "Background" }), element("span"),
    element("div", { className: "colours" }, own, ...colours.map(([button]) => button), other));
  return { row, show };
}

function choice(state) {
  const words = { exact: "exact", high: "high, faster", fast: "fast, with some error", draft: "draft, fastest" };
  const select = element("select", { id: "quality" }, ...state.scene.qualities.map((value) => element("option", { value, textContent: words[value] ?? value })));
  select.addEventListener("change", () => state.set({ quality: select.value }));
  const row = element("div", { className: "control" },
    element("label", { htmlFor: "quality", textContent: "Quality of the picture for the display" }), element("span"), select);
  return { row, show: () => { select.value = state.values.quality; } };
}

/** Shows the hint of a control beside it, under the mouse or with the focus of the keyboard; Esc hides it. */
export function showHints(room) {
  let shown = null;
  const hide = () => { shown?.classList.remove("shown"); shown = null; };
  const showFor = (target) => {
    const control = target.closest?.(".control"), hint = control?.querySelector(".hint");
    if (hint === shown) return;
    hide();
    if (!hint) return;
    const { left, top } = control.getBoundingClientRect(), beside = left > hint.offsetWidth + 20;
    hint.style.left = `${beside ? left - hint.offsetWidth - 14 : left}px`;
    hint.style.top = `${Math.max(4, beside ? top : top - hint.offsetHeight - 6)}px`;
    hint.classList.add("shown");
    shown = hint;
  };
  room.addEventListener("pointerover", (event) => { if (event.pointerType === "mouse") showFor(event.target); });
  room.addEventListener("pointerleave", hide);
  room.addEventListener("focusin", (event) => { if (event.target.matches(":focus-visible")) showFor(event.target); });
  room.addEventListener("focusout", hide);
  addEventListener("keydown", (event) => { if (event.key === "Escape") hide(); });
}
