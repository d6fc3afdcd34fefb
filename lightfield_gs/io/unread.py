"""Files and folders that are not read as scenes or pictures, though people have these in them: what they are, and the
way out."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.not_what_it_says import VIDEO_INPUTS, refuse_stand_in

SCENE_SUFFIXES = (".ply", ".spz", ".splat", ".ksplat", ".sog")
SCENE_STARTS = (b"ply\n", b"ply\r", b"NGSP")  # of a .ply and the newest SPZ; others share theirs with other kinds
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".heic", ".heif", ".avif", ".exr", ".dng")
_SCENES = (*SCENE_SUFFIXES, "meta.json")
_OF_CAPTURES = {"sparse", "transforms.json", "transforms_train.json", "database.db", "images.bin", "images.txt"}
_OF_TRAINERS = {"ckpts", "nerfstudio_models", "cfg_args", "checkpoints"}
_POINTS = ("input.ply", "points3d.ply", "sparse_pc.ply")  # by COLMAP, the trainer of 3DGS and nerfstudio
_START_BYTES = 300
_MOST_LISTED = 20_000  # entries of a folder
_EXPORT = "export a .ply, .spz or .sog from the program that wrote it"
_CONVERT = "convert it to a .ply with splat-transform, or export one from the program that wrote it"
_FIT = "fit Gaussians to photographs of the thing: lightfield-gs fit"
_UNPACK = "unpack it, and give the scene in it"


@dataclass(frozen=True)
class Kind:
    """name: what such a file is, in words. way_out: what its owner can do. suffixes: of its files. starts: what their
    content begins with."""

    name: str
    way_out: str
    suffixes: tuple[str, ...] = ()
    starts: tuple[bytes, ...] = ()


CHECKPOINT = Kind(
    "a trainer's checkpoint",
    "have the trainer export a .ply (gsplat: --save_ply, nerfstudio: ns-export gaussian-splat)",
    (".pt", ".pth", ".ckpt", ".pkl"),
    (b"\x80\x02\x8a\x0al\xfc\x9cF",),  # of torch before 1.6; later ones are ZIP files
)
ARRAYS = Kind(
    "a file of arrays",
    "write them as a .ply: Gaussians(means, quaternions, scales, opacities, sh).save('scene.ply') in Python",
    (".npz", ".npy", ".h5", ".hdf5"),
    (b"\x93NUMPY", b"\x89HDF"),
)
GLTF = Kind("glTF, and Gaussians in it (KHR_gaussian_splatting) are not read", _EXPORT, (".glb", ".gltf"), (b"glTF",))
USD = Kind(
    "OpenUSD, and Gaussians in it (ParticleField3DGaussianSplat) are not read",
    _EXPORT,
    (".usd", ".usda", ".usdc", ".usdz"),
    (b"#usda", b"PXR-USDC"),
)
ARCHIVE = Kind(
    "an archive",
    _UNPACK,
    (".7z", ".rar", ".tar", ".tgz", ".bz2", ".xz", ".zst", ".gz"),
    (b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07", b"BZh9", b"\xfd7zXZ\0", b"\x28\xb5\x2f\xfd"),
)
PROJECT = Kind(
    "a project of an editor, not the scene",
    "open it there and export a .ply, .spz or .sog",
    (".ssproj", ".psht", ".blend", ".uproject", ".uasset", ".umap", ".unitypackage", ".c4d", ".max", ".ma", ".mb"),
    (b"BLENDER",),
)
_KINDS = (
    CHECKPOINT,
    ARRAYS,
    GLTF,
    USD,
    ARCHIVE,
    PROJECT,
    Kind("weights of a network, or a trainer's tensors", CHECKPOINT.way_out, (".safetensors",)),
    Kind("a scene of XGRIDS (LCC)", _CONVERT, (".lcc", ".lcc2")),
    Kind(
        "a viewer's page, with the scene inside it or behind a link",
        "give the .ply, .spz or .sog that it was made of; SuperSplat exports one from its editor",
        (".html", ".htm", ".mhtml"),
    ),
    Kind(
        "Gaussians that move, for the viewer splaTV",
        "give the .ply of Spacetime Gaussians that it was made of",
        (".splatv",),
    ),
    Kind("a scene for streaming (Spark)", _EXPORT, (".rad",)),
    Kind("a scene of another viewer, of a format that is not read", _EXPORT, (".spx", ".sogs", ".gsplat", ".splats")),
    Kind(
        "a mesh, and no Gaussians",
        _FIT,
        (
            *(".obj", ".fbx", ".dae", ".stl", ".off", ".3ds", ".3mf", ".abc", ".x3d", ".wrl", ".vrm", ".ifc"),
            *(".step", ".stp", ".mtl"),
        ),
        (b"Kaydara FBX Binary",),
    ),
    Kind(
        "a point cloud, and no Gaussians",
        "fit Gaussians to the photographs that it was made of: lightfield-gs fit",
        (".las", ".laz", ".e57", ".xyz", ".pts", ".ptx", ".pcd", ".asc", ".rcs", ".rcp"),
        (b"LASF", b"ASTM-E57", b"# .PCD"),
    ),
    Kind(
        "tiles for a map's viewer", _EXPORT, (".b3dm", ".i3dm", ".pnts", ".cmpt", ".3tz", ".slpk"), (b"b3dm", b"pnts")
    ),
    Kind("a video", "lightfield-gs video takes one of photos or RGB-D pictures, weave one of quilts", VIDEO_INPUTS),
    Kind(
        "a project of a photogrammetry program",
        "export its cameras for COLMAP beside the photographs, and fit them: lightfield-gs fit",
        (".psx", ".psz", ".rcproj", ".rsproj"),
    ),
)
# Known where a picture was expected, which these are not: some of them are scenes, and others go with an option
_NO_PICTURES = (
    Kind(
        "a scene or points, and no picture",
        "lightfield-gs encode draws a scene for a panel, quilt its views, and view shows it",
        SCENE_SUFFIXES,
        SCENE_STARTS,
    ),
    Kind(
        "a ZIP, and no picture",
        "unpack it, or give one with a scene in it to lightfield-gs encode by a name that ends in .zip",
        (".zip",),
        (b"PK\x03\x04", b"PK\x05\x06"),
    ),
    Kind("packed by gzip", "rename it to end in .spz if it is such a scene, else unpack it", (), (b"\x1f\x8b",)),
    Kind(
        "a file of settings or cameras, and neither a picture nor a scene",
        "a panel goes with --panel and cameras with --camera; of scenes in JSON, meta.json and lod-meta.json are read",
        (".json", ".yaml", ".yml", ".toml"),
    ),
)
_BY_SUFFIX = {suffix: kind for kind in _KINDS for suffix in kind.suffixes}
_BY_NAME = {
    "tileset.json": Kind("a tree of 3D Tiles", _EXPORT),
    "transforms.json": Kind("the cameras of a capture", "fit its folder: lightfield-gs fit"),
    "cameras.json": Kind("the cameras of a scene", "give the scene, and these with --camera"),
    **dict.fromkeys(
        ("points3d.bin", "points3d.txt", "images.bin", "images.txt", "cameras.bin", "cameras.txt", "database.db"),
        Kind("a part of a COLMAP model", "fit the folder of its photographs: lightfield-gs fit"),
    ),
}


def refuse_kind(path: object, kind: Kind) -> None:
    """Raises InputError that names the kind and its way out."""
    raise InputError(f"{path} is {kind.name}; {kind.way_out}")


def refuse_unread(path: Path) -> None:
    """Raises InputError where a path is known to hold what is not read as a scene or a photo: it names the kind, by
    the content, then by the name, and the way out. Nothing is said of a path where nothing is."""
    if path.is_dir():
        with reading(path):
            _refuse_folder(path)
    if not path.is_file():
        return
    with reading(path), open(path, "rb") as file:
        start = file.read(_START_BYTES)
    for kind in _KINDS:
        if kind.starts and start.startswith(kind.starts):
            refuse_kind(path, kind)
    if start[257:262] == b"ustar":
        refuse_kind(path, ARCHIVE)
    suffix = path.suffix.lower()
    if suffix not in SCENE_SUFFIXES and (known := _BY_NAME.get(path.name.lower(), _BY_SUFFIX.get(suffix))):
        refuse_kind(path, known)


def refuse_no_picture(path: Path) -> None:
    """Raises InputError where a file, of which no picture could be read, is known to be something else: it names the
    kind and the way out."""
    refuse_stand_in(path)
    refuse_unread(path)
    with reading(path), open(path, "rb") as file:
        start = file.read(_START_BYTES)
    suffix = path.suffix.lower()
    if not start.startswith(SCENE_STARTS) and Path(path.stem).suffix.lower() in SCENE_SUFFIXES:
        raise InputError(
            f"{path} is no picture, and its name ends in {path.suffix}; if it is a scene, and its download has ended, "
            f"rename it to {path.stem}"
        )
    for kind in _NO_PICTURES:
        if kind.starts and start.startswith(kind.starts) or suffix in kind.suffixes:
            refuse_kind(path, kind)


def begins_as_scene(path: Path) -> bool:
    """Whether the content of a file says that it is a scene, whatever its name says."""
    if not os.path.isfile(path):
        return False
    try:
        with open(path, "rb") as file:
            return file.read(4) in SCENE_STARTS
    except OSError:
        return False  # whoever reads it has a complaint of their own


def scenes_among(names: Sequence[str]) -> list[str]:
    """The names that end as those of scenes, without the points that a capture or a trainer's folder begins with."""
    parts = {part.lower() for name in names for part in name.split("/")}
    starts = _POINTS if parts & (_OF_CAPTURES | _OF_TRAINERS) else ()
    return [name for name in names if name.lower().endswith(SCENE_SUFFIXES) and not name.lower().endswith(starts)]


