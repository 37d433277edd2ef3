"""The add-on as a Blender extension: one zip with this package, facepipe's own wheel and those that Blender lacks."""

from __future__ import annotations

import base64
import hashlib
import importlib
import platform
import re
import tempfile
import tomllib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, entry_points, requires
from pathlib import Path
from typing import NamedTuple

from facepipe import registry
from facepipe.core import __version__
from facepipe.core.atomic import replacing
from facepipe.core.errors import InputError
from facepipe.core.policy import children
from facepipe.core.reports import ExportReport
from facepipe.declare import option

_BLENDERS_OWN = ("usd-core", "numpy")
_TAGS = {
    "linux-x64": [f"manylinux_2_{minor}_x86_64" for minor in (28, 27, 26, 24, 17)] + ["manylinux2014_x86_64"],
    "macos-arm64": [f"macosx_{major}_0_arm64" for major in (14, 13, 12, 11)],
    "windows-x64": ["win_amd64"],
}
_THIS = {"Darwin": "macos-arm64", "Windows": "windows-x64"}.get(platform.system(), "linux-x64")
_MANIFEST = "blender_manifest.toml"
_PACKAGES = ("facepipe", "facepipe_schemas", "facepipe_gltf", "facepipe_onnx")
_WHEEL = "Wheel-Version: 1.0\nGenerator: facepipe\nRoot-Is-Purelib: true\nTag: py3-none-any\n"


class _Host(NamedTuple):
    """What a range of Blender versions ships with."""

    python: str
    numpy: str
    first: str
    beyond: str  # the first version after them


_HOSTS = {
    "5.0": _Host("3.11", "1.26.4", "4.2.0", "5.1.0"),
    "5.2": _Host("3.13", "2.3.5", "5.1.0", "5.3.0"),
}


@dataclass(frozen=True, kw_only=True)
class Options:
    """What to build the extension for, and from what."""

    platform: str = option(_THIS, "the machine that Blender runs on", choices=tuple(_TAGS))
    blender: str = option("5.0", "5.0 for Blender 4.2 to 5.0, 5.2 for 5.1 and 5.2", choices=tuple(_HOSTS))
    wheels: Path | None = option(None, "folder of wheels to take the libraries from, in place of the network")


def build(path: Path, options: Options) -> ExportReport:
    """Write the extension.

    :raises InputError: libraries that can't be had, a file that can't be written, or no source to put into it
    """
    source = Path(__file__).parent
    files = {one.name: one.read_bytes() for one in sorted(source.glob("*.py"))}
    if not files:  # Blender has a Python of its own, which may not run this one's bytecode
        raise InputError("facepipe", "is here as bytecode alone, expected its source, which the add-on is made of")
    with tempfile.TemporaryDirectory() as folder:
        wheels = Path(folder)
        _download(wheels, options)
        write_own_wheel(wheels)
        names = sorted(one.name for one in wheels.glob("*.whl") if not _is_blenders(one.name))
        text = (source / _MANIFEST).read_text(encoding="utf-8")
        # the manifest with what is known only now
        host = _HOSTS[options.blender]
        lines = "".join(f'    "./wheels/{name}",\n' for name in names)
        text = re.sub(r'(?m)^version = ".*"$', f'version = "{__version__}"', text, count=1)
        text = re.sub(r'(?m)^blender_version_min = ".*"$', f'blender_version_min = "{host.first}"', text, count=1)
        text = re.sub(r'(?m)^blender_version_max = ".*"$', f'blender_version_max = "{host.beyond}"', text, count=1)
        head, permissions, rest = text.partition("[permissions]")
        manifest = f'{head}platforms = ["{options.platform}"]\nwheels = [\n{lines}]\n\n{permissions}{rest}'
        tomllib.loads(manifest)
        files = {_MANIFEST: manifest.encode(), **files}
        files |= {f"wheels/{name}": (wheels / name).read_bytes() for name in names}
    _write_zip(path, files)
    return ExportReport(path=path, files=(path,), counts={"wheels": len(names)}, bytes=path.stat().st_size)


