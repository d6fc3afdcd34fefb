"""The rig behind a panel's views: its files, and automatic framing; see rig_geometry.py for the cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lightfield_gs.base.errors import named
from lightfield_gs.io.text_files import read_mapping, write_mapping
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig_geometry import RigGeometry
from lightfield_gs.scene.axes import DEFAULT_UP

if TYPE_CHECKING:
    from lightfield_gs.scene.gaussians import Gaussians


@dataclass(eq=False)
class Rig(RigGeometry):
    """The cameras of the views: a fan on the x-axis of its centre camera, all with the same rotation.

    Rig.frame makes a rig that shows a scene on a panel.

    Attributes:
        world_to_camera: [4, 4] float64, [R|t] over 0 0 0 1, OpenCV axes (x right, y down, z forward), column vectors.
        focal_px: (fx, fy), > 0, at the panel's resolution.
        principal_point_px: (cx, cy) at the panel's resolution, from the outer corner of the first pixel.
        zero_depth: View-space z, > 0, scene units, of the plane without parallax: the panel itself.
        cone_deg: Full angle of the fan seen from the zero plane, in [0, 180), 0 being a flat picture; None: the
            panel's.

    Raises:
        InputError: A value is out of its range.
    """

    @staticmethod
    def frame(
        gaussians: Gaussians,
        panel: Panel,
        world_to_camera: np.ndarray | None = None,
        *,
        up: str = DEFAULT_UP,
        notes: list[str] | None = None,
    ) -> Rig:
        """Return a rig that shows a scene on the panel: the whole scene, or its subject.

        The content is the area that the visible Gaussians cover. The outermost 0.01 % of their opacity on each side is
        left out, or 0.1 % or 1 % where it lies far out. The content is centred. It fills 92 % of the panel's height, or
        of its width if that is the limit; the panel takes 90 degrees at most. The zero plane is at the harmonic mean of
        near and far; 5 % of the opacity lies beyond each of them.

        In three cases the content is only the subject (lightfield_gs.panels.subject). A gap surrounds the densest part
        of the scene. The scene surrounds a small dense part. A hull that is closed on all sides has something in it.

        A new camera looks at the content from in front. The content's height takes the angle that the panel subtends
        for its viewer, kept within 20..50 degrees, or 30 if unknown. The camera goes nearer if something is in between.
        If a given camera sees nothing near the harmonic mean, the zero plane is at the depth in the middle of the
        picture.

        Args:
            gaussians: One set.
            panel: The panel.
            world_to_camera: [4, 4], the camera's pose; None: a new camera.
            up: The axis that points up for a new camera, one of axes.UP_AXES, or three numbers. With -y, as in OpenCV
                axes, the camera looks along +z.
            notes: A list to append a line to for each assumption.

        Raises:
            InputError: `gaussians` is a batch or empty, or none lies in front of the camera.
        """
        from lightfield_gs.panels.scene_framing import fit_scene

        return Rig(**vars(fit_scene(gaussians, panel, world_to_camera, up, notes)))

    @staticmethod
    def from_yaml(path: str | Path) -> Rig:
        """Return a rig from a YAML file with the fields of this class; cone_deg may be missing.

        Raises:
            InputError: The file cannot be read.
        """
        required = ("world_to_camera", "focal_px", "principal_point_px", "zero_depth")
        data = read_mapping(path, required, ("cone_deg",))
        with named(path):
            return Rig(**data)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as from_yaml reads them."""
        fields = {
            "world_to_camera": self.world_to_camera.tolist(),
            "focal_px": list(self.focal_px),
            "principal_point_px": list(self.principal_point_px),
            "zero_depth": self.zero_depth,
        }
        return fields if self.cone_deg is None else {**fields, "cone_deg": self.cone_deg}

    def to_yaml(self, path: str | Path) -> None:
        """Write the rig as from_yaml reads it, every digit kept, atomically."""
        write_mapping(path, self.to_dict())
