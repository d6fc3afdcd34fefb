// Files to save of what is shown, and the command line that makes the same picture.

import { answerOf, element, find } from "./dom.js";

const words = (name) => name === "native.png" ? "Picture for the display" : name.startsWith("eyes") ? "Picture of both eyes" :
  name.startsWith("quilt") ? "Quilt, for Looking Glass programs" : "Camera positions";

export function buildSaving(state, told) {
  const { exports, commands } = state.scene;
  const links = exports.map((name) => element("a", { className: "button", textContent: words(name), download: "" }));
  find("#exports").replaceChildren(...links.map((link) => element("li", {}, link)));
  find("#commanding").hidden = !commands;
  find("#saving").hidden = !commands && !exports.length;
  find("#copy").onclick = async () => {
    try {
      await navigator.clipboard.writeText(find("#command").textContent);
      told.say("The command is copied.");
    } catch {
      getSelection().selectAllChildren(find("#command")); // not allowed, or no https: copied by hand
      told.say("The command is selected: copy it with Ctrl + C.");
    }
  };
  find("#saving").ontoggle = show;

  async function show() {
    const query = new URLSearchParams(state.controls);
    for (const [place, link] of links.entries()) link.href = `export/${exports[place]}?${query}`;
    if (!commands || !find("#saving").open) return;
    const { words: command } = await (await answerOf(`command.json?${query}`)).json();
    find("#command").textContent = command;
    find("#command-needs").hidden = !state.scene.film && !state.values.yaw_deg && !state.values.pitch_deg;
  }

  return { show };
}