def _download(folder: Path, options: Options) -> None:
    """The wheels of facepipe's libraries, by pip.

    :raises InputError: no pip, or wheels that it can't get
    """
    host = _HOSTS[options.blender]
    words = ["download", "--quiet", "--disable-pip-version-check", "--dest", str(folder.absolute())]
    # pip takes wheels for another machine and Python alone: a source would be built for this one
    words += ["--only-binary=:all:", "--implementation", "cp", "--python-version", host.python]
    words += [word for tag in _TAGS[options.platform] for word in ("--platform", tag)]
    if options.wheels is not None:
        words += ["--no-index", "--find-links", str(options.wheels.absolute())]
    done = children.run(children.python("pip", *words, f"numpy=={host.numpy}", *_libraries()), seconds=None)
    if done.returncode:
        lines = done.stderr.decode(errors="replace").splitlines()
        errors = [line for line in lines if "ERROR" in line or "No module named" in line]
        reason = (errors or lines or ["no reason given"])[-1].removeprefix("ERROR: ")
        source = "the network" if options.wheels is None else str(options.wheels)
        raise InputError(
            f"wheels for {options.platform}", f"pip can't get them ({reason}), expected them from {source}"
        )


def _libraries() -> list[str]:
    """The libraries that facepipe requires and Blender lacks.

    :raises InputError: facepipe runs from files alone, without its list of libraries
    """
    try:
        listed = requires("facepipe") or []
    except PackageNotFoundError:
        raise InputError("facepipe", "is not installed, expected it installed by pip") from None
    return [one for one in listed if "extra ==" not in one and not _is_blenders(one)]


def _is_blenders(name: str) -> bool:
    """Whether a requirement or wheel is of a library that ships with Blender."""
    return re.split(r"[^A-Za-z0-9_-]|-\d", name.lower().replace("_", "-"))[0] in _BLENDERS_OWN


def write_own_wheel(folder: Path) -> Path:
    """Write the wheel into a folder; its path.

    :raises InputError: the folder can't be written
    """
    # by hand, of the files that run: an installed facepipe has neither its pyproject.toml nor the tools that build it
    files: dict[str, bytes] = {}
    for package in _PACKAGES:
        root = Path(str(importlib.import_module(package).__file__)).parent
        for file in sorted(one for one in root.rglob("*") if one.is_file() and "__pycache__" not in one.parts):
            files[f"{package}/{file.relative_to(root).as_posix()}"] = file.read_bytes()
    info = f"facepipe-{__version__}.dist-info"
    files[f"{info}/METADATA"] = f"Metadata-Version: 2.1\nName: facepipe\nVersion: {__version__}\n".encode()
    files[f"{info}/WHEEL"] = _WHEEL.encode()
    lines = []
    for group in (registry.EXPORTERS, registry.IMPORTERS):
        found = sorted({(one.name, one.value) for one in entry_points(group=group)})
        own = [f"{name} = {value}" for name, value in found if re.split(r"[.:]", value)[0] in _PACKAGES]
        lines += [f"[{group}]", *own, ""]
    files[f"{info}/entry_points.txt"] = "\n".join(lines).encode()
    rows = []
    for name, data in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).decode().rstrip("=")
        rows.append(f"{name},sha256={digest},{len(data)}")
    files[f"{info}/RECORD"] = "\n".join([*rows, f"{info}/RECORD,,", ""]).encode()
    path = folder / f"facepipe-{__version__}-py3-none-any.whl"
    _write_zip(path, files)
    return path


def _write_zip(path: Path, files: Mapping[str, bytes]) -> None:
    """Write files by name, whole or not at all.

    :raises InputError: the folder can't be written
    """
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.external_attr = 0o644 << 16
            packed = name.endswith(".whl")  # compressed already
            archive.writestr(entry, data, zipfile.ZIP_STORED if packed else zipfile.ZIP_DEFLATED)
