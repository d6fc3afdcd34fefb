"""Files on the network that are fetched once, into the folder of torch.hub."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.base.errors import InputError


@dataclass(frozen=True)
class RemoteFile:
    """A file on the network.

    Attributes:
        url: Its address.
        sha256: Its digest, or how that begins.
    """

    url: str
    sha256: str

    @property
    def path(self) -> Path:
        """Where it lies once it was fetched: in the folder of torch.hub."""
        import torch

        return Path(torch.hub.get_dir()) / "checkpoints" / self.url.rsplit("/", 1)[1]

    def fetched(self, need: str, about: str, other_way: str, say: Callable[[str], None]) -> Path:
        """Return its path, after a download if there is no such file.

        Args:
            need: What it is needed for, as the beginning of a sentence.
            about: Its size, and perhaps its licence.
            other_way: What else a user can do, where it cannot be fetched.
            say: Called with a line before a download.

        Raises:
            InputError: The file could not be fetched.
        """
        import torch

        path = self.path
        if path.is_file():
            return path
        say(f"fetching {path.name} ({about}) once: {self.url} to {path.parent}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(self.url, str(path), hash_prefix=self.sha256, progress=False)
        except (OSError, RuntimeError) as error:
            words = " ".join(str(error).split())[:200]
            raise InputError(
                f"{need}, which could not be fetched ({words}): save {self.url} in the folder {path.parent}, or "
                f"{other_way}"
            ) from None
        return path
