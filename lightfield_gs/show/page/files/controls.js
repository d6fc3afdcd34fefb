// The sliders: each has a name of the server's controls, a scale, and words with the unit for its value.

const logarithmic = { to: Math.log, from: Math.exp, step: 0.005 };
const linear = { to: (value) => value, from: (value) => value };

/** The sliders of a scene. low and high are values of the control, initial the one that "Reset" goes back to. */
export function sliders(scene) {
  const cone = scene.rig.cone_deg, depth = scene.rig.zero_depth;
  const eye = (value) => {
    const side = Math.abs(value) < 5e-4 ? "middle" : value < 0 ? "left" : "right";
    const angle = Math.atan(2 * Math.abs(value) * Math.tan((scene.panel.cone_deg * Math.PI) / 360)) * (180 / Math.PI);
    if (side === "middle") return "in the middle";
    const place = scene.zone_mm === null ? "" : `${(Math.abs(value) * scene.zone_mm).toFixed(0)} mm ${side}, `;
    return `${place}${angle.toFixed(1)}°${scene.zone_mm === null ? ` ${side}` : ""}`;
  };
  return [
    { name: "focus", label: "Depth in the panel's plane", low: depth / 2.5, high: depth * 2.5, initial: depth,
      scale: logarithmic, words: (value) => `${value.toPrecision(3)} units` },
    { name: "depth_amount", label: "Depth amount", low: 0, high: 2, initial: 1, scale: { ...linear, step: 0.01 },
      words: (value) => `${value.toFixed(2)} ×` },
    { name: "cone_deg", label: "Cone of the cameras", low: 1, high: Math.max(60, Math.ceil(1.5 * cone)), initial: cone,
      scale: { ...linear, step: 0.1 }, words: (value) => `${value.toFixed(1)}°` },
    { name: "zoom", label: "Zoom", low: 0.25, high: 4, initial: 1, scale: logarithmic,
      words: (value) => `${value.toFixed(2)} ×` },
    { name: "eye", label: "Eye", low: -0.5, high: 0.5, initial: 0, scale: { ...linear, step: 0.001 }, words: eye },
  ];
}

/** Builds the sliders and the choice of quality into `section`; changed() is called after each new value in state. */
export function buildControls(section, scene, state, changed) {
  const shown = sliders(scene).map((slider) => {
    const row = element("div", { className: "slider" });
    const input = element("input", { type: "range", id: slider.name, step: slider.scale.step });
    input.min = slider.scale.to(slider.low);
    input.max = slider.scale.to(slider.high);
    const output = element("output", { htmlFor: slider.name });
    row.append(element("label", { htmlFor: slider.name, textContent: slider.label }), output, input);
    section.append(row);
    const set = (value) => { state[slider.name] = value; changed(slider.name); };
    input.addEventListener("input", () => set(slider.scale.from(input.valueAsNumber)));
    input.addEventListener("dblclick", () => set(slider.initial));
    state[slider.name] = slider.initial;
    return { ...slider, input, output };
  });
  const quality = choice(section, scene.qualities, state, changed);
  const show = () => {
    for (const slider of shown) {
      slider.input.value = slider.scale.to(state[slider.name]);
      slider.output.textContent = slider.words(state[slider.name]);
    }
    quality.value = state.quality;
  };
  const reset = () => {
    for (const slider of shown) state[slider.name] = slider.initial;
    Object.assign(state, { yaw_deg: 0, pitch_deg: 0, pan_x: 0, pan_y: 0 });
  };
  return { show, reset, limits: Object.fromEntries(shown.map(({ name, low, high }) => [name, [low, high]])) };
}

function choice(section, qualities, state, changed) {
  const words = { exact: "exact", high: "high (faster)", fast: "fast (some error)", draft: "draft (fastest)" };
  const row = element("div", { className: "slider" });
  const select = element("select", { id: "quality" });
  for (const name of qualities) select.append(element("option", { value: name, textContent: words[name] ?? name }));
  select.addEventListener("change", () => { state.quality = select.value; changed("quality"); });
  row.append(element("label", { htmlFor: "quality", textContent: "Quality of the native picture" }), element("output"));
  row.append(select);
  section.append(row);
  return select;
}

export function element(tag, values = {}) {
  return Object.assign(document.createElement(tag), values);
}
