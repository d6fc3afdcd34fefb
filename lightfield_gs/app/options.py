"""The options of the commands as data: options of a scene, its cameras, its picture and its files.

Names are as on the command line, with underscores; None is a missing option.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lightfield_gs.base.options import (
    DEPTH_MODEL,
    Compression,
    DepthInvalid,
    DepthKind,
    Fit,
    MapOrientation,
    Method,
    QualityName,
    StereoInput,
    StereoLayout,
    Views,
)
from lightfield_gs.io.stereo_names import PairLayout

# In place of the file of --depth: a network estimates the depths, or the photo is a plane
AUTO, FLAT = Path("auto"), Path("flat")
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class PanelOptions:
    """The panel, and the distance it is seen from.

    Attributes:
        panel: name of a profile, or a path to one. None: the default panel, or the panel that an image names.
        device_serial: the display, where a Looking Glass .json has calibrations of several.
        viewing_distance: mm. None: the panel's own.
    """

    panel: str | None = None
    device_serial: str | None = None
    viewing_distance: float | None = None


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """The cameras of the views.

    Attributes:
        rig: file of a rig.
        camera: file of the centre camera, and its index there (None: the first).
        up: axis that points up in the scene's file, for automatic framing.
        turn, tilt: degrees that the cameras go to the right and up round the scene. None: not at all.
    """

    rig: Path | None = None
    camera: tuple[Path, int | None] | None = None
    up: str | None = None
    turn: float | None = None
    tilt: float | None = None


@dataclass(frozen=True, slots=True)
class LookOptions:
    """Depth, size and place of the picture on the panel.

    Attributes:
        focus: depth of the panel's plane in scene units, or the point x, y of the picture (0..1) that lies in it.
        depth_amount: factor of all disparities, 0..2.
        cone: full angle of the fan of cameras, degrees.
        zoom: size of the picture, about its middle.
        pan: shift to the right and down, in widths and heights of the panel.
        depth_report: whether to report how deep the scene is.
    """

    focus: float | tuple[float, ...] | None = None
    depth_amount: float | None = None
    cone: float | None = None
    zoom: float | None = None
    pan: tuple[float, ...] | None = None
    depth_report: bool = False


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """Anti-aliasing and background of a picture. Defaults are for commands without the option.

    Attributes:
        antialiased: None: as the scene's file says that it was trained.
        view_filter: width of the box over which views are averaged, in views of the panel.
        background: red, green and blue, 0..1. None: light or dark for a photo of one object; for a scene the background
            that it was fitted before, else white.
    """

    antialiased: bool | None = False
    view_filter: float = 0.0
    background: tuple[float, float, float] | None = WHITE


@dataclass(frozen=True, slots=True)
class PhotoOptions:
    """The scene that is made of a photo.

    Attributes:
        mask: file of a cut-out.
        remove_background: whether rembg cuts the object out.
        clean_edges: whether edges of a cut-out lose the colour of the old background. None: they do.
        map_orientation: whether mask and depth map have the pixels as stored or upright.
        checkpoint: weights of the network.
        detail: factor of the photo's resolution on the object, "auto", or "none" for the network's own colours.
        detail_budget: most Gaussians of the detail "auto".
        depth: file of the depth map, AUTO or FLAT.
        depth_model: name or folder of the network of AUTO.
        depth_kind: meaning of the map's numbers.
        depth_range: distances at the ends of the map's full scale, near and far.
        depth_scale: distance of one step of the map's numbers.
        depth_invalid: what infinite distances are.
        rgbd: the half of the photo that is its depth map.
        pixel_aspect: width by height of a pixel.
        fov: angle of the longer side, degrees.
        intrinsics: fx, fy, cx, cy in pixels.
        fit: how the photo fills a panel of another shape.
        stereo_in: where the two eyes' pictures of a stereo pair are. None: as its file says; "none": it is one photo.
        swap_eyes: whether the right eye's picture comes first, or not first where the file says so.
        pair: where the two eyes' pictures of a video are, as its metadata states.
        film_parallax: x_left - x_right of the farthest and the nearest things of a film of pairs, by the width. Frames
            whose pictures do not match are then flat. None: each picture has ends of its own.
        is_in_row: whether pictures that follow are fitted as this one: about their middle, not about its subject.
        is_smooth: whether what the photo does not show gets smooth colours in little time, in place of texture.
    """

    mask: Path | None = None
    remove_background: bool = False
    clean_edges: bool | None = None
    map_orientation: MapOrientation | None = None
    checkpoint: Path | None = None
    detail: str | int | None = None
    detail_budget: int | None = None
    depth: Path | None = None
    depth_model: str | None = None
    depth_kind: DepthKind | None = None
    depth_range: tuple[float, float] | None = None
    depth_scale: float | None = None
    depth_invalid: DepthInvalid | None = None
    rgbd: str | None = None
    pixel_aspect: float | None = None
    fov: float | None = None
    intrinsics: tuple[float, ...] | None = None
    fit: Fit | None = None
    stereo_in: StereoInput | None = None
    swap_eyes: bool = False
    pair: PairLayout | None = None
    film_parallax: tuple[float, float] | None = None
    is_in_row: bool = False
    is_smooth: bool = False

    @property
    def is_estimated(self) -> bool:
        """Whether a network estimates the depths."""
        return self.depth == AUTO

    @property
    def depth_file(self) -> Path | None:
        """The file of the depth map; None where there is none or a network estimates it."""
        return None if self.is_estimated or self.is_flat else self.depth

    @property
    def is_flat(self) -> bool:
        """Whether the whole photo is a plane."""
        return self.depth == FLAT

    @property
    def depth_network(self) -> str:
        """Name or folder of the network that estimates depths."""
        return self.depth_model or DEPTH_MODEL


@dataclass(frozen=True, slots=True)
class SceneOptions:
    """The scene: a file of Gaussians or a photo.

    Attributes:
        input: the file.
        skip_invalid: whether to leave out Gaussians without meaning.
        time: the time at which moving Gaussians are drawn.
        lod: the level of detail of a streamed SOG.
        photo: the options of a photo.
    """

    input: Path
    skip_invalid: bool = False
    time: float | None = None
    lod: int | None = None
    photo: PhotoOptions = field(default_factory=PhotoOptions)


@dataclass(frozen=True, slots=True)
class StereoOptions:
    """Pictures of two eyes, in place of the image of a panel.

    Attributes:
        stereo: how they are stored. None: the image of a panel is asked for.
        eye_distance: between the eyes, mm. None: the user's own, as the next one, see `own_eyes`.
        screen_size: diagonal of the screen, inches.
        eye_size: width and height of the picture of one eye, pixels. None: 1920 x 1080.
    """

    stereo: StereoLayout | None = None
    eye_distance: float | None = None
    screen_size: float | None = None
    eye_size: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class EyesOptions:
    """Eyes that are tracked.

    Attributes:
        eyes: where their positions come from, see `lightfield_gs.tracking.sources`. None: they are not tracked.
        tracker_fov: full angle of the camera that sees them, degrees. None: DEFAULT_FOV_DEG.
        tracker_at: place of this camera before the middle of the display, mm. None: above its upper edge.
        eye_distance: see StereoOptions, also for the next two.
        screen_size: of a screen without lenses. None: it has lenses, where a display with lenses is named or connected.
        eye_size: of the picture of a screen without lenses.
    """

    eyes: str | None = None
    tracker_fov: float | None = None
    tracker_at: tuple[float, float, float] | None = None
    eye_distance: float | None = None
    screen_size: float | None = None
    eye_size: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class EncodeOptions:
    """One input that becomes the image of a panel.

    Attributes:
        output: the image.
        scene, panel, camera, look, render: see there.
        cameras: file with one camera for each view, in place of a rig.
        view_map: file with the view of each sub-pixel, in place of the lens.
        method, memory_budget, views, quality, threads: see `lightfield_gs.encode`.
        device: auto, cpu, cuda, webgpu or webgpu:N.
        bit_depth: bits of a sample in the file. None: 8, or 32 for .exr.
        compression: of the file.
        save_rig, save_gaussians: files for the rig and the scene.
        preview: folder for preview pictures.
        stats: whether to print statistics.
        stereo: pictures of two eyes in place of the image.
    """

    output: Path
    scene: SceneOptions
    panel: PanelOptions
    camera: CameraOptions
    look: LookOptions
    render: RenderOptions
    cameras: Path | None = None
    view_map: Path | None = None
    method: Method = "direct"
    memory_budget: int | None = None
    views: Views = "integer"
    quality: QualityName = "exact"
    device: str = "auto"
    threads: int | None = None
    bit_depth: int | None = None
    compression: Compression = "fast"
    save_rig: Path | None = None
    save_gaussians: Path | None = None
    preview: Path | None = None
    stats: bool = False
    stereo: StereoOptions = field(default_factory=StereoOptions)

    def outputs(self) -> list[Path | None]:
        """Return all files to write; None for files not asked for."""
        beside = None if self.save_gaussians is None else rig_beside(self.save_gaussians)
        outputs = [self.output, self.save_rig, self.save_gaussians, None if beside == self.save_rig else beside]
        if self.preview is None:
            return outputs
        from lightfield_gs.show.preview import FILES

        return [*outputs, *(self.preview / name for name in FILES)]

    def inputs(self) -> tuple[Path | str | None, ...]:
        """Return all files to read, the scene first; None for missing files."""
        return files_read(self.scene, self.camera, self.panel, self.cameras, self.view_map)


def rig_beside(scene: Path) -> Path | None:
    """Return the file of the framing that is written beside a scene; None where the scene holds it itself."""
    from lightfield_gs.panels.stored_rigs import needs_rig_beside, rig_path

    return rig_path(scene) if needs_rig_beside(scene) else None


def files_read(
    scene: SceneOptions, camera: CameraOptions, panel: PanelOptions, *more: Path | None
) -> tuple[Path | str | None, ...]:
    """Return the input files of the options, the scene first; None for missing files."""
    photo = scene.photo
    files = (scene.input, camera.rig, panel.panel, photo.mask, photo.depth, photo.checkpoint, *more)
    return (*files, camera.camera and camera.camera[0])
