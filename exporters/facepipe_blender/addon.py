"""The add-on as a Blender extension: one zip with this package, facepipe's own wheel and those that Blender lacks."""

from __future__ import annotations

import platform
import re
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import NamedTuple

from facepipe.core import __version__
from facepipe.core.errors import InputError
from facepipe.core.reports import ExportReport
from facepipe.declare import option

from .own_wheel import write_own_wheel
from .plain_zip import write_zip


class _Host(NamedTuple):
    """What a range of Blender versions brings."""

    python: str
    numpy: str
    first: str
    beyond: str  # the first version after them


_HOSTS = {
    "5.0": _Host("3.11", "1.26.4", "4.2.0", "5.1.0"),
    "5.2": _Host("3.13", "2.3.5", "5.1.0", "5.3.0"),
}
_BLENDERS_OWN = ("usd-core", "numpy")
_TAGS = {
    "linux-x64": [f"manylinux_2_{minor}_x86_64" for minor in (28, 27, 26, 24, 17)] + ["manylinux2014_x86_64"],
    "macos-arm64": [f"macosx_{major}_0_arm64" for major in (14, 13, 12, 11)],
    "windows-x64": ["win_amd64"],
}
_THIS = {"Darwin": "macos-arm64", "Windows": "windows-x64"}.get(platform.system(), "linux-x64")
_MANIFEST = "blender_manifest.toml"


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to build the extension for, and from what."""

    platform: str = option(_THIS, "the machine that Blender runs on", choices=tuple(_TAGS))
    blender: str = option("5.0", "5.0 for Blender 4.2 to 5.0, 5.2 for 5.1 and 5.2", choices=tuple(_HOSTS))
    wheels: Path | None = option(None, "folder of wheels to take the libraries from, in place of the network")


def build(path: Path, options: Options) -> ExportReport:
    """Write the extension.

    :raises InputError: libraries that can't be had, or a file that can't be written
    """
    source = Path(__file__).parent
    files = {one.name: one.read_bytes() for one in sorted(source.glob("*.py"))}
    with tempfile.TemporaryDirectory() as folder:
        wheels = Path(folder)
        _download(wheels, options)
        write_own_wheel(wheels)
        names = sorted(one.name for one in wheels.glob("*.whl") if not _is_blenders(one.name))
        manifest = _manifest((source / _MANIFEST).read_text(encoding="utf-8"), names, options)
        files = {_MANIFEST: manifest.encode(), **files}
        files |= {f"wheels/{name}": (wheels / name).read_bytes() for name in names}
    write_zip(path, files)
    return ExportReport(path=path, files=(path,), counts={"wheels": len(names)}, bytes=path.stat().st_size)


def _manifest(text: str, wheels: list[str], options: Options) -> str:
    """The manifest with what is known only now."""
    host = _HOSTS[options.blender]
    lines = "".join(f'    "./wheels/{name}",\n' for name in wheels)
    text = re.sub(r'(?m)^version = ".*"$', f'version = "{__version__}"', text, count=1)
    text = re.sub(r'(?m)^blender_version_min = ".*"$', f'blender_version_min = "{host.first}"', text, count=1)
    text = re.sub(r'(?m)^blender_version_max = ".*"$', f'blender_version_max = "{host.beyond}"', text, count=1)
    head, permissions, rest = text.partition("[permissions]")
    result = f'{head}platforms = ["{options.platform}"]\nwheels = [\n{lines}]\n\n{permissions}{rest}'
    tomllib.loads(result)
    return result


def _download(folder: Path, options: Options) -> None:
    """The wheels of facepipe's libraries, by pip.

    :raises InputError: no pip, or wheels that it can't get
    """
    host = _HOSTS[options.blender]
    words = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--dest", str(folder)]
    words += ["--only-binary=:all:", "--implementation", "cp", "--python-version", host.python]
    words += [word for tag in _TAGS[options.platform] for word in ("--platform", tag)]
    if options.wheels is not None:
        words += ["--no-index", "--find-links", str(options.wheels)]
    done = subprocess.run([*words, f"numpy=={host.numpy}", *_libraries()], capture_output=True, text=True)
    if done.returncode:
        told = [line for line in done.stderr.splitlines() if "ERROR" in line or "No module named" in line]
        reason = (told or done.stderr.splitlines() or ["no reason given"])[-1].removeprefix("ERROR: ")
        source = "the network" if options.wheels is None else str(options.wheels)
        raise InputError(
            f"wheels for {options.platform}", f"pip can't get them ({reason}), expected them from {source}"
        )


def _libraries() -> list[str]:
    """What facepipe requires and Blender has not.

    :raises InputError: facepipe runs from files alone, without its list of libraries
    """
    try:
        listed = requires("facepipe") or []
    except PackageNotFoundError:
        raise InputError("facepipe", "is not installed, expected it installed by pip") from None
    return [one for one in listed if "extra ==" not in one and not _is_blenders(one)]


def _is_blenders(name: str) -> bool:
    """Whether a requirement or wheel is of a library that Blender brings."""
    return re.split(r"[^A-Za-z0-9_-]|-\d", name.lower().replace("_", "-"))[0] in _BLENDERS_OWN
