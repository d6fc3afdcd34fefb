"""The page of contributors shows CONTRIBUTING.md, which stands at the top of the repository and nowhere else."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

SOURCE = "CONTRIBUTING.md"


def on_page_markdown(markdown: str, *, page: Any, config: Any, **_: Any) -> str:
    """Appends CONTRIBUTING.md, but for its title, to the page of that name.

    Its links into docs/ lead to pages here; of other files of the repository, which the website does not have, the name
    is left.
    """
    source = Path(config["config_file_path"]).parent / SOURCE
    if page.file.src_uri != SOURCE.lower() or not source.is_file():
        return markdown
    text = re.sub(r"\A# .*\n", "", source.read_text(encoding="utf-8"))
    text = re.sub(r"\[([^\]]+)\]\((?!docs/|https?:|#)[^)]+\)", r"\1", text)
    return f"{markdown}\n{text.replace('](docs/', '](')}"


def on_serve(server: Any, *, config: Any, **_: Any) -> None:
    """Builds the page anew when the file changes."""
    server.watch(str(Path(config["config_file_path"]).parent / SOURCE))
