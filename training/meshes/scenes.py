"""Random scenes of meshes in numbers: objects, their places and looks, lights, and the cameras of every picture.

A plan is made on the host and takes some hundred kilobytes; the pictures follow from it on the device. A scene has one
to four objects, upright and apart, in one box of unit diagonal. The source camera looks at its middle from anywhere
round it, DISTANCE away. A smaller scene is the same as one that is further away under a narrower field of view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.models.crop import MARGIN
from training.data.procedural_plan import DISTANCE, GROUPS, draw_looks, orbit, rotation
from training.data.textures import SKIN, Photographs, draw_skin
from training.data.uniform import Numbers
from training.meshes.pack import ResidentMeshes
from training.meshes.rasterize import list_draws
from training.meshes.render import Looks, Scene, Shadows, render_images, render_shadow_maps
from training.meshes.shade import LIGHT, OWN
from training.ranges import check_ranges

MOST_OBJECTS = 4
SCENE_NUMBERS, OBJECT_NUMBERS = 64, 320  # uniform numbers that a scene and each of its objects take, at most
_VIEWS_NUMBERS = 2  # of each target
_HALF_LENGTH = 0.3  # of an object, for the waves of its pattern
_UPRIGHT = np.diag([1.0, -1.0, -1.0])  # from axes with y up, z backwards to those with y down, z forward
KEY = slice(LIGHT["ambient"], LIGHT["ambient"] + LIGHT["key"])  # columns of the direction to the key light
# Of the light of the project's sets: its strength all round, then the direction and the strength of each light
_AMBIENT, _KEY, _FILL = 0.45, ((0.35, 0.8, 0.5), 0.55), ((-0.6, 0.3, -0.4), 0.2)


@dataclass(frozen=True)
class MeshOptions:
    """Examples rendered from meshes, new ones in every step.

    Args:
        folder: folder of mesh packs with their index; objects of its split "train" are drawn. "": none.
        fraction: fraction of the examples of each step, 0..1, that show meshes.
        objects_per_scene: how often a scene has one, two, three and four objects, relative to each other.
        scale: range of the diagonal of a scene's box, scene units; smaller scenes are seen under less perspective.
        random_light: fraction of the scenes, 0..1, under a random light; others have that of the project's sets.
        patterned: fraction of the objects, 0..1, in random colours and solid patterns.
        photographed: fraction of the objects, 0..1, that wear pieces of the run's photographs, where there are some.
        shadows: fraction of the scenes, 0..1, whose key light throws soft shadows.
        towards_centre: exponent of the targets' distances from the source within the cone, 1..10. With 1 all directions
            are alike, with larger ones targets are nearer to the source.
    """

    folder: str = ""
    fraction: float = 1.0
    objects_per_scene: tuple[float, float, float, float] = (0.6, 0.2, 0.1, 0.1)
    scale: tuple[float, float] = (0.75, 1.0)
    random_light: float = 0.7
    patterned: float = 0.2
    photographed: float = 0.2
    shadows: float = 0.0
    towards_centre: float = 1.0

    def __post_init__(self) -> None:
        shares = dict.fromkeys(
            ("fraction", "objects_per_scene", "random_light", "patterned", "photographed"), (0.0, 1.0)
        )
        check_ranges(self, "meshes.", scale=(0.1, 1.0), shadows=(0.0, 1.0), towards_centre=(1.0, 10.0), **shares)
        if not sum(self.objects_per_scene):
            raise InputError("meshes.objects_per_scene: expected a number above 0, got none")
        if not self.scale[0] <= self.scale[1]:
            raise InputError(
                f"meshes.scale: expected the smaller number first, got {self.scale[0]:g}, {self.scale[1]:g}"
            )
        if self.patterned + self.photographed > 1:
            raise InputError("meshes.patterned, meshes.photographed: expected a sum of at most 1")


@dataclass(frozen=True)
class MeshPlan:
    """B examples of meshes.

    Attributes:
        sources, targets: Scenes of the B input pictures and of the B V targets.
        shadows: What throws shadows, if anything does.
        world_to_camera: [B,V,4,4], the world being the source camera's axes.
        backgrounds: [B,V,3].
        meshes: The meshes on the device that draws.
    """

    sources: Scene
    targets: Scene
    shadows: Shadows | None
    world_to_camera: torch.Tensor
    backgrounds: torch.Tensor
    meshes: ResidentMeshes

    def drawn(self, compiled: bool) -> tuple[torch.Tensor, ...]:
        """Return the fields of a Batch; the plan is on the device of the meshes; compiled: see make_batch."""
        count, views = self.backgrounds.shape[:2]
        maps = None if self.shadows is None else render_shadow_maps(self.meshes, self.shadows, compiled)
        sources, targets = (render_images(self.meshes, scene, maps, compiled) for scene in (self.sources, self.targets))
        return (
            sources,
            self.sources.intrinsics,
            targets.unflatten(0, (count, views)),
            self.targets.intrinsics.unflatten(0, (count, views)),
            self.world_to_camera,
            self.backgrounds,
        )


@dataclass(frozen=True)
class Framing:
    """How the pictures of B examples are cut out; image 0 is the input picture, the others are the V targets.

    Attributes:
        sides, shifts: [B,I] and [B,I,2] of the crops, in units of the squares round the scene.
        backgrounds: [B,V,3].
        mirror: bool [B], whether the world is mirrored.
        recolour: Probability that an object's own colours change, 0..1.
    """

    sides: np.ndarray
    shifts: np.ndarray
    backgrounds: np.ndarray
    mirror: np.ndarray
    recolour: float


class MeshScenes:
    """Draws scenes of meshes.

    Args:
        cone_deg: Largest azimuth and elevation of the targets about the source.
        photographs: What some objects wear; None: nothing.
    """

    def __init__(
        self,
        meshes: ResidentMeshes,
        options: MeshOptions,
        cone_deg: tuple[float, float],
        photographs: Photographs | None = None,
    ) -> None:
        self.meshes, self.options, self._cone_deg, self._photographs = meshes, options, cone_deg, photographs

    def plan(
        self, rng: np.random.Generator, wanted: np.ndarray, count: int, sizes: tuple[int, int], framing: Framing
    ) -> MeshPlan:
        """Return the examples `wanted` of a step's `count`; each is the same whatever is wanted.

        Args:
            rng: The random numbers of the step.
            sizes: Side of the input pictures and of the targets, pixels.
            framing: Of the wanted examples.
        """
        views = framing.backgrounds.shape[1]
        scenes, objects = (
            rng.random((count, numbers))[wanted]
            for numbers in (SCENE_NUMBERS + _VIEWS_NUMBERS * views, MOST_OBJECTS * OBJECT_NUMBERS)
        )
        drawn = _Drawn(self, Numbers(scenes), Numbers(objects.reshape(-1, OBJECT_NUMBERS)), framing)
        source, targets = (
            drawn.scene(images, size) for images, size in ((slice(0, 1), sizes[0]), (slice(1, None), sizes[1]))
        )
        return MeshPlan(
            source, targets, drawn.shadows(), _floats(drawn.cameras[:, 1:]), _floats(framing.backgrounds), self.meshes
        )


class _Drawn:
    """B scenes of J = MOST_OBJECTS places, not all of them taken.

    Attributes:
        cameras: [B,I,4,4], the source's axes to those of each image's camera.
    """

    def __init__(self, scenes: MeshScenes, u: Numbers, each: Numbers, framing: Framing) -> None:
        self._scenes, self._options, self._framing = scenes, scenes.options, framing
        meshes = scenes.meshes.meshes
        weights = np.array(self._options.objects_per_scene) / sum(self._options.objects_per_scene)
        exists = np.arange(MOST_OBJECTS) < u.chosen([1, 2, 3, 4], weights.tolist(), 1)
        self._objects = np.floor(len(meshes) * each()).astype(int).reshape(exists.shape)
        self._exists = exists
        to_scene = _placed(u, each, meshes.supports[self._objects], exists, self._options.scale)
        tilt = np.radians(u.between(-8, 40, 1))
        roll = np.where(u(1) < 0.15, u.between(-np.pi, np.pi, 1), np.radians(u.between(-4, 4, 1)))
        turned = rotation(2, roll) @ rotation(0, tilt) @ rotation(1, u.between(-np.pi, np.pi, 1)) @ _UPRIGHT
        turned = turned * np.stack([np.where(framing.mirror, -1, 1), *np.ones((2, len(tilt)))], -1)[:, None, None]
        self._to_source = turned @ to_scene
        self._to_source[..., 2, 3] += DISTANCE
        numbers = [u.between(-1, 1, framing.backgrounds.shape[1]) for _ in scenes._cone_deg]
        azimuth, elevation = _directions(*numbers, tilt, np.radians(scenes._cone_deg), self._options.towards_centre)
        azimuth[:, 0] = elevation[:, 0] = 0
        cameras = orbit(azimuth, elevation, tilt, roll)
        self.cameras = np.concatenate([cameras[:, :1], cameras], 1)
        random_light = u() < self._options.random_light
        self._light = np.where(random_light[:, None], _random_light(u, turned[:, 0]), standard_light(turned[:, 0]))
        self._axes = light_axes(self._light[:, KEY])
        self._shadowed = u() < self._options.shadows
        self._looks = self._new_looks(each, np.repeat(random_light, MOST_OBJECTS))

    def scene(self, images: slice, size_px: int) -> Scene:
        """Return the pictures of some images of every scene."""
        cameras = self.cameras[:, images]
        count = cameras.shape[1]
        to_camera = cameras[:, :, None, :3, :3] @ self._to_source[:, None]
        to_camera[..., 3] += cameras[:, :, None, :3, 3]
        exists = np.broadcast_to(self._exists[:, None], to_camera.shape[:3])
        objects = np.broadcast_to(self._objects[:, None], to_camera.shape[:3])
        scene, image, place = np.nonzero(exists)
        from_camera = np.linalg.inv(cameras)[..., :3, :]
        draws = list_draws(self._scenes.meshes.meshes, objects[exists], scene * count + image, len(cameras) * count)
        first, own, patterns, skins = self._looks
        return Scene(
            draws,
            _floats(to_camera[exists]),
            _floats(self._intrinsics(images, to_camera, exists, size_px).reshape(-1, 4)),
            _floats(_turned_light(self._light, cameras[..., :3, :3]).reshape(-1, sum(LIGHT.values()))),
            size_px,
            Looks(torch.from_numpy(first[scene, place]), own, patterns, skins, self._scenes._photographs),
            _floats(to_light(self._axes[:, None], from_camera).reshape(-1, 3, 4)),
            torch.from_numpy(np.repeat(self._shadow_numbers(), count)),
        )

    def _intrinsics(self, images: slice, to_camera: np.ndarray, exists: np.ndarray, size_px: int) -> np.ndarray:
        """Return (fx, fy, cx, cy) of crops round the scenes, [B,I,4].

        Args:
            to_camera: [B,I,J,3,4].
            exists: bool [B,I,J].
        """
        matrix = to_camera[exists].astype(np.float32)
        supports = self._scenes.meshes.meshes.supports[np.broadcast_to(self._objects[:, None], exists.shape)[exists]]
        points = matrix[..., :3] @ supports + matrix[..., 3:]
        low, high = _box(points[:, :2] / points[:, 2:], exists)
        side = (1 + 2 * MARGIN) * (high - low).max(-1)
        focal = size_px / (side * self._framing.sides[:, images])
        middle = (low + high) / 2 + self._framing.shifts[:, images] * side[..., None]
        return np.concatenate([focal[..., None], focal[..., None], size_px / 2 - middle * focal[..., None]], -1)

    def shadows(self) -> Shadows | None:
        """Return the key lights of the scenes with shadows; None: there are none."""
        exists = self._exists & self._shadowed[:, None]
        if not exists.any():
            return None
        scene, _ = np.nonzero(exists)
        view = np.unique(scene, return_inverse=True)[1]
        draws = list_draws(self._scenes.meshes.meshes, self._objects[exists], view, int(self._shadowed.sum()))
        return Shadows(draws, _floats(to_light(self._axes[scene], self._to_source[exists])))

    def _shadow_numbers(self) -> np.ndarray:
        """Return the number of each scene's shadow map, int64 [B]; -1: none."""
        return np.where(self._shadowed, np.cumsum(self._shadowed) - 1, -1)

    def _new_looks(
        self, each: Numbers, glossy: np.ndarray
    ) -> tuple[np.ndarray, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return first rows int64 [B,J], and own, patterns and skins of Looks, for the objects that exist."""
        options, photographs, chosen = self._options, self._scenes._photographs, self._exists.ravel()
        kind = each()
        grey = self._scenes.meshes.meshes.grey[self._objects].ravel()
        photographed = options.photographed if photographs is not None else 0.0
        changed = options.patterned + photographed
        kind = np.where(grey, kind * (changed or 1), kind)
        worn = (kind < photographed) if changed else np.zeros(len(kind), bool)
        own = (kind >= changed) & ~grey
        recoloured = each() < self._framing.recolour
        table = {
            "weight": own[:, None],
            "order": np.where(recoloured[:, None], np.argsort(each(3), -1), np.arange(3)),
            "gain": np.where(recoloured[:, None], 0.7 + 0.4 * each(3), 1),
            "gamma": np.where(recoloured, np.exp(0.6 * each() - 0.3), 1)[:, None],
        }
        looks = draw_looks(each)
        looks[..., 6:15] /= _HALF_LENGTH
        looks[..., -1] *= glossy[:, None]
        skins = np.zeros((len(kind), GROUPS, sum(SKIN.values())))
        if photographs is not None:
            groups = np.broadcast_to(np.arange(GROUPS), skins.shape[:2])
            skins = draw_skin(each, groups, GROUPS, photographs)
        skins[..., -1] = worn[:, None]
        owns = np.broadcast_to(np.concatenate([table[name] for name in OWN], 1)[:, None], (len(kind), GROUPS, 8))
        first = (GROUPS * (np.cumsum(chosen) - 1)).reshape(self._exists.shape)
        own_rows, patterns, skin_rows = (
            _floats(values[chosen].reshape(-1, values.shape[-1])) for values in (owns, looks, skins)
        )
        return first, own_rows, patterns, skin_rows


def _directions(
    across: np.ndarray, up: np.ndarray, tilt: np.ndarray, limits: np.ndarray, exponent: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths and elevations [B,V] from the source, radians, spread over the sphere about the upright axis.

    Args:
        across, up: [B,V], uniform numbers in -1..1.
        tilt: [B,1], elevation of the source.
        limits: Largest azimuth and elevation; beyond the poles there is nothing.
        exponent: See MeshOptions.towards_centre.
    """
    low, high, middle = (np.sin(np.clip(tilt + side * limits[1], -np.pi / 2, np.pi / 2)) for side in (-1, 1, 0))
    height = low + (high - low) * (up + 1) / 2 - middle
    reach = np.maximum(np.where(height < 0, middle - low, high - middle), 1e-9)
    height *= np.abs(height / reach) ** (exponent - 1)
    return limits[0] * across * np.abs(across) ** (exponent - 1), np.arcsin(np.clip(middle + height, -1, 1)) - tilt


def _placed(
    u: Numbers, each: Numbers, supports: np.ndarray, exists: np.ndarray, scale: tuple[float, float]
) -> np.ndarray:
    """Return matrices [B,J,3,4] that put objects side by side into a box of some diagonal about the origin.

    Seen from above, the rectangles round them do not overlap. Objects stand on one ground in most scenes.

    Args:
        supports: [B,J,3,SUPPORTS].
    """
    count = exists.shape
    yaw = np.where(exists.sum(1, keepdims=True) > 1, each.between(-np.pi, np.pi).reshape(count), 0)
    size = np.where(np.arange(MOST_OBJECTS) == 0, 1, np.exp(each.between(np.log(0.4), 0)).reshape(count))
    turn = size[..., None, None] * rotation(1, yaw)
    points = turn.astype(np.float32) @ supports
    half = np.abs(points[..., [0, 2], :]).max(-1)
    angle, gap = (each.between(*ends).reshape(count) for ends in ((-np.pi, np.pi), (0.0, 0.2)))
    centre = np.zeros((*count, 3))
    centre[..., 1] = np.where(u(1) < 0.75, -points[..., 1, :].min(-1), 0)
    for place in range(1, MOST_OBJECTS):
        direction = np.stack([np.cos(angle[:, place]), np.sin(angle[:, place])], -1)
        reach = half[:, :place] + (half[:, place] + gap[:, place, None])[:, None]
        distance = _free_distance(direction, centre[:, :place, [0, 2]], reach)
        centre[:, place, [0, 2]] = distance[:, None] * direction
    low, high = _box((points + centre[..., None])[exists], exists)
    factor = (u.between(*scale) / np.linalg.norm(high - low, axis=-1))[:, None, None]
    return np.concatenate([factor[..., None] * turn, (factor * (centre - (low + high)[:, None] / 2))[..., None]], -1)


def _free_distance(direction: np.ndarray, centres: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return how far along a direction [B,2] from the origin all rectangles are left behind, [B].

    Args:
        centres, reach: [B,J,2], middles and half sides of rectangles.
    """
    direction = np.where(np.abs(direction) < 1e-6, 1e-6, direction)[:, None]
    ends = np.sort(np.stack([centres - reach, centres + reach]) / direction, 0)
    enter, leave = ends[0].max(-1), ends[1].min(-1)
    return np.where((enter < leave) & (leave > 0), leave, 0).max(1)


def _box(points: np.ndarray, exists: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends [...,C] of the boxes round the objects of scenes.

    Args:
        points: [K,C,SUPPORTS], of the objects that exist.
        exists: bool [...,J].
    """
    ends = []
    for found, far in ((points.min(-1), np.inf), (points.max(-1), -np.inf)):
        ends.append(np.full((*exists.shape, points.shape[1]), far))
        ends[-1][exists] = found
    return ends[0].min(-2), ends[1].max(-2)


def light_axes(key: np.ndarray) -> np.ndarray:
    """Return the axes [B,3,3] of cameras that look along a light which comes from directions [B,3]."""
    least = np.eye(3)[np.abs(key).argmin(-1)]
    across = np.cross(key, least)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([across, np.cross(-key, across), -key], 1)


def to_light(axes: np.ndarray, to_source: np.ndarray) -> np.ndarray:
    """Return matrices [...,3,4] to the axes of a light's camera, of those [...,3,4] to the axes of the source."""
    out = axes @ (to_source - np.array([0, 0, DISTANCE])[:, None] * (np.arange(4) == 3))
    out[..., 2, 3] -= 1
    return out


def standard_light(turned: np.ndarray) -> np.ndarray:
    """Return the light of the project's sets, [B,F] in the order of LIGHT and in the source camera's axes.

    Args:
        turned: [B,3,3], a scene's axes to those of the source camera.
    """
    (key, key_strength), (fill, fill_strength) = _KEY, _FILL
    count = len(turned)
    return _light_table(
        np.full((count, 3), _AMBIENT),
        turned @ (np.array(key) / np.linalg.norm(key)),
        np.full((count, 3), key_strength),
        turned @ (np.array(fill) / np.linalg.norm(fill)),
        np.full((count, 3), fill_strength),
        np.ones((count, 1)),
    )


def _random_light(u: Numbers, turned: np.ndarray) -> np.ndarray:
    """Return random lights: mostly from above and from before the scene, of a colour near white."""
    up = turned @ (0, 1, 0)
    key, fill = u.between(-1, 1, 3) + up + (0, 0, -0.7), u.between(-1, 1, 3) + (0, 0, -0.3)
    key, fill = (direction / np.linalg.norm(direction, axis=-1, keepdims=True) for direction in (key, fill))
    ambient = u.between(0.3, 0.75, 1)
    tint = 1 + u.between(-0.1, 0.1, 2, 3) * u(2, 1)
    strength = 1.3 * (1 - ambient) * u.between(0.7, 1, 1)
    return _light_table(
        ambient * tint[:, 1],
        key,
        strength * tint[:, 0],
        fill,
        u.between(0, 0.3, 1) * tint[:, 1],
        np.exp(u.between(1.5, 4, 1)),
    )


def _light_table(
    ambient: np.ndarray,
    key: np.ndarray,
    key_colour: np.ndarray,
    fill: np.ndarray,
    fill_colour: np.ndarray,
    exponent: np.ndarray,
) -> np.ndarray:
    """Return [B,F] in the order of LIGHT; highlights are those that the source camera sees."""
    half = key - (0, 0, 1)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    return np.concatenate([ambient, key, key_colour, fill, fill_colour, half, exponent], -1)


def _turned_light(light: np.ndarray, cameras: np.ndarray) -> np.ndarray:
    """Return light [B,F] in the axes of cameras [B,I,3,3]: [B,I,F]."""
    out = np.repeat(light[:, None], cameras.shape[1], 1)
    starts = dict(zip(LIGHT, np.cumsum([0, *LIGHT.values()])))
    for name in ("key", "fill", "half"):
        columns = slice(starts[name], starts[name] + 3)
        out[..., columns] = (cameras @ out[..., columns, None])[..., 0]
    return out


def _floats(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
