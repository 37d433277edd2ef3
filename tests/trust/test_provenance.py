"""Binary files are those that docs/provenance.md lists, to the byte, and node packages are held by digests."""

from __future__ import annotations

import hashlib
import json
import os
import re
import tomllib
from pathlib import Path

import pytest
from places import REPOSITORY

PAGE = (REPOSITORY / "docs/provenance.md").read_text(encoding="utf-8")
FILES = re.findall(r"^\| `([^`]+)` \| (\d+) \| `([0-9a-f]{64})` \| (.+) \| (.+) \|$", PAGE, re.MULTILINE)
TEXTS = dict(re.findall(r"^\| ([^|`]+) \| [^|]+ \| `([^`]+)` \|$", PAGE, re.MULTILINE))
PICTURES = "docs/*.png"  # drawn by scripts, and in no wheel
NOT_OURS = {"node_modules", "__pycache__"}  # made by programs, as what begins with a dot
BUILT = "exporters/facepipe_web/dist"  # in no repository
LOCKS = ("exporters/facepipe_web/package-lock.json", "tests/support/js/package-lock.json")


def is_binary(path: Path) -> bool:
    data = path.read_bytes()
    try:
        return "\0" in data.decode("utf-8")
    except UnicodeDecodeError:
        return True


def binaries(room: Path) -> set[str]:
    found = set()
    for top, folders, files in os.walk(room):
        folders[:] = [name for name in folders if name not in NOT_OURS and not name.startswith(".")]
        found |= {(Path(top) / name).relative_to(REPOSITORY).as_posix() for name in files if is_binary(Path(top, name))}
    return found


@pytest.mark.parametrize(
    "room", ["facepipe", "exporters", "schemas", "samples", "training", "benchmarks", "docs", "tests"]
)
def test_every_binary_file_is_listed(room: str) -> None:
    found = {name for name in binaries(REPOSITORY / room) if not Path(name).match(PICTURES)}
    listed = {name for name, *_ in FILES if name.startswith(f"{room}/")}
    assert found - listed == set()
    assert {name for name in listed - found if not name.startswith(BUILT)} == set()


@pytest.mark.parametrize(("name", "size", "digest"), [row[:3] for row in FILES], ids=[row[0] for row in FILES])
def test_it_is_the_file_that_is_listed(name: str, size: str, digest: str) -> None:
    path = REPOSITORY / name
    if name.startswith(BUILT) and not path.exists():
        pytest.skip("the viewer is not built")
    data = path.read_bytes()
    assert (len(data), hashlib.sha256(data).hexdigest()) == (int(size), digest)


def test_every_file_has_a_source_and_a_licence_whose_text_ships() -> None:
    for name, _, _, source, licences in FILES:
        scripts = re.findall(r"`([^`]+)`", source)
        assert scripts or re.search(r" \d+\.\d+\.\d+ on npm$", source), name
        assert [one for one in scripts if not (REPOSITORY / one).is_file()] == []
        assert {*licences.split(", ")} <= {*TEXTS}, name
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    shipped = {file for pattern in project["license-files"] for file in REPOSITORY.glob(pattern)}
    assert {REPOSITORY / text for text in TEXTS.values()} <= shipped


@pytest.mark.parametrize("name", LOCKS)
def test_node_packages_are_held_by_digests(name: str) -> None:
    lock = json.loads((REPOSITORY / name).read_text(encoding="utf-8"))
    asked = json.loads((REPOSITORY / name).with_name("package.json").read_text(encoding="utf-8"))
    packages = {path: one for path, one in lock["packages"].items() if path}
    for path, package in packages.items():
        assert re.fullmatch(r"sha512-[A-Za-z0-9+/]{86}==", package.get("integrity", "")), path
        assert not package.get("link"), path
        assert package.get("resolved", "https://registry.npmjs.org/").startswith("https://registry.npmjs.org/"), path
    for package, version in (asked.get("dependencies", {}) | asked.get("devDependencies", {})).items():
        assert packages[f"node_modules/{package}"]["version"] == version, "a version, never a range"


def test_versions_of_npm_are_those_of_the_lock_files() -> None:
    packages = [json.loads((REPOSITORY / name).read_text(encoding="utf-8"))["packages"] for name in LOCKS]
    for _, _, _, source, _ in FILES:
        for package, version in re.findall(r"(\S+) (\d+\.\d+\.\d+) on npm$", source):
            key = f"node_modules/{package}"
            assert version in {lock[key]["version"] for lock in packages if key in lock}
