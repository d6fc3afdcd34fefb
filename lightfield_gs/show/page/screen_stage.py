"""A scene on a screen that shows no fan of views, drawn for the page."""

from __future__ import annotations

from lightfield_gs.show.page.stage import STILL_WIDTH_PX, Controls, Picture, Stage, timed


class ScreenStage(Stage):
    """Draws the pictures of the page; see Stage. Others say how the picture of the screen is drawn.

    Attributes:
        picture_words: Words on the picture of the screen.
    """

    is_for_browsers = False
    picture_words = ""

    def eye(self, controls: Controls, width_px: int, still: bool) -> Picture:
        """Draw the picture that an eye at controls.eye sees, without lenses."""
        stages: dict[str, float] = {}
        with timed(stages, "view"):
            view = self._views(controls, [controls.eye], STILL_WIDTH_PX if still else width_px)[0]
        return Picture(view, f"one view, {view.shape[1]} x {view.shape[0]}", stages)

    def crop(self, controls: Controls, centre: tuple[float, float], size_px: tuple[int, int], still: bool) -> Picture:
        """Return pixels of the picture of the screen one to one, around a point of it."""
        native, stages = self.native(controls)
        sides = native.shape[1::-1]
        sizes = [min(size, side) for size, side in zip(size_px, sides)]
        left, top = (round(part * (side - size)) for part, side, size in zip(centre, sides, sizes))
        right, bottom = left + sizes[0], top + sizes[1]
        words = f"pixels {left}..{right - 1} x {top}..{bottom - 1} of {self.picture_words}"
        return Picture(native[top:bottom, left:right], words, stages)
