"""What a build has made, as the server gives it out."""

from __future__ import annotations

from pathlib import Path

from facepipe.core.errors import InputError
from facepipe_web import build


def page_files() -> dict[str, Path]:
    """Path on the server -> file, of the page and all that it loads.

    :raises InputError: nothing built, or from other sources
    """
    if not build.is_built():
        what = "is older than its sources" if build.DIST.exists() else "is not built"
        raise InputError("viewer", f"{what}, expected `python -m facepipe_web.build` before (needs node 20 and npm)")
    files = {f"/{file.relative_to(build.DIST).as_posix()}": file for file in build.DIST.rglob("*") if file.is_file()}
    return files | {"/": build.DIST / "index.html"}
