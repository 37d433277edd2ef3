"""Builds the page and the runtime from their sources: ``python -m facepipe_web.build``.

Needs node (20 or newer) and npm; the packages are those of package-lock.json. Also run by the build hook of wheels,
where no other module of facepipe can be imported: this one stands alone.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
DIST = HERE / "dist"
STAMP = "build.json"
_PATIENCE = 600  # seconds
_SOURCES = ("src/**/*", "licences/*", "build.mjs", "package.json", "package-lock.json", "tsconfig.json")


def sources_digest() -> str:
    """SHA-256 over names and contents of all sources."""
    files = sorted(file for pattern in _SOURCES for file in HERE.glob(pattern) if file.is_file())
    lines = [
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.relative_to(HERE).as_posix()}\n" for file in files
    ]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def is_built() -> bool:
    """Whether dist/ is there, and made of the sources as they are."""
    try:
        stamp = json.loads((DIST / STAMP).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(stamp, dict) and stamp.get("sources") == sources_digest()


def page_files() -> dict[str, Path]:
    """Path on a server -> file of the page; nothing where it isn't built."""
    return {f"/{file.relative_to(DIST).as_posix()}": file for file in DIST.rglob("*") if file.is_file()}


def build() -> None:
    """Make dist/, whole or not at all; the node packages are installed where they are missing.

    :raises RuntimeError: node or npm is missing, or they end with an error
    """
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        raise RuntimeError("needs node (20 or newer) and npm on the PATH")
    try:
        present = _locked(HERE / "node_modules" / ".package-lock.json")
    except (OSError, ValueError):
        present = {}
    wanted = _locked(HERE / "package-lock.json")  # of optional ones, other machines' are left out
    needed = {name: entry["version"] for name, entry in wanted.items() if name and not entry.get("optional")}
    if any(present.get(name, {}).get("version") != version for name, version in needed.items()):
        _run([npm, "ci", "--no-audit", "--no-fund", "--ignore-scripts"])
    # beside it, then in its place: a server that runs meanwhile gives out no half of a page
    digest, temporary, former = sources_digest(), DIST.with_name("dist.new"), DIST.with_name("dist.former")
    try:
        _run([node, "build.mjs", str(temporary)])
        (temporary / STAMP).write_text(json.dumps({"sources": digest}), encoding="utf-8")
        shutil.rmtree(former, ignore_errors=True)
        if DIST.exists():
            DIST.rename(former)
        temporary.rename(DIST)
    finally:
        for left in (temporary, former):
            shutil.rmtree(left, ignore_errors=True)


def main() -> int:
    """Build, and print the size; the exit code."""
    try:
        build()
    except RuntimeError as error:
        sys.stderr.write(f"facepipe_web.build: {error}\n")
        return 2
    total = sum(file.stat().st_size for file in DIST.rglob("*") if file.is_file())
    sys.stdout.write(f"{DIST}: {total:,} bytes\n")
    return 0


def _locked(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["packages"]
    return found


def _run(command: Sequence[str]) -> None:
    try:
        done = subprocess.run(command, cwd=HERE, capture_output=True, text=True, timeout=_PATIENCE, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RuntimeError(f"{Path(command[0]).name} {command[1]}: {error}") from error
    if done.returncode:
        output = (done.stderr.strip() or done.stdout.strip())[-2000:]
        raise RuntimeError(f"{Path(command[0]).name} {command[1]} failed:\n{output}")


if __name__ == "__main__":
    raise SystemExit(main())
