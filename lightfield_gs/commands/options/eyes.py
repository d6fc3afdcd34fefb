"""Options of eyes that are tracked."""

from __future__ import annotations

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import Add, in_group, rarely
from lightfield_gs.commands.options.parser import numbers, within


def add_eyes(add: Add) -> None:
    """Add the options of where a viewer's eyes come from, and of the camera that sees them."""
    add = in_group(add, groups.TRACKING)
    add(
        "--eyes",
        metavar="SOURCE",
        short="follow the viewer's eyes: track, camera:1, udp:5005",
        help="two views in place of the panel's, one for each eye, which follow the viewer's eyes; without a 3D "
        "display a scene behind the screen, as behind a window. track: by camera:0; another camera, a video or a "
        "stream, as in `live` (extra eyes); udp:PORT or udp:ADDRESS:PORT: lines of x y z of the left eye and of the "
        "right eye, mm before the middle of the display; a .txt of such lines, with seconds before each",
    )
    add = rarely(add)
    add(
        "--tracker-fov",
        type=within(10, 170, "degrees"),
        metavar="DEG",
        help="of --eyes: full angle that the camera sees from left to right (default 65)",
    )
    add(
        "--tracker-at",
        type=numbers(3),
        metavar="X,Y,Z",
        help="of --eyes: place of the camera before the middle of the display in mm, to the right, up and towards the "
        "viewer; it looks straight ahead (default: in the middle, 10 mm above the upper edge)",
    )
