// The native picture at one pixel of the panel each, from the panel's first pixel on; and a loud word where it is not.

const find = (query) => document.querySelector(query);
let panel = null, isHidden = false;

// Is it pixel for pixel?

/** What keeps the browser's pixels from being the panel's, in words with what to do; [] where nothing does. */
export function reasons(panel, measures) {
  const found = [], { ratio, pinch, screen, window, place } = measures;
  const near = (a, b) => Math.abs(a - b) < 1;
  const isPanel = near(screen.width * ratio, panel.width_px) && near(screen.height * ratio, panel.height_px);
  const covers = near(window.width * ratio, screen.width * ratio) && near(window.height * ratio, screen.height * ratio) &&
    place.x === 0 && place.y === 0;
  if (panel.fills) return covers ? [] : ["The window does not cover the screen: press the button below, or F11."];
  const size = `${panel.width_px} × ${panel.height_px}`;
  if (pinch !== 1) found.push(`The page is pinched to ${percent(pinch)}: pinch it back to 100 %.`);
  if (ratio % 1 !== 0)
    found.push(`A pixel of the page is ${Number(ratio.toFixed(3))} pixels of the screen: set the zoom of the browser to 100 % ` +
      "(Ctrl + 0), and the scaling of this display to 100 % in the settings of the system.");
  if (!isPanel)
    found.push(`This screen has ${Math.round(screen.width * ratio)} × ${Math.round(screen.height * ratio)} pixels, ` +
      `the panel ${panel.name} has ${size}: move this window to the panel, set the panel to ${size}, and the zoom of the ` +
      "browser to 100 % (Ctrl + 0).");
  if (!covers)
    found.push("The window does not cover the screen, so that the picture is not where the lenses expect it: press the " +
      "button below, or F11.");
  return found;
}

function measured() {
  return {
    ratio: devicePixelRatio,
    pinch: visualViewport?.scale ?? 1,
    screen: { width: screen.width, height: screen.height },
    window: { width: innerWidth, height: innerHeight },
    place: { x: Math.round(scrollX), y: Math.round(scrollY) },
  };
}

const percent = (share) => `${Math.round(100 * share)} %`;

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
  find("#measures").textContent = `devicePixelRatio ${now.ratio}, screen ${now.screen.width} × ${now.screen.height}, ` +
    `window ${now.window.width} × ${now.window.height}, pinch ${percent(now.pinch)}`;
}

/** Full screen on the screen that is the panel, where the browser tells its screens apart; else on this one. */
async function fullScreen() {
  const options = { navigationUI: "hide" };
  try {
    const { screens } = await getScreenDetails();
    const isPanel = (one) => Math.abs(one.width * one.devicePixelRatio - panel.width_px) < 1 &&
      Math.abs(one.height * one.devicePixelRatio - panel.height_px) < 1;
    options.screen = screens.find(isPanel);
  } catch {
    // Not known here, or not allowed: the word says to move the window.
  }
  await document.documentElement.requestFullscreen(options);
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
find("#full").addEventListener("click", fullScreen);
find("#hide").addEventListener("click", () => { isHidden = true; check(); });
document.addEventListener("dblclick", fullScreen);
follow();
