"""Kinds of files by content and name, and refusals of unsupported kinds.

Each message names the kind and a way out. Git LFS pointers and web pages may stand in place of a file. Other kinds are
videos, large files that are no images, and meshes, checkpoints, archives and more.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

from lightfield_gs.base.errors import InputError, reading

VIDEO_INPUTS = (
    *(".mp4", ".mkv", ".mov", ".webm", ".avi", ".m4v", ".f4v", ".qt", ".asf", ".mxf"),
    *(".mts", ".m2ts", ".m2t", ".ts", ".mod", ".tod", ".dv", ".vob", ".mpg", ".mpeg", ".m2v"),  # of camcorders and DVDs
    *(".wmv", ".3gp", ".3g2", ".ogv", ".flv"),  # of older phones and the web
)
POSITION_TEXTS = (".txt", ".csv")  # positions of eyes, of a line each
_START_BYTES = 512
_LARGE_BYTES = 64 << 20  # smaller files are read quickly in any case
# First bytes of images, raw files of cameras among them. TGA has no magic number: bytes 1 and 2 have the values of its
# kinds, and the size is not zero
_IMAGE_STARTS = re.compile(
    rb"\x89PNG|\xff\xd8\xff|v/1\x01|II|MM|GIF8|BM|RIFF|#\?|P[1-7Ff]\s+[#\dA-Z]|SDPX|XPDS|\x80\x2a\x5f\xd7|\xd7\x5f\x2a\x80|8BPS|"
    rb"....(?:ftyp|jP  |JXL )|\xff\x0a|\xff\x4f\xff\x51|DDS |\x01\xda|FOR[48]|SIMPLE|FUJIFILM|FOVb|"
    rb"\x00MRM|\x59\xa6\x6a\x95|\x2f\x08\x67\xab|\x53\x80\xf6\x34|"
    rb".(?:\x01[\x01\x09]|[\x00\x01][\x02\x03\x0a\x0b]).{9}(?!\x00\x00)..(?!\x00\x00)..",
    re.DOTALL,
)
# Compressed kinds among them: they have no long row of zeros after their headers
_COMPRESSED_STARTS = re.compile(rb"\xff\xd8\xff|GIF8|RIFF|....(?:ftyp|jP  |JXL )|\xff\x0a|\xff\x4f\xff\x51", re.DOTALL)
# Kinds with long headers: EXR, FITS, RAF, IFF, Softimage and Cineon
_LONG_HEADERS = re.compile(rb"v/1\x01|SIMPLE|FUJIFILM|FOR[48]|\x53\x80\xf6\x34|\x80\x2a\x5f\xd7|\xd7\x5f\x2a\x80")
_FIRST_WORDS = 32  # bytes
_FITS_BLOCK = 2880  # bytes of text (FITS standard 4.0, section 3.3.1)
_PNM_SIZE = re.compile(rb"P[1-6Ff]\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(\d{1,9})\s")
_PNM_PIXEL = 32  # bytes of a pixel at most, as text
_BEHIND_HEADER, _ROW_BYTES = 4096, 1 << 16
_POINTER = b"version https://git-lfs.github.com/spec/"
# Comments may come first; storage servers answer <Error> in XML
_WEB_PAGE = re.compile(rb"(?:\xef\xbb\xbf)?\s*<(?:.*<)?(?:!doctype html|html[\s>]|error>)", re.IGNORECASE | re.DOTALL)

# First bytes of videos, and their suffixes. HEIC, AVIF, CR3 and JPEG XL are pictures in boxes like those of MP4
_VIDEOS = (
    (re.compile(rb".{4}(?:ftypqt  |moov|mdat|wide)", re.DOTALL), ".mov"),
    (re.compile(rb".{4}ftyp(?!hei|hev|mif|msf|avif|avis|crx|jx)", re.DOTALL), ".mp4"),
    (re.compile(rb"\x1a\x45\xdf\xa3.{0,60}webm", re.DOTALL), ".webm"),
    (re.compile(rb"\x1a\x45\xdf\xa3"), ".mkv"),
    (re.compile(rb"RIFF.{4}AVI ", re.DOTALL), ".avi"),
    (re.compile(rb"G(?:.{187}G){2}", re.DOTALL), ".ts"),
    (re.compile(rb".{4}G(?:.{191}G){2}", re.DOTALL), ".m2ts"),
    (re.compile(rb"\x00\x00\x01[\xb3\xba]"), ".mpg"),
    (re.compile(rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11"), ".wmv"),
    (re.compile(rb"FLV\x01"), ".flv"),
    (re.compile(rb"OggS"), ".ogv"),
    (re.compile(rb"\x06\x0e\x2b\x34\x02\x05\x01\x01"), ".mxf"),
)

SCENE_SUFFIXES = (".ply", ".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz", ".spz", ".splat", ".ksplat", ".sog")
# Of .ply, SPZ version 4, .glb and OpenUSD; other formats share theirs with other kinds
SCENE_STARTS = (b"ply\n", b"ply\r", b"NGSP", b"glTF", b"#usd", b"PXR-")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".heic", ".heif", ".avif", ".exr", ".dng")
_SCENE_ENDS = (*SCENE_SUFFIXES, "meta.json")
_CAPTURE_NAMES = {"sparse", "transforms.json", "transforms_train.json", "database.db", "images.bin", "images.txt"}
_TRAINER_NAMES = {"ckpts", "nerfstudio_models", "cfg_args", "checkpoints"}
_POINT_FILES = ("input.ply", "points3d.ply", "sparse_pc.ply")  # of COLMAP, the 3DGS trainer and nerfstudio
_MOST_LISTED = 20_000  # entries of a folder
_EXPORT = "export a .ply, .spz or .sog from the program that wrote it"
_CONVERT = "convert it to a .ply with splat-transform, or export one from the program that wrote it"
FIT_ADVICE = "fit Gaussians to photographs of the thing: lightfield-gs fit"
_UNPACK = "unpack it, and give the scene in it"


@dataclass(frozen=True)
class FileKind:
    """A kind of file that is not read.

    Attributes:
        name: the kind, in words.
        advice: advice for the user.
        suffixes: endings of its files.
        starts: first bytes of its files.
    """

    name: str
    advice: str
    suffixes: tuple[str, ...] = ()
    starts: tuple[bytes, ...] = ()


CHECKPOINT = FileKind(
    "a trainer's checkpoint",
    "have the trainer export a .ply (gsplat: --save_ply, nerfstudio: ns-export gaussian-splat)",
    (".pt", ".pth", ".ckpt", ".pkl"),
    (b"\x80\x02\x8a\x0al\xfc\x9cF",),  # of torch before 1.6; later ones are ZIP files
)
ARRAYS = FileKind(
    "a file of arrays",
    "write them as a .ply: Gaussians(means, quaternions, scales, opacities, sh).save('scene.ply') in Python",
    (".npz", ".npy", ".h5", ".hdf5"),
    (b"\x93NUMPY", b"\x89HDF"),
)
ARCHIVE = FileKind(
    "an archive",
    _UNPACK,
    (".7z", ".rar", ".tar", ".tgz", ".bz2", ".xz", ".zst", ".gz"),
    (b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07", b"BZh9", b"\xfd7zXZ\0", b"\x28\xb5\x2f\xfd"),
)
PROJECT = FileKind(
    "a project of an editor, not the scene",
    "open it there and export a .ply, .spz or .sog",
    (".ssproj", ".psht", ".blend", ".uproject", ".uasset", ".umap", ".unitypackage", ".c4d", ".max", ".ma", ".mb"),
    (b"BLENDER",),
)
_KINDS = (
    CHECKPOINT,
    ARRAYS,
    ARCHIVE,
    PROJECT,
    FileKind("weights of a network, or a trainer's tensors", CHECKPOINT.advice, (".safetensors",)),
    FileKind("a scene of XGRIDS (LCC)", _CONVERT, (".lcc", ".lcc2")),
    FileKind(
        "a viewer's page, with the scene inside it or behind a link",
        "give the .ply, .spz or .sog that it was made of; SuperSplat exports one from its editor",
        (".html", ".htm", ".mhtml"),
    ),
    FileKind(
        "Gaussians that move, for the viewer splaTV",
        "give the .ply of Spacetime Gaussians that it was made of",
        (".splatv",),
    ),
    FileKind("a scene for streaming (Spark)", _EXPORT, (".rad",)),
    FileKind(
        "a scene of another viewer, of a format that is not read", _EXPORT, (".spx", ".sogs", ".gsplat", ".splats")
    ),
    FileKind(
        "a mesh, and no Gaussians",
        FIT_ADVICE,
        (
            *(".obj", ".fbx", ".dae", ".stl", ".off", ".3ds", ".3mf", ".abc", ".x3d", ".wrl", ".vrm", ".ifc"),
            *(".step", ".stp", ".mtl"),
        ),
        (b"Kaydara FBX Binary",),
    ),
    FileKind(
        "a point cloud, and no Gaussians",
        "fit Gaussians to the photographs that it was made of: lightfield-gs fit",
        (".las", ".laz", ".e57", ".xyz", ".pts", ".ptx", ".pcd", ".asc", ".rcs", ".rcp"),
        (b"LASF", b"ASTM-E57", b"# .PCD"),
    ),
    FileKind(
        "tiles for a map's viewer", _EXPORT, (".b3dm", ".i3dm", ".pnts", ".cmpt", ".3tz", ".slpk"), (b"b3dm", b"pnts")
    ),
    FileKind(
        "a video",
        "lightfield-gs video takes one of photos or RGB-D pictures, weave one of quilts, show a panel's own",
        VIDEO_INPUTS,
    ),
    FileKind(
        "a project of a photogrammetry program",
        "export its cameras for COLMAP beside the photographs, and fit them: lightfield-gs fit",
        (".psx", ".psz", ".rcproj", ".rsproj"),
    ),
)
# Kinds named only where an image is expected: scenes, and files that belong to an option
_NON_IMAGES = (
    FileKind(
        "a scene or points, and no picture",
        "lightfield-gs encode draws a scene for a panel, quilt its views, and view shows it",
        SCENE_SUFFIXES,
        SCENE_STARTS,
    ),
    FileKind(
        "a ZIP, and no picture",
        "unpack it, or give one with a scene in it to lightfield-gs encode by a name that ends in .zip",
        (".zip",),
        (b"PK\x03\x04", b"PK\x05\x06"),
    ),
    FileKind("packed by gzip", "rename it to end in .spz if it is such a scene, else unpack it", (), (b"\x1f\x8b",)),
    FileKind(
        "a file of settings or cameras, and neither a picture nor a scene",
        "a panel goes with panel= and cameras with camera=; of scenes in JSON, meta.json and lod-meta.json are read",
        (".json", ".yaml", ".yml", ".toml"),
    ),
)
_BY_SUFFIX = {suffix: kind for kind in _KINDS for suffix in kind.suffixes}
_BY_NAME = {
    "tileset.json": FileKind("a tree of 3D Tiles", _EXPORT),
    "transforms.json": FileKind("the cameras of a capture", "fit its folder: lightfield-gs fit"),
    "cameras.json": FileKind("the cameras of a scene", "give the scene, and these with camera="),
    **dict.fromkeys(
        ("points3d.bin", "points3d.txt", "images.bin", "images.txt", "cameras.bin", "cameras.txt", "database.db"),
        FileKind("a part of a COLMAP model", "fit the folder of its photographs: lightfield-gs fit"),
    ),
}


def refuse_large_non_image(path: Path) -> None:
    """Raise InputError for a large file that does not begin as an image, or holds zeros after its header.

    The reader of images would search the whole file.
    """
    if path.stat().st_size <= _LARGE_BYTES:
        return
    start = _start(path, _BEHIND_HEADER + _ROW_BYTES)
    if not _IMAGE_STARTS.match(start):
        refuse_stand_in(path)
        refuse_video(path)
        raise InputError(f"{path} is not an image that can be read: no format begins with {start[:8].hex(' ')} (hex)")
    if _holds_zeros(path, start):
        raise InputError(
            f"{path} is damaged or cut: zeros stand where its picture should be, as a download leaves them that did "
            "not end; download it again"
        )


def _holds_zeros(path: Path, start: bytes) -> bool:
    """Tell whether a large image has zeros in place of its pixels, or of the rest of its header."""
    if _COMPRESSED_STARTS.match(start):
        return not any(start[_BEHIND_HEADER:])
    if start.startswith(b"SIMPLE") and 0 in start[:_FITS_BLOCK]:
        return True
    if _LONG_HEADERS.match(start):
        return not any(start[_FIRST_WORDS:_BEHIND_HEADER])
    if start.startswith((b"II", b"MM")):
        return not _has_directory(path, start)
    size = _PNM_SIZE.match(start)
    return size is not None and _ends_in_zeros(path, len(start) + int(size[1]) * int(size[2]) * _PNM_PIXEL)


def _has_directory(path: Path, start: bytes) -> bool:
    """Tell whether a TIFF has its first directory; True for other files that begin alike."""
    order: Literal["little", "big"] = "little" if start.startswith(b"II") else "big"
    version = int.from_bytes(start[2:4], order)
    if version not in (42, 43):
        return True
    offset = int.from_bytes(start[4:8] if version == 42 else start[8:16], order)
    with open(path, "rb") as file:
        file.seek(min(offset, path.stat().st_size))
        return any(file.read(8))


def _ends_in_zeros(path: Path, most_bytes: int) -> bool:
    """Tell whether a file is longer than `most_bytes` and ends in zeros."""
    with open(path, "rb") as file:
        if file.seek(0, os.SEEK_END) <= most_bytes:
            return False
        file.seek(-_ROW_BYTES, os.SEEK_END)
        return not any(file.read())


def _start(path: Path, size: int = _START_BYTES) -> bytes:
    with open(path, "rb") as file:
        return file.read(size)


def refuse_stand_in(path: Path) -> None:
    """Raise InputError for a Git LFS pointer or a web page; called by readers that cannot read a file."""
    try:
        start = _start(path)
    except OSError:
        return  # the caller reports it
    if start.startswith(_POINTER):
        raise InputError(f"{path} is a Git LFS pointer, not the file itself; fetch it with `git lfs pull`")
    if _WEB_PAGE.match(start):
        raise InputError(
            f"{path} is a web page (HTML), not the file itself; download it again, by the link of the raw file"
        )


def refuse_video(path: Path) -> None:
    """Raise InputError for a video by content; called by readers of images that cannot read a file."""
    start = _start(path)
    end = next((end for begins, end in _VIDEOS if begins.match(start)), None)
    if end is not None and path.suffix.lower() in VIDEO_INPUTS:
        raise InputError(
            f"{path} is a video, and an image was expected; give a picture of it, or the video to `lightfield-gs video`"
        )
    if end is not None:
        raise InputError(
            f"{path} is a video by its content, and its name says otherwise; rename it to {path.stem}{end}, so that "
            "`lightfield-gs video` and `weave` take its frames"
        )


def refuse_kind(path: object, kind: FileKind) -> None:
    """Raise InputError with a kind and its advice."""
    raise InputError(f"{path} is {kind.name}; {kind.advice}")


def refuse_unsupported(path: Path) -> None:
    """Raise InputError for a file or folder of a kind that is not read, by content, then by name.

    Paths of unknown kinds, and absent ones, pass.
    """
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


def refuse_non_image(path: Path) -> None:
    """Raise InputError for a file of another known kind; called by readers of images that cannot read a file."""
    refuse_stand_in(path)
    refuse_unsupported(path)
    with reading(path), open(path, "rb") as file:
        start = file.read(_START_BYTES)
    suffix = path.suffix.lower()
    if not start.startswith(SCENE_STARTS) and Path(path.stem).suffix.lower() in SCENE_SUFFIXES:
        raise InputError(
            f"{path} is no picture, and its name ends in {path.suffix}; if it is a scene, and its download has ended, "
            f"rename it to {path.stem}"
        )
    for kind in _NON_IMAGES:
        if kind.starts and start.startswith(kind.starts) or suffix in kind.suffixes:
            refuse_kind(path, kind)


def begins_as_scene(path: Path) -> bool:
    """Tell whether a file is a scene by its first bytes, whatever its name."""
    if not os.path.isfile(path):
        return False
    try:
        with open(path, "rb") as file:
            return file.read(4) in SCENE_STARTS
    except OSError:
        return False  # the reader reports it


def select_scenes(names: Sequence[str]) -> list[str]:
    """Select the names of scenes, without the initial points of a capture or a trainer's folder."""
    parts = {part.lower() for name in names for part in name.split("/")}
    starts = _POINT_FILES if parts & (_CAPTURE_NAMES | _TRAINER_NAMES) else ()
    return [name for name in names if name.lower().endswith(SCENE_SUFFIXES) and not name.lower().endswith(starts)]


