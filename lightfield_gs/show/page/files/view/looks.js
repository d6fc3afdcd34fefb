// Looks that are kept for all pictures: the program has them, since a page at another port has no memory of this one.

import { answerOf, element, find, post } from "./dom.js";

const PLAIN = ["depth_amount", "zoom", "pan_x", "pan_y", "yaw_deg", "pitch_deg", "background"];

/** The look of a state: the focus in distances of the scene's own, the angle of the views only where it was changed. */
function lookOf({ values, first }) {
  const look = Object.fromEntries(PLAIN.map((name) => [name, values[name]]));
  look.focus = values.focus / first.focus;
  return values.cone_deg === first.cone_deg ? look : { ...look, cone_deg: values.cone_deg };
}

function apply(look, state) {
  const values = Object.fromEntries(PLAIN.map((name) => [name, look[name] ?? state.first[name]]));
  state.set({ ...values, focus: (look.focus ?? 1) * state.first.focus, cone_deg: look.cone_deg ?? state.first.cone_deg });
  state.commit();
}

export async function buildLooks(state, told) {
  const change = async (what, values) => {
    try {
      show(await (await post(`looks/${what}`, state.scene.token, values)).json());
    } catch (error) {
      told.say(error.message);
    }
  };
  const show = (looks) => {
    const items = Object.entries(looks).map(([name, look]) => {
      const use = element("button", { textContent: name, title: `Show the picture so: ${name}` });
      const remove = element("button", { textContent: "×", ariaLabel: `Remove the look ${name}`, title: "Remove" });
      use.addEventListener("click", () => apply(look, state));
      remove.addEventListener("click", () => change("remove", { name }));
      return element("li", {}, use, remove);
    });
    find("#kept").replaceChildren(...(items.length ? items : [element("li", { className: "none", textContent: "None is kept yet." })]));
  };
  find("#keep").addEventListener("submit", (event) => {
    event.preventDefault();
    const name = find("#look-name").value.trim();
    if (!name) return;
    change("keep", { name, look: JSON.stringify(lookOf(state)) });
    find("#look-name").value = "";
    told.say(`Kept: ${name}`);
  });
  find("#looks").hidden = false;
  try {
    show(await (await answerOf("looks.json")).json());
  } catch (error) {
    show({});
    told.say(error.message);
  }
}
