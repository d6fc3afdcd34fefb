// Pictures of the server: how they come, and how they are laid into their panes.

import { answerOf, element } from "./dom.js";

/** A picture with what it is and the times of its stages, [name, milliseconds]. */
export async function pictureOf(address, signal) {
  const answer = await answerOf(address, signal);
  const bitmap = await createImageBitmap(await answer.blob());
  return { bitmap, said: answer.headers.get("X-Picture"), stages: timing(answer.headers.get("Server-Timing")) };
}

function timing(header) {
  return (header ?? "").split(", ").filter(Boolean).map((part) => {
    const [name, milliseconds] = part.split(";dur=");
    return [name, Number(milliseconds)];
  });
}

export function show(pane, { bitmap }) {
  const canvas = pane.querySelector("canvas");
  canvas.width = bitmap.width;
  canvas.height = bitmap.height;
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  bitmap.close();
}

/** Lays out a pane's picture: native pixels at one pixel of the screen each; others as large as the pane, `shape` times
 *  as wide as high (null: as they are). */
export function fit(pane, shape) {
  const canvas = pane.querySelector("canvas"), room = pane.querySelector(".picture");
  let width = canvas.width / devicePixelRatio, height = canvas.height / devicePixelRatio;
  if (pane.dataset.pane !== "native") {
    const across = shape ?? width / height;
    width = Math.min(room.clientWidth, room.clientHeight * across);
    height = width / across;
  }
  canvas.style.width = `${width}px`;
  canvas.style.height = `${height}px`;
}

/** Fills the body of a table with the times of stages and their sum. */
export function showTimes(body, stages) {
  const row = (name, milliseconds, kind) => {
    const line = element("tr", { className: kind });
    const words = milliseconds < 10 ? milliseconds.toFixed(1) : milliseconds.toFixed(0);
    line.append(element("td", { textContent: name }), element("td", { textContent: `${words} ms` }));
    return line;
  };
  const sum = stages.reduce((total, [, milliseconds]) => total + milliseconds, 0);
  body.replaceChildren(...stages.map((stage) => row(...stage, "")), row("together", sum, "sum"));
}
