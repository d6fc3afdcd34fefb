"""The arguments of `lightfield-gs view`."""

from __future__ import annotations

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.eyes import add_eyes
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_stats
from lightfield_gs.commands.options.panel import add_camera, add_drawing_device, add_look, add_panel, add_rendering
from lightfield_gs.commands.options.parser import Parser
from lightfield_gs.commands.options.scene import add_input, add_scene
from lightfield_gs.commands.options.serving import add_serving
from lightfield_gs.commands.options.stereo import add_stereo
from lightfield_gs.commands.options.video import add_fps


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs view`."""
    parser.description = "See and adjust a photo or a scene in the browser as the display shows it."
    parser.epilog = (
        "The page shows the picture that an eye before the display sees; depth, focus, turn, size and background "
        "are adjusted there, and other photos dropped on it. Ctrl-C ends it."
    )
    parser.text.examples = (
        ("view photo.jpg", "for the connected display"),
        ("view scene.ply --panel 27", "for a Looking Glass 27"),
        ("view holidays", "all photos and scenes of a folder"),
        ("view dance --fps 24", "numbered scenes as a film"),
        ("view photo.jpg --stereo half-sbs", "for a 3D television"),
        ("view scene.ply --eyes track", "follow the viewer's eyes"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add_input(
        add,
        "a photo, a scene, or a folder of them",
        "; or a folder of such, of which the page opens each, or of numbered scenes, which it plays",
    )
    add_fps(add, "numbered scenes a second (default 30)")
    add_stereo(add, "--stereo and --eyes")
    add_eyes(add)
    add_panel(add, "for framing, and for the eye on the page")
    add_camera(add)
    add_look(add)
    add_scene(add, "cut the object out of a photo with rembg, as in `encode`")
    add_rendering(add)
    add_drawing_device(add)
    add_serving(add)
    add_stats(add)
