"""The eyes of the nearest face in a picture, by YuNet (Wu, Peng & Yu, Machine Intelligence Research 2023) in OpenCV."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.fetch import RemoteFile

WEIGHTS = RemoteFile(
    "https://media.githubusercontent.com/media/opencv/opencv_zoo/main/models/face_detection_yunet/"
    "face_detection_yunet_2023mar.onnx",
    "8f2383e4dd3cfbb4553ea8718107fc0423210dc964f9f4280604804ed2552fa4",
)
_ABOUT = "233 kB, MIT"
INSTALL = "pip install 'lightfield-gs[eyes]'"
_LEAST_SCORE = 0.7  # 0..1, of a face
_EYES = slice(4, 8)  # x and y of both eyes in a row of the answer, after the four numbers of the face's box


class FaceDetector:
    """Finds the nearest face.

    Args:
        say: Called with a line before the weights are fetched, once.

    Raises:
        InputError: OpenCV is not installed, or the weights can be had neither here nor there.
    """

    def __init__(self, say: Callable[[str], None]):
        self._network = open_network(say)

    def eyes_px(self, picture: np.ndarray) -> np.ndarray | None:
        """Return x and y of the left and the right eye [2, 2] of the person whose eyes are farthest apart in a picture.

        Args:
            picture: uint8 [H, W, 3], red, green and blue, not mirrored, upright.

        Returns:
            Pixels; None where no face is found.
        """
        height, width = picture.shape[:2]
        self._network.setInputSize((width, height))
        _, faces = self._network.detect(np.ascontiguousarray(picture[..., ::-1]))
        if faces is None or not len(faces):
            return None
        pairs = np.asarray(faces, np.float64)[:, _EYES].reshape(-1, 2, 2)
        apart = np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1)
        pair = pairs[apart.argmax()]
        if not apart.max() >= 1 or not np.isfinite(pair).all():
            return None
        # A person's left eye is at the right in a picture that is not mirrored
        return pair[pair[:, 0].argsort()[::-1]]


def open_network(say: Callable[[str], None]) -> Any:
    """Return OpenCV's detector with its weights. Raises InputError."""
    try:
        from cv2 import FaceDetectorYN
    except ImportError as error:
        raise InputError(
            f"eyes are found by OpenCV, which could not be imported ({error}): {INSTALL}; or give their positions by "
            "eyes=udp:PORT or by a file"
        ) from None
    path = WEIGHTS.fetched("eyes are found by the weights of YuNet", _ABOUT, "give eyes=udp:PORT or a file", say)
    try:
        return FaceDetectorYN.create(str(path), "", (320, 320), _LEAST_SCORE)
    except Exception as error:  # of OpenCV: the file may be anything
        words = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected the weights of YuNet, but {words}; remove it, then it is fetched") from None
