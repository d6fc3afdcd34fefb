"""A module that stands in for pycolmap: it checks what it is given, and finds the models that a test makes."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from capture_scene import CENTRE, HEIGHT, WIDTH, ring, write_model


class Model:
    """A reconstruction in which the first `count` photographs are posed, all in one direction."""

    def __init__(self, count: int, focal_px: float = 70.0):
        self.names = [f"{index:03d}.png" for index in range(count)]
        self.images = {
            index: SimpleNamespace(name=name, has_pose=True, viewing_direction=lambda: np.array([0, 0, 1.0]))
            for index, name in enumerate(self.names)
        }
        self.points3D = {1: None}
        self.cameras = {1: SimpleNamespace(mean_focal_length=lambda: focal_px, width=WIDTH, height=HEIGHT)}

    def num_reg_images(self) -> int:
        return len(self.names)

    def write(self, folder: str) -> None:
        images = [(name, 1, *pose) for name, pose in zip(self.names, ring(len(self.names)))]
        camera = (1, "SIMPLE_RADIAL", WIDTH, HEIGHT, [70.0, *CENTRE, 0.0])
        write_model(Path(folder), "bin", [camera], images, [((0, 0, 0), (1, 2, 3))])


def stand_in(*tries: dict[int, Model], has_cuda: int = False) -> SimpleNamespace:
    """Stand in for pycolmap: each try finds these models, further tries the last ones.

    It records its input: groups, one for each camera; start, the first bytes of each photograph; focal_px of each try;
    devices; masks, the folders of the masks of features.
    """
    given = SimpleNamespace(groups=[], start={}, focal_px=[], devices=set(), masks=set())
    camera = SimpleNamespace(camera_id=1, width=WIDTH, height=HEIGHT, focal_length=1.0, has_prior_focal_length=False)
    database = SimpleNamespace(
        read_all_cameras=lambda: [camera], update_camera=lambda camera: None, clear_two_view_geometries=lambda: None
    )

    def extract(database, photographs, names, camera_mode, device, reader_options=None):
        given.masks |= {reader_options.mask_path} if reader_options else set()
        given.groups.append(names)
        given.devices.add(device)
        given.start |= {name: (Path(photographs) / name).read_bytes()[:3] for name in names}

    def mapping(database, photographs, models, options, initial_image_pair_callback, next_image_callback):
        found = tries[min(len(given.focal_px), len(tries) - 1)]
        given.focal_px.append(camera.focal_length)
        for model in found.values():
            initial_image_pair_callback()
            for _ in model.names[2:]:
                next_image_callback()
        return found

    return SimpleNamespace(
        given=given,
        CameraMode=SimpleNamespace(SINGLE="single"),
        ImageReaderOptions=SimpleNamespace,
        Device=SimpleNamespace(cpu="cpu", cuda="cuda"),
        has_cuda=bool(has_cuda),
        logging=SimpleNamespace(minloglevel=0),
        set_random_seed=lambda seed: None,
        extract_features=extract,
        match_exhaustive=lambda database, device: given.devices.add(device),
        incremental_mapping=mapping,
        IncrementalPipelineOptions=lambda: SimpleNamespace(mapper=SimpleNamespace(), triangulation=SimpleNamespace()),
        Database=SimpleNamespace(open=lambda path: nullcontext(database)),
        geometric_verification=lambda path: None,
        BundleAdjustmentOptions=SimpleNamespace,
        bundle_adjustment=lambda model, options: None,
    )