def _refuse_folder(path: Path) -> None:
    """Raise InputError for a folder, by its contents."""
    with os.scandir(path) as entries:
        names = sorted(entry.name for entry in islice(entries, _MOST_LISTED) if not entry.name.startswith("."))
    scenes = select_scenes(names)
    lower = {name.lower() for name in names}
    if len(scenes) > 1:
        raise InputError(
            f"{path} is a folder of {len(scenes)} scenes ({scenes[0]} to {scenes[-1]}); give one of them, or the "
            "folder to lightfield-gs batch, which draws each; video and view play scenes that are numbered"
        )
    if scenes:
        raise InputError(f"{path} is a folder with one scene in it; give {path / scenes[0]}")
    if lower & _CAPTURE_NAMES:
        raise InputError(f"{path} is a capture, photographs with cameras; fit Gaussians to it: lightfield-gs fit")
    if lower & _TRAINER_NAMES or any(name.endswith(CHECKPOINT.suffixes) for name in lower):
        raise InputError(f"{path} is a folder of a trainer without an exported scene; {CHECKPOINT.advice}")
    pictures = sum(name.endswith(PICTURE_SUFFIXES) for name in lower)
    kinds = [known for name in names if (known := _BY_SUFFIX.get(Path(name).suffix.lower()))]
    if pictures > len(kinds):
        raise InputError(
            f"{path} is a folder of {pictures} pictures; one is encoded by its own name, all are in a row by "
            "lightfield-gs video, each by itself by batch, and as views of one scene by fit with sfm=True or weave"
        )
    if kinds:
        refuse_kind(f"{path} is a folder, and what it holds", kinds[0])
    deeper = sorted(
        islice((each for each in path.glob("*/*") if each.name.lower().endswith(_SCENE_ENDS)), _MOST_LISTED)
    )
    if deeper:
        scene = deeper[0].parent if deeper[0].name.lower() == "meta.json" else deeper[0]
        raise InputError(f"{path} is a folder, and its scenes are in the folders in it; give one of them: {scene}")
    raise InputError(
        f"{path} is a folder, and no scene is in it ({', '.join(names[:3]) or 'it is empty'}); give a file"
    )
