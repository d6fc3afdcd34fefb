"""The files of a network for depths: in a folder, in the cache of huggingface_hub, or fetched."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_MODEL

INSTALL = "pip install 'lightfield-gs[photo]'"
OTHER_WAY = "or give a depth map with depth=FILE"


class Files(NamedTuple):
    """The files of a family of networks, as patterns.

    Attributes:
        taken: All that are fetched. Weights in formats that could run code as they are read are never among them.
        needed: Those without which it was not fetched.
    """

    taken: tuple[str, ...]
    needed: tuple[str, ...]


_OF_TRANSFORMERS = Files(("*.json", "*.safetensors"), ("config.json", "preprocessor_config.json", "*.safetensors"))
_OF_FAMILIES = {  # by a part of their names on huggingface.co; .pt and .pth are read as tensors alone
    "/da3": Files(("config.json", "*.safetensors"), ("config.json", "*.safetensors")),
    "/moge-2": Files(("model.pt",), ("model.pt",)),
    "video-depth-anything": Files(("*.pth",), ("*.pth",)),
}
_SHORT_NAMES = {
    "da3mono-large": "depth-anything/DA3MONO-LARGE",
    "moge-2": "Ruicheng/moge-2-vitl",
    "video-depth-anything": "depth-anything/Video-Depth-Anything-Small",
}
_ABOUT = {
    DEPTH_MODEL: "99 MB, Apache-2.0",
    "depth-anything/DA3MONO-LARGE": "about 1.4 GB, Apache-2.0",
    "Ruicheng/moge-2-vitl": "about 1.3 GB, MIT",
    "depth-anything/Video-Depth-Anything-Small": "about 120 MB, Apache-2.0",
}


def model_folder(model: str, say: Callable[[str], None] | None) -> str:
    """Return the folder with a model's files, fetched where missing.

    Args:
        model: A folder, a name on huggingface.co, or one of the short names.
        say: Called with a message before a download.

    Raises:
        InputError: The package huggingface_hub or the files are missing.
    """
    if Path(model).is_dir():
        return str(Path(model).resolve())
    model = _SHORT_NAMES.get(model.lower(), model)
    try:
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import HFValidationError
    except ImportError as error:
        raise not_installed(error) from None
    files = next((found for part, found in _OF_FAMILIES.items() if part in model.lower()), _OF_TRANSFORMERS)
    try:
        folder = snapshot_download(model, allow_patterns=list(files.taken), local_files_only=True)
        if all(any(Path(folder).glob(pattern)) for pattern in files.needed):
            return folder
    except HFValidationError:
        raise InputError(
            f"depth_model=: expected a name of huggingface.co, such as {DEPTH_MODEL}, or a folder; there is no "
            f"folder {model}"
        ) from None
    except OSError:
        pass  # it was never fetched
    about = _ABOUT.get(model, f"its licence: huggingface.co/{model}")
    if say is not None:
        say(f"fetching the depth network {model} from huggingface.co, once ({about})")
    try:
        return snapshot_download(model, allow_patterns=list(files.taken))
    except Exception as error:  # of the connection, the server or the disk: it may be anything
        raise InputError(
            f"the depth network {model} ({about}) is not on this machine and could not be fetched: with a connection, "
            f"run `hf download {model}` once; or copy its folder here for depth_model=FOLDER, {OTHER_WAY}. It failed "
            f"with: {short_message(error.__cause__ or error)}"
        ) from None


def not_installed(error: ImportError) -> InputError:
    """Return the refusal of a machine without the extra."""
    return InputError(
        f"transformers, which has depth networks, could not be imported ({error}): {INSTALL}; {OTHER_WAY}"
    )


def short_message(error: BaseException) -> str:
    """Return an error's message as one short line."""
    return " ".join(str(error).split())[:200] or type(error).__name__
