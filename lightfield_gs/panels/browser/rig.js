// The cameras behind a panel: twin of lightfield_gs/panels/rig.py and look.py. A rig has the fields of Rig.to_dict and the
// size_px that its picture was framed for; matrices have their rows one after the other.

import { lensOf, plainLens } from "./lens.js";

const MARGIN = 0.15, RADIANS = Math.PI / 180;

/** The rig for a picture of another size, whose middle shows all of the picture that it was framed for. */
export function fitted(rig, width, height) {
  const [framedWidth, framedHeight] = rig.size_px;
  if (framedWidth === width && framedHeight === height) return rig;
  const scale = Math.min(width / framedWidth, height / framedHeight), [cx, cy] = rig.principal_point_px;
  const centre = [width / 2 + (cx - framedWidth / 2) * scale, height / 2 + (cy - framedHeight / 2) * scale];
  return { ...rig, focal_px: rig.focal_px.map((f) => f * scale), principal_point_px: centre, size_px: [width, height] };
}

/** The rig with its picture `zoom` times as large about the middle. */
export function zoomed(rig, zoom) {
  const centre = rig.principal_point_px.map((c, k) => rig.size_px[k] / 2 + zoom * (c - rig.size_px[k] / 2));
  return { ...rig, focal_px: rig.focal_px.map((f) => f * zoom), principal_point_px: centre };
}

/** The rig with its cameras turned around the middle of the zero plane, to the right and up; the horizon stays level. */
export function orbited(rig, yawDeg, pitchDeg) {
  const [cy, sy, cx, sx] = [yawDeg, pitchDeg].flatMap((deg) => [Math.cos(deg * RADIANS), Math.sin(deg * RADIANS)]);
  const turn = [[cy, 0, sy], [sx * sy, cx, -sx * cy], [-cx * sy, sx, cx * cy]];
  const own = [0, 1, 2].map((row) => rig.world_to_camera.slice(4 * row, 4 * row + 4)), z = rig.zero_depth;
  const turned = turn.map((row, k) => [0, 1, 2, 3].map((column) =>
    row.reduce((sum, each, m) => sum + each * (own[m][column] - (m === 2 && column === 3 ? z : 0)), 0) +
    (k === 2 && column === 3 ? z : 0)));
  return { ...rig, world_to_camera: [...turned.flat(), 0, 0, 0, 1] };
}

/** The rig of a viewer's adjustments {focus, depth_amount, cone_deg, zoom, pan_x, pan_y}: Look.applied. */
export function looked(rig, look, coneDeg) {
  const centre = zoomed(rig, look.zoom).principal_point_px.map((c, k) => c + [look.pan_x, look.pan_y][k] * rig.size_px[k]);
  const cone = look.cone_deg ?? rig.cone_deg ?? coneDeg, tangent = look.depth_amount * Math.tan((cone * RADIANS) / 2);
  return {
    ...zoomed(rig, look.zoom), principal_point_px: centre, zero_depth: look.focus ?? rig.zero_depth,
    cone_deg: (2 * Math.atan(tangent)) / RADIANS,
  };
}

/** The rig of the same picture with fewer pixels across: Rig.reduced. */
export function reduced(rig, width_px) {
  const scale = Math.min(1, width_px / rig.size_px[0]), size = rig.size_px.map((side) => Math.max(1, Math.round(side * scale)));
  const scaled = (pair) => pair.map((value, k) => (value * size[k]) / rig.size_px[k]);
  return { ...rig, focal_px: scaled(rig.focal_px), principal_point_px: scaled(rig.principal_point_px), size_px: size };
}

/** How far the eye at a place, -0.5 .. 0.5 across the viewing zone, is from the centre camera, scene units. */
export const eyeOffset = (rig, coneDeg, place) => 2 * halfWidth(rig, coneDeg) * place;

const halfWidth = (rig, coneDeg) => rig.zero_depth * Math.tan(((rig.cone_deg ?? coneDeg) * RADIANS) / 2);

function limits(rig, [width, height], coneDeg) {
  const [fx, fy] = rig.focal_px, [cx, cy] = rig.principal_point_px, widen = halfWidth(rig, coneDeg) / rig.zero_depth;
  return [
    -(cx + MARGIN * width) / fx - widen, (width - cx + MARGIN * width) / fx + widen,
    -(cy + MARGIN * height) / fy, (height - cy + MARGIN * height) / fy,
  ];
}

/** The deviation of camera positions that a view filter averages over, scene units: view_aperture. */
export const apertureOf = (panel, rig, viewFilter) => (viewFilter * 2 * halfWidth(rig, panel.cone_deg)) / panel.views / Math.sqrt(12);

/** The cameras and the lens by which a panel's sub-pixels see the scene: lenticular_camera. */
export function panelCamera(panel, rig, viewFilter) {
  const half = halfWidth(rig, panel.cone_deg), sign = panel.invert_views ? -1 : 1;
  const start = sign * 2 * half * 0.5, end = sign * 2 * half * -0.5, step = (end - start) / panel.views;
  return {
    pose: rig.world_to_camera, intrinsics: [...rig.focal_px, ...rig.principal_point_px], zero_depth: rig.zero_depth,
    limits: [...limits(rig, [panel.width_px, panel.height_px], panel.cone_deg), 0],
    lens: lensOf(panel, start, step), aperture: apertureOf(panel, rig, viewFilter),
  };
}

/** Some pixels of a panel as a panel of its own, whose sub-pixels show the same: left and top are multiples of 4. */
export function cutOut(camera, left, top, width, height) {
  const { lens, intrinsics } = camera, [start, across, below] = lens.phases;
  const first = BigInt.asUintN(64, start + BigInt(3 * left) * across + BigInt(top) * below);
  return {
    ...camera, intrinsics: [intrinsics[0], intrinsics[1], intrinsics[2] - left, intrinsics[3] - top],
    lens: { ...lens, width_px: width, height_px: height, phases: [first, across, below],
      phase: lens.phase + 3 * left + 3 * top * lens.slant_tan },
  };
}

/** The camera of an ordinary picture, `right` and `down` of the centre camera in scene units; the zero plane stays. */
export function plainCamera(rig, coneDeg, right, down, aperture = 0) {
  const [width, height] = rig.size_px, [fx, fy] = rig.focal_px, [cx, cy] = rig.principal_point_px, pose = [...rig.world_to_camera];
  pose[3] -= right;
  pose[7] -= down;
  return {
    pose, intrinsics: [fx, fy, cx + (fx / rig.zero_depth) * right, cy + (fy / rig.zero_depth) * down],
    zero_depth: rig.zero_depth, limits: [...limits(rig, rig.size_px, coneDeg), right], lens: plainLens(width, height), aperture,
  };
}
