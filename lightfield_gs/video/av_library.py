"""PyAV, which brings FFmpeg's libraries along: an optional extra.

The wheels of PyAV hold x264 and x265, which are under the GPL; nothing here needs them to be installed but videos.
"""

from __future__ import annotations

from types import ModuleType

from lightfield_gs.base.errors import InputError


def av_library(purpose: str) -> ModuleType:
    """The module `av`. Raises InputError where it is not installed; purpose: what it is needed for."""
    try:
        import av
    except ImportError:
        raise InputError(f"{purpose} needs PyAV, which is not installed: pip install 'lightfield-gs[video]'") from None
    return av
