"""Portraits of real people for `likeness.py`, in the public domain.

One is NASA's; the others are test pictures in the source package of face_recognition, which pip fetches.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path

_PACKAGE = "face_recognition"
_VERSION = "1.3.0"
_DIGEST = "5e5efdd1686aa566af0d3cc1313b131e4b197657a8ffd03669e6d3fad92705ec"
_INSIDE = f"{_PACKAGE}-{_VERSION}/tests/test_images"
_PEOPLE = {"obama": "obama", "obama2": "obama", "obama3": "obama", "biden": "biden"}


@dataclass(frozen=True, kw_only=True)
class Portrait:
    """A photo of a person."""

    name: str
    person: str
    path: Path


def portraits(data: Path, cache: Path) -> list[Portrait]:
    """Those of the folder of data, and those of the package, which is fetched into `cache` where it is not there.

    :raises OSError: not there, or not to be had
    """
    astronaut = data / "photos" / "astronaut.png"
    if not astronaut.is_file():
        raise FileNotFoundError(f"{astronaut}: no such file")
    archive = cache / f"{_PACKAGE}-{_VERSION}.tar.gz"
    if not archive.is_file():
        _fetch(cache)
    if hashlib.sha256(archive.read_bytes()).hexdigest() != _DIGEST:
        raise OSError(f"{archive}: not the package of version {_VERSION}")
    found = [Portrait(name="astronaut", person="astronaut", path=astronaut)]
    with tarfile.open(archive) as package:
        for name, person in _PEOPLE.items():
            path = cache / f"{name}.jpg"
            picture = package.extractfile(f"{_INSIDE}/{name}.jpg")
            assert picture is not None
            path.write_bytes(picture.read())
            found.append(Portrait(name=name, person=person, path=path))
    return found


def _fetch(cache: Path) -> None:
    cache.mkdir(parents=True, exist_ok=True)
    wanted = ("--no-deps", "--no-binary", _PACKAGE, "--dest", str(cache), f"{_PACKAGE}=={_VERSION}")
    done = subprocess.run(
        [sys.executable, "-m", "pip", "download", *wanted], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise OSError(f"pip download {_PACKAGE}: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
