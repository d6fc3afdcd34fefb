// The stages in WGSL, fitted to a kind of frame: twin of lightfield_gs/webgpu/shaders.py, whose tables come with the page:
// {files: {name: text}, stages: {name: {files, bindings}}, bindings: {name: [number, type]}}. csrc/webgpu/frame.wgsl has
// the meanings of a variant: {ordinals, cells, bgr, harmonics, compensated}.

const TILE_SAMPLES = 6; // of a thread, in tiles of pixels

/** The WGSL of a stage for a kind of frame. */
export function source(shaders, stage, variant) {
  let text = constants(variant) + shaders.stages[stage].files.map((name) => shaders.files[name]).join("\n");
  for (const [name, kept] of [["floats", false], ["bytes", true], ["pixels", !variant.ordinals]])
    text = text.replace(block(name), kept ? "$1" : "");
  const samples = variant.ordinals || TILE_SAMPLES;
  return text.replace(block("q"), (_, lines) => repeated(lines, samples));
}

/** The variant without what a stage does not depend on, so that more frames share its pipeline; and a name for it. */
export function variantOf(stage, variant) {
  const none = { ordinals: 0, cells: false, bgr: false, harmonics: false, compensated: false };
  if (stage === "composite") return variant;
  if (stage === "project") return { ...variant, ordinals: 0, cells: false, bgr: false };
  if (stage === "pattern") return { ...none, cells: variant.cells, bgr: variant.bgr };
  return { ...none, ordinals: variant.ordinals };
}

const block = (name) => new RegExp(`[ ]*//\\{${name}\\n([^]*?)[ ]*//${name}\\}\\n`, "g");

function constants({ ordinals, cells, bgr, harmonics, compensated }) {
  const words = { BY_LENS: ordinals > 0, CELLS: cells, BGR: bgr, HARMONICS: harmonics, COMPENSATED: compensated, FLOATS: false, ENDS_EARLY: false };
  const lines = Object.entries(words).map(([name, value]) => `const ${name} = ${value};`);
  return [...lines, `const ORDINALS = ${Math.max(ordinals, 1)};`, ""].join("\n");
}

/** Lines once for each sample: q becomes its number, and x[q] a variable of its own. */
function repeated(lines, count) {
  const copies = [];
  for (let q = 0; q < count; q++)
    copies.push(lines.replace(/\b([A-Za-z]\w*)\[q\]/g, `$1_${q}`).replace(/\bq\b/g, String(q)));
  return copies.join("");
}
