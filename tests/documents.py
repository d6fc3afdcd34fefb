"""README.md and docs/*.md taken apart: blocks, headings, links and names of files."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LANGUAGES = {"sh", "python", "yaml", "json", "text"}
# Why a block may be left unrun; see Block.needs.
REASONS = {"gpu", "network", "blender", "browser", "display", "kernel", "photographs"}

_BLOCK = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_MARK = re.compile(r"<!-- needs: ([a-z]+) -->\n\Z")
_INCLUDED = re.compile(r'--8<-- "([^"]+)"\n')
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_TOP_FOLDERS = "benchmarks|csrc|lightfield_gs|training|configs|tests|notebooks|docs|cmake"


@dataclass(frozen=True)
class Block:
    """A fenced block. needs: what the comment `<!-- needs: ... -->` before it says that running it takes, or None."""

    language: str
    text: str
    needs: str | None

    @property
    def included(self) -> str | None:
        """The path of the file whose text the block has, if it has no text of its own."""
        found = _INCLUDED.fullmatch(self.text)
        return found and found[1]


def blocks(document: Path) -> list[Block]:
    text = document.read_text(encoding="utf-8")
    found = []
    for match in _BLOCK.finditer(text):
        mark = _MARK.search(text[: match.start()])
        found.append(Block(match[1].strip(), match[2], mark[1] if mark else None))
    return found


def prose(document: Path) -> str:
    """The text without fenced blocks and comments."""
    return re.sub(r"<!--.*?-->", "", _BLOCK.sub("", document.read_text(encoding="utf-8")), flags=re.DOTALL)


def anchors(document: Path) -> set[str]:
    """Return the anchors of a document's headings, as MkDocs and others make them."""
    headings = re.findall(r"^#+ (.+)$", prose(document), re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


def links(document: Path) -> list[str]:
    """Targets of links and pictures that lead to files here."""
    return [target for target in _LINK.findall(prose(document)) if not target.startswith(("http:", "https:"))]


def named_paths(document: Path) -> set[str]:
    """Files and folders of the repository that a document names in `code`."""
    names = re.findall(r"`([\w./-]+)`", prose(document))
    return {name for name in names if re.match(rf"({_TOP_FOLDERS})/", name)}
