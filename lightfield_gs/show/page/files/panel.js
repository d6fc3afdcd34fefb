// The native picture at one pixel of the panel each, from the panel's first pixel on; and a loud word where it is not.

import { checkPixels, lay, watchPixels } from "./pixel_word.js";

const find = (query) => document.querySelector(query);
let panel = null;

function check() {
  if (panel === null) return;
  lay(find("#picture"), panel);
  checkPixels(panel);
}

// The picture, and the next one as soon as there is one

let drawing = null, drawnScene; // what draws here, null: the server does; and the number of its scene
const canvas = Object.assign(document.createElement("canvas"), { id: "picture", role: "img", ariaLabel: find("#picture").alt });

/** Draws the controls of a scene here; false where the server must. */
async function drawHere(controls) {
  if (drawnScene !== controls.scene) {
    drawing?.close();
    drawing = await (await import("./drawing.js")).openDrawing(canvas);
    drawnScene = controls.scene;
  }
  if (!drawing || drawing.isLost) return false;
  await drawing.onPanel(controls);
  place(canvas);
  document.body.dataset.draws = "here";
  return true;
}

/** Places the server's picture, which may be newer than the one asked for, and returns its version. */
async function fetched(version) {
  const answer = await fetch(`panel.png?version=${version}`);
  if (!answer.ok) throw new Error(answer.statusText);
  const url = URL.createObjectURL(await answer.blob());
  const next = Object.assign(new Image(), { src: url, id: "picture", alt: find("#picture").alt });
  await next.decode().finally(() => URL.revokeObjectURL(url));
  place(next);
  document.body.dataset.draws = "server";
  return Number(answer.headers.get("X-Version"));
}

function place(picture) {
  if (find("#picture") !== picture) find("#picture").replaceWith(picture);
}

async function follow() {
  let version = -1;
  for (;;) {
    try {
      const answer = await (await fetch(`panel.json?after=${version}`)).json();
      if (answer.version !== version) {
        const isDrawn = answer.controls && (await drawHere(answer.controls));
        const shown = isDrawn ? answer.version : await fetched(answer.version);
        document.title = `${answer.name} · lightfield-gs`;
        [panel, version] = [answer, shown];
        document.body.dataset.version = version;
        check();
      }
    } catch {
      await new Promise((done) => setTimeout(done, 1000)); // the program has ended, or begins again
    }
  }
}

let wanted = null, isMoving = false;

/** Follows the hand at once, where this browser draws and shows the page that steers. */
new BroadcastChannel("lightfield-gs view").addEventListener("message", async ({ data }) => {
  wanted = data;
  if (isMoving || !drawing) return;
  isMoving = true;
  try {
    while (wanted) {
      const now = wanted;
      wanted = null;
      await drawHere(now);
    }
  } finally {
    isMoving = false;
  }
});

watchPixels(check, () => panel);
follow();
