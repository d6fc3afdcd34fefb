// Whether a picture on the screen is the panel's, pixel for pixel; and how it gets there.

/** What keeps the browser's pixels from being the panel's, in words with what to do; [] where nothing does. */
export function reasons(panel, measures) {
  const found = [], { ratio, pinch, screen, window, place } = measures;
  const near = (a, b) => Math.abs(a - b) < 1;
  const isPanel = near(screen.width * ratio, panel.width_px) && near(screen.height * ratio, panel.height_px);
  const atLeast = (a, b) => a > b - 1;
  const covers = atLeast(window.width * ratio, screen.width * ratio) && atLeast(window.height * ratio, screen.height * ratio) &&
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

export function measured() {
  return {
    ratio: devicePixelRatio,
    pinch: visualViewport?.scale ?? 1,
    screen: { width: screen.width, height: screen.height },
    window: { width: innerWidth, height: innerHeight },
    place: { x: Math.round(scrollX), y: Math.round(scrollY) },
  };
}

export function measuresInWords({ ratio, screen, window, pinch }) {
  return `A pixel of the page is ${Number(ratio.toFixed(3))} of the screen; the screen has ${screen.width} × ${screen.height} of the page, ` +
    `the window ${window.width} × ${window.height}; pinched to ${percent(pinch)}.`;
}

const percent = (share) => `${Math.round(100 * share)} %`;

/** Full screen on the screen that is the panel, where the browser tells its screens apart; else on this one. */
export async function fullScreen(panel) {
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
