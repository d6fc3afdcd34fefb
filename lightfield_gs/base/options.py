"""The words that options may have, each set written once: as types for checkers, and for checks at run time."""

from __future__ import annotations

from typing import Literal, get_args

Method = Literal["direct", "sorted", "classic"]
Views = Literal["integer", "continuous"]
Output = Literal["uint8", "float32", "float64"]
QualityName = Literal["exact", "high", "fast", "draft"]
SubpixelOrder = Literal["RGB", "BGR"]
CellRule = Literal["unity", "webxr"]
CellRows = Literal["bottom", "top"]
DepthKind = Literal["distance", "ray", "disparity"]
DepthInvalid = Literal["far", "hole"]
DepthPart = Literal["right", "left", "top", "bottom"]
MapOrientation = Literal["stored", "upright"]
Fit = Literal["auto", "cover", "contain"]
Compression = Literal["fast", "small"]
Detail = Literal["auto", 1, 2, 4]
Device = Literal["auto", "cpu", "cuda"]
Density = Literal["mcmc", "adaptive"]
LossName = Literal["l1-ssim", "wd"]
Masks = Literal["ignore", "alpha"]
PhotosOn = Literal["auto", "memory", "disk"]
MomentsOn = Literal["auto", "device", "host"]
CameraModel = Literal["pinhole", "orthographic", "fisheye", "equirectangular"]
RollingShutter = Literal["none", "top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]
RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
TestEvery = int | Literal["own"] | None  # see Capture.split
VideoKind = Literal["native", "quilt", "2d", "stereo"]
CodecName = Literal["ffv1", "h264-rgb", "h264", "hevc"]
StereoInput = Literal["sbs", "half-sbs", "tab", "half-tab", "two", "none"]
StereoLayout = Literal["sbs", "half-sbs", "tab", "mpo", "anaglyph", "left-right"]

METHODS: tuple[Method, ...] = get_args(Method)
VIEWS: tuple[Views, ...] = get_args(Views)
OUTPUTS: tuple[Output, ...] = get_args(Output)
QUALITY_NAMES: tuple[QualityName, ...] = get_args(QualityName)
SUBPIXEL_ORDERS: tuple[SubpixelOrder, ...] = get_args(SubpixelOrder)
CAMERA_MODELS: tuple[CameraModel, ...] = get_args(CameraModel)  # in the order of csrc/scene/camera.h
ROLLING_SHUTTERS: tuple[RollingShutter, ...] = get_args(RollingShutter)
RENDER_MODES: tuple[RenderMode, ...] = get_args(RenderMode)
CELL_RULES: tuple[CellRule, ...] = get_args(CellRule)
CELL_ROWS: tuple[CellRows, ...] = get_args(CellRows)
DEPTH_KINDS: tuple[DepthKind, ...] = get_args(DepthKind)
DEPTH_INVALID: tuple[DepthInvalid, ...] = get_args(DepthInvalid)
DEPTH_PARTS: tuple[DepthPart, ...] = get_args(DepthPart)
MAP_ORIENTATIONS: tuple[MapOrientation, ...] = get_args(MapOrientation)
FITS: tuple[Fit, ...] = get_args(Fit)
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)
DETAILS: tuple[Detail, ...] = get_args(Detail)
DEVICES: tuple[Device, ...] = get_args(Device)
STEREO_INPUTS: tuple[StereoInput, ...] = get_args(StereoInput)
STEREO_LAYOUTS: tuple[StereoLayout, ...] = get_args(StereoLayout)
DENSITIES: tuple[Density, ...] = get_args(Density)
LOSSES: tuple[LossName, ...] = get_args(LossName)
MASKS: tuple[Masks, ...] = get_args(Masks)
PHOTOS_ON: tuple[PhotosOn, ...] = get_args(PhotosOn)
MOMENTS_ON: tuple[MomentsOn, ...] = get_args(MomentsOn)
VIDEO_KINDS: tuple[VideoKind, ...] = get_args(VideoKind)
CODECS: tuple[CodecName, ...] = get_args(CodecName)
UP_AXES = ("x", "y", "z", "-x", "-y", "-z")
PRESET_SIZES = {"hololuminescent": (3840, 2160)}  # of videos by their --preset, pixels

# Arguments that only one method of `encode` takes; the options of the command have the same names
ONLY_FOR: dict[str, Method] = {
    "cameras": "sorted",
    "view_map": "sorted",
    "memory_budget": "sorted",
    "quality": "direct",
    "out": "direct",
    "device": "direct",
}

# The network that estimates depth (Yang et al., "Depth Anything V2", 2024), by its name on huggingface.co. The larger
# networks of its family may not be used commercially.
DEPTH_MODEL = "depth-anything/Depth-Anything-V2-Small-hf"
DEFAULT_QUILT = "65"  # preset of a quilt, where no display is connected
DEFAULT_PANEL = "65in-8k-96v"  # where no display is connected
MOST_FRAMES = 1_000_000  # of a video
DEFAULT_SECONDS = 10.0  # of a turntable
POSE_MODEL = "DA3-BASE"  # that messages propose: its weights are free for any use
POSED_FRAMES = 100  # of a film or a burst, at most: enough for an arc of 50 degrees, and matched in minutes
BRIDGE_URL = "http://localhost:33334"  # of Looking Glass Bridge
DEFAULT_CONE_DEG = 40.0  # cone of a panel that states none
