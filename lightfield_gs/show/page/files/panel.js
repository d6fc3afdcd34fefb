// The native picture at one pixel of the panel each, from the panel's first pixel on; and a loud word where it is not.

import { fullScreen, measured, measuresInWords, reasons } from "./display.js";

const find = (query) => document.querySelector(query);
let panel = null, isHidden = false;

function check() {
  if (panel === null) return;
  const picture = find("#picture");
  // The halves of a stereo picture fill the screen, whatever its pixels
  picture.style.width = panel.fills ? "100vw" : `${panel.width_px / devicePixelRatio}px`;
  picture.style.height = panel.fills ? "100vh" : `${panel.height_px / devicePixelRatio}px`;
  const now = measured(), found = reasons(panel, now);
  find("#word").hidden = isHidden || found.length === 0;
  document.body.dataset.exact = found.length === 0;
  find("#reasons").replaceChildren(...found.map((words) => Object.assign(document.createElement("li"), { textContent: words })));
  find("#measures").textContent = measuresInWords(now);
}

// The picture, and the next one as soon as there is one

async function follow() {
  let version = -1;
  for (;;) {
    try {
      const answer = await (await fetch(`panel.json?after=${version}`)).json();
      if (answer.version !== version) {
        const next = Object.assign(new Image(), { src: `panel.png?version=${answer.version}` });
        await next.decode();
        next.id = "picture";
        next.alt = find("#picture").alt;
        find("#picture").replaceWith(next);
        document.title = `${answer.name} · lightfield-gs`;
        [panel, version] = [answer, answer.version];
        check();
      }
    } catch {
      await new Promise((done) => setTimeout(done, 1000)); // the program has ended, or begins again
    }
  }
}

for (const event of ["resize", "fullscreenchange", "focus"]) addEventListener(event, check);
visualViewport?.addEventListener("resize", check);
setInterval(check, 1000); // a window moved to another screen tells nothing
find("#full").addEventListener("click", () => fullScreen(panel));
find("#hide").addEventListener("click", () => { isHidden = true; check(); });
document.addEventListener("dblclick", () => fullScreen(panel));
follow();
