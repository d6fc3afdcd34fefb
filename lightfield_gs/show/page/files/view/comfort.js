// Whether the depth is easy on the eyes, in an owner's words, and the button that makes it so.

import { answerOf, element, find } from "./dom.js";

const EMPTY = 0.02; // of the outermost views: what shows (lightfield_gs/panels/visibility.py)

/** Builds the card, and returns measure(), which asks how deep the picture is. */
export function buildComfort(state) {
  const title = element("strong"), words = element("span"), button = element("button", { id: "make-comfortable", textContent: "Make it comfortable" });
  const card = element("div", { id: "comfort" }, element("p", { role: "status" }, title, words), button);
  let report = null;
  button.addEventListener("click", () => {
    state.set({ depth_amount: Math.floor(100 * state.values.depth_amount * report.amount) / 100 });
    state.commit();
  });

  function show() {
    const strains = report?.comfortable === false, known = report && report.comfortable !== null;
    card.dataset.state = !known ? "unknown" : strains ? "strain" : "good";
    button.disabled = !strains || report.amount === null;
    title.textContent = !report ? "Nothing can be seen from here." : !known ? "Comfort is not known." : strains ? "Too deep for the eyes." : "Comfortable for the eyes.";
    words.textContent = !report ? "" : known ? `${reach(report)}${edges(report)}` : "The size of the display, or your distance from it, is missing in its calibration.";
    find("#depth").replaceChildren(...(report ? details(report) : []).map((textContent) => element("li", { textContent })));
  }

  async function measure(signal) {
    try {
      report = await (await answerOf(`depth.json?${new URLSearchParams(state.controls)}`, signal)).json();
    } catch (error) {
      if (error.status !== 400) throw error;
      report = null;
    }
    show();
  }

  card.dataset.state = "unknown";
  button.disabled = true;
  title.textContent = "Measuring the depth…";
  return { card, measure };
}

const length = (millimetres) => Math.abs(millimetres) < 9.5 ? `${Math.abs(millimetres).toFixed(0)} mm` : `${(Math.abs(millimetres) / 10).toFixed(0)} cm`;

const side = ({ behind_mm }) => behind_mm === null ? "endlessly far behind" : `${length(behind_mm)} ${behind_mm < 0 ? "before" : "behind"}`;

const reach = ({ near, far }) => `It reaches from ${side(near)} to ${side(far)} the display.`;

const edges = ({ unseen }) => Math.max(...unseen) <= EMPTY ? "" : " Its edges are empty from far aside: larger or less deep is better.";

function details({ near, far, sharp_mm: [before, behind], unseen, near: { angle_deg } }) {
  const turned = (degrees) => `${Math.abs(degrees).toFixed(2)}° ${degrees < 0 ? "before" : "behind"} the surface`;
  const sharp = before === null ? [] : [`Sharp from ${length(before)} out of the display to ${behind === null ? "any depth" : `${length(behind)} into it`}.`];
  const angles = angle_deg === null ? [] : [`For the eyes the nearest is ${turned(near.angle_deg)}, the farthest ${turned(far.angle_deg)}. Up to 1° is comfortable.`];
  const spread = `From the middle to the last view the nearest moves by ${Math.abs(near.edge_px).toFixed(0)} pixels, the farthest by ${Math.abs(far.edge_px).toFixed(0)}.`;
  const empty = `Empty from the far left: ${(100 * unseen[0]).toFixed(1)} %, from the far right: ${(100 * unseen[1]).toFixed(1)} %.`;
  return [...angles, ...sharp, spread, empty];
}
