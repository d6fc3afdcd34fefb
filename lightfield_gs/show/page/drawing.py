"""The scene, once, for browsers that draw it themselves by WebGPU; the pages then ask for few pictures."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import torch

from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.browser_data import host_tables, rig_numbers
from lightfield_gs.show.page.server import Answer, Query, Reservation, Route, as_json, text
from lightfield_gs.show.page.stage import Stage
from lightfield_gs.show.scripts import joined

_SCRIPT = Path(__file__).parent / "files" / "view" / "drawing.js"
_MOST_BYTES = 1 << 28  # of a scene that a browser draws
_GAUSSIAN_FLOATS = 12


def drawing_routes(stage: Stage) -> dict[str, Route]:
    """Return the addresses from which the pages take a scene and what draws it."""

    def data(query: Query) -> Answer:
        """Return what draws the scene, or null where the server does: on a GPU, of a large scene, a film, for eyes."""
        floats = stage.gaussians.count * (_GAUSSIAN_FLOATS + 3 * stage.gaussians.sh.shape[1])
        is_film = stage.scene.film is not None
        if stage.is_on_gpu or is_film or not stage.is_for_browsers or 4 * floats > _MOST_BYTES:
            return as_json(None)
        panel, scene = stage.panel, stage.scene
        return as_json(
            {
                "scene": stage.number,
                "count": stage.gaussians.count,
                "degree": stage.gaussians.sh_degree,
                "rig": rig_numbers(stage.base, (panel.width_px, panel.height_px)),
                "panel": panel.to_dict(),
                "background": scene.background,
                "antialiased": scene.antialiased,
                "view_filter": scene.view_filter,
                "host": host_tables(),
            }
        )

    def numbers(query: Query) -> Answer:
        """Return the Gaussians of the scene of this number, as /drawing.json has it."""
        if query.get("scene", str(stage.number)) != str(stage.number):
            return text("another picture is shown by now", 410)
        return Answer(_floats(stage.gaussians), "application/octet-stream")

    return {
        "/drawing.js": Route(lambda query: Answer(_script(), "text/javascript; charset=utf-8")),
        "/drawing.json": Route(data),
        "/drawing.bin": Route(numbers, place=lambda query: Reservation(True, ("drawing.bin", stage.number))),
    }


@lru_cache
def _script() -> bytes:
    return joined(_SCRIPT, exports=True).encode()


def _floats(gaussians: Gaussians) -> bytes:
    """Return the struct Gaussian of csrc/webgpu/project.wgsl for each, and then all harmonics, float32."""
    scene = gaussians.detach().to("cpu", torch.float32)
    packed = torch.zeros(scene.count, _GAUSSIAN_FLOATS)
    packed[:, :3], packed[:, 3] = scene.means, scene.opacities
    packed[:, 4:8], packed[:, 8:11] = scene.quaternions, scene.scales
    return packed.numpy().tobytes() + scene.sh.contiguous().numpy().tobytes()
