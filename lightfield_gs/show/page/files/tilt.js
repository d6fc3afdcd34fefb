// The tilt of a phone or a tablet in the hand.

/** Calls `take(across, along)` with degrees to the right and to the top, whenever the device is tilted. */
function follow(take) {
  addEventListener("deviceorientation", ({ beta, gamma }) => {
    if (gamma === null) return;
    const angle = screen.orientation?.angle ?? 0;
    if (angle === 90) take(beta, -gamma);
    else if (angle === 270) take(-beta, gamma);
    else take(gamma, beta);
  });
}

/** Follows the tilt; iOS asks first, and only after a touch: `button` then shows itself for it. */
export function followTilt(button, take) {
  if (typeof DeviceOrientationEvent?.requestPermission !== "function") return follow(take);
  button.hidden = !matchMedia("(pointer: coarse)").matches;
  button.addEventListener("click", async () => {
    if (await DeviceOrientationEvent.requestPermission() !== "granted") return;
    follow(take);
    button.hidden = true;
  });
}