def _refuse_folder(path: Path) -> None:
    """Raises InputError for a folder, by what is in it."""
    with os.scandir(path) as entries:
        names = sorted(entry.name for entry in islice(entries, _MOST_LISTED) if not entry.name.startswith("."))
    scenes = scenes_among(names)
    lower = {name.lower() for name in names}
    if len(scenes) > 1:
        raise InputError(
            f"{path} is a folder of {len(scenes)} scenes ({scenes[0]} to {scenes[-1]}), and no sequence of scenes is "
            "played; give one of them, or the folder to lightfield-gs batch, which draws each"
        )
    if scenes:
        raise InputError(f"{path} is a folder with one scene in it; give {path / scenes[0]}")
    if lower & _OF_CAPTURES:
        raise InputError(f"{path} is a capture, photographs with cameras; fit Gaussians to it: lightfield-gs fit")
    if lower & _OF_TRAINERS or any(name.endswith(CHECKPOINT.suffixes) for name in lower):
        raise InputError(f"{path} is a folder of a trainer without an exported scene; {CHECKPOINT.way_out}")
    pictures = sum(name.endswith(PICTURE_SUFFIXES) for name in lower)
    kinds = [known for name in names if (known := _BY_SUFFIX.get(Path(name).suffix.lower()))]
    if pictures > len(kinds):
        raise InputError(
            f"{path} is a folder of {pictures} pictures; one is encoded by its own name, all are in a row by "
            "lightfield-gs video, each by itself by batch, and as views of one scene by fit --sfm or weave"
        )
    if kinds:
        refuse_kind(f"{path} is a folder, and what it holds", kinds[0])
    deeper = sorted(islice((each for each in path.glob("*/*") if each.name.lower().endswith(_SCENES)), _MOST_LISTED))
    if deeper:
        scene = deeper[0].parent if deeper[0].name.lower() == "meta.json" else deeper[0]
        raise InputError(f"{path} is a folder, and its scenes are in the folders in it; give one of them: {scene}")
    raise InputError(
        f"{path} is a folder, and no scene is in it ({', '.join(names[:3]) or 'it is empty'}); give a file"
    )
