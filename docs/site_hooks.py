"""MkDocs: pages of the repository that lie outside this folder, and the links between pages."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PAGES = {  # file of the repository -> page of the site
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "benchmarks/README.md": "measuring.md",
    "samples/README.md": "samples.md",
    "training/README.md": "training.md",
}
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!\w+:|#)([^)#\s]*)(#[^)]*)?\)|(!\[[^\]]*\])\((?!\w+:)([^)\s]*)\)")


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages from outside."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links as they are on the site; what has no page there is text."""
    sources = {site: source for source, site in PAGES.items()}
    folder = posixpath.dirname(sources.get(page.file.src_uri, f"docs/{page.file.src_uri}"))
    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.DOTALL | re.MULTILINE)  # code stays
    parts[::2] = [_LINK.sub(lambda match: _link(match, folder), part) for part in parts[::2]]
    return "".join(parts)


def _link(match: re.Match[str], folder: str) -> str:
    text, target, anchor, picture, shown = match.groups()
    path = posixpath.normpath(posixpath.join(folder, target or shown))
    place = PAGES.get(path) or (path.removeprefix("docs/") if path.startswith("docs/") else None)
    if picture:
        return f"{picture}({place})"
    return text if place is None else f"[{text}]({place}{anchor or ''})"
