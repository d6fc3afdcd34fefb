"""Numbers made of large square dots, which stay readable where the picture has one sample a lens."""

from __future__ import annotations

import numpy as np

# Three dots wide and five high, row by row
_GLYPHS = {
    "0": "### #.# #.# #.# ###",
    "1": ".#. ##. .#. .#. ###",
    "2": "### ..# ### #.. ###",
    "3": "### ..# .## ..# ###",
    "4": "#.# #.# ### ..# ..#",
    "5": "### #.. ### ..# ###",
    "6": "### #.. ### #.# ###",
    "7": "### ..# ..# .#. .#.",
    "8": "### #.# ### #.# ###",
    "9": "### #.# ### ..# ###",
    "+": "... .#. ### .#. ...",
    "-": "... ... ### ... ...",
    ".": "... ... ... ... .#.",
    " ": "... ... ... ... ...",
}
_DOTS = {letter: np.array([[dot == "#" for dot in row] for row in rows.split()]) for letter, rows in _GLYPHS.items()}
HEIGHT_DOTS = 7  # of a line of text, with a dot of margin on either side


def width_dots(characters: int) -> int:
    """Width of so many characters, with a dot between them and a margin of one dot on either side."""
    return 4 * characters + 1


def text_dots(text: str) -> np.ndarray:
    """Which dots of a text are lit: bool [HEIGHT_DOTS, width_dots(len(text))]; text: of digits, + - . and spaces."""
    out = np.zeros((HEIGHT_DOTS, width_dots(len(text))), bool)
    for place, letter in enumerate(text):
        out[1:6, 4 * place + 1 : 4 * place + 4] = _DOTS[letter]
    return out


def text_pixels(text: str, dot_px: int) -> np.ndarray:
    """The text with dots of dot_px x dot_px pixels: bool [HEIGHT_DOTS dot_px, width_dots(len(text)) dot_px]."""
    return text_dots(text).repeat(dot_px, 0).repeat(dot_px, 1)
