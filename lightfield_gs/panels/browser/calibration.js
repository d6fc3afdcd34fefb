// A panel from a Looking Glass calibration, visual.json: twin of lightfield_gs/panels/looking_glass.py, whose panel_fields
// has the formulas. Errors are words for the owner of the display.

const NUMBERS = ["pitch", "slope", "center", "DPI", "screenW", "screenH", "viewCone", "invView", "verticalAngle", "fringe",
  "flipImageX", "flipImageY", "flipSubp", "CellPatternMode", "subpixelCells"];
const MARKS = ["pitch", "slope", "center"]; // a mapping with two of these keys is a calibration
const VIEWS = 96, DEFAULT_CONE_DEG = 40, CELL_PATTERNS = 5, DEEPEST = 16;
const usual = new Map(NUMBERS.map((name) => [name.toLowerCase(), name]));

/** The panel of a calibration's text: {panel, notes}; throws an Error with words. */
export function panelOfCalibration(text) {
  const found = calibrations(parsed(text), 0);
  const distinct = [...new Map(found.map((one) => [JSON.stringify(one), one])).values()];
  if (distinct.length === 0) throw new Error("This is no calibration of a Looking Glass display: give its file visual.json.");
  if (distinct.length > 1) throw new Error("This file has the calibrations of several displays: give the visual.json of one.");
  return panelOf(distinct[0]);
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    throw new Error("This file is no visual.json: it cannot be read as JSON.");
  }
}

/** All calibrations within, with keys in their usual spelling and plain values. */
function calibrations(node, depth) {
  if (typeof node === "string" && /^\s*[{[]/.test(node)) return calibrations(parsed(node), depth);
  if (node === null || typeof node !== "object" || depth > DEEPEST) return [];
  if (!Array.isArray(node)) {
    const plain = Object.fromEntries(Object.entries(node).map(([key, value]) =>
      [usual.get(key.toLowerCase()) ?? key, value?.value ?? value]));
    if (MARKS.filter((key) => key in plain).length > 1) return [plain];
  }
  return Object.values(node).flatMap((part) => calibrations(part, depth + 1));
}

function number(data, key) {
  const value = typeof data[key] === "string" ? Number(data[key].trim() || "none") : data[key];
  if (typeof value !== "number" || !Number.isFinite(value)) throw new Error(`The calibration lacks a number for "${key}".`);
  return value;
}

const isSet = (data, key) => key in data && number(data, key) !== 0;

function panelOf(data) {
  const [pitch, slope, dpi, width, height] = ["pitch", "slope", "DPI", "screenW", "screenH"].map((key) => number(data, key));
  if (pitch <= 0 || dpi <= 0 || Math.abs(slope) < 0.1) throw new Error("The calibration has impossible values for the lens.");
  for (const key of ["flipImageY", "verticalAngle", "fringe"])
    if (isSet(data, key)) throw new Error(`The calibration sets "${key}", which is not known here.`);
  const mirrored = isSet(data, "flipImageX"), blueFirst = isSet(data, "flipSubp"), cells = cellsOf(data);
  if (cells.subpixel_cells && blueFirst) throw new Error('The calibration has "flipSubp" beside "subpixelCells".');
  const line_number = (3 * dpi) / (pitch * Math.cos(Math.atan(1 / slope))), slant_tan = (mirrored ? 1 : -1) / slope;
  const phase = 1.5 - 3 * (height - 0.5) * slant_tan - number(data, "center") * line_number;
  const cone = "viewCone" in data && data.viewCone !== null ? number(data, "viewCone") : 0;
  return {
    panel: {
      name: "looking-glass", width_px: width, height_px: height, views: VIEWS, line_number, slant_tan,
      phase: mirrored && !cells.subpixel_cells ? phase - 2 : phase,
      subpixel_order: mirrored !== blueFirst && !cells.subpixel_cells ? "BGR" : "RGB",
      invert_views: "invView" in data && number(data, "invView") === 0, cone_deg: cone || DEFAULT_CONE_DEG, ...cells,
    },
    notes: cone ? [] : [`The calibration does not state a viewing angle: ${DEFAULT_CONE_DEG}° are assumed.`],
  };
}

function cellsOf(data) {
  const cells = data.subpixelCells ?? [], pattern = "CellPatternMode" in data ? number(data, "CellPatternMode") : 0;
  if (!Array.isArray(cells) || !Number.isInteger(pattern) || pattern < 0 || pattern >= CELL_PATTERNS)
    throw new Error("The calibration has sub-pixels of a kind that is not known here.");
  if (!cells.length) {
    if (pattern) throw new Error('The calibration has a "CellPatternMode" without "subpixelCells".');
    return {};
  }
  const place = (cell, colour, axis) => number({ at: cell[`${colour}Offset${axis}`]?.value ?? cell[`${colour}Offset${axis}`] }, "at");
  return {
    subpixel_cells: cells.map((cell) => [..."RGB"].map((colour) => [..."XY"].map((axis) => place(cell, colour, axis)))),
    cell_pattern: pattern, cell_rule: "unity", cell_rows: "bottom",
  };
}
