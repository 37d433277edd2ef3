"""Copies of files at URLs: what a file names comes with it, and nothing from outside the roots."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fbx_files import Scene

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import Trust, trusting
from facepipe.tasks.mirror import Mirror, mirror

fsspec = pytest.importorskip("fsspec")
ROOT = "memory://show/src"
HEAD = "#usda 1.0\n(\n    subLayers = [@../body.usda@, @/etc/hostname.usda@]\n)\n"
BODY = '#usda 1.0\ndef "A" (references = @parts/eye.usda@</Eye>)\n{\n    asset skin = @./skin.<UDIM>.png@\n}\n'
FBX = Scene()
FBX.texture(FBX.material(FBX.model("Head"), "skin"), "DiffuseColor", "tex\\a.png", "C:\\art\\a.png")
FBX.texture(FBX.material(FBX.model("Eye"), "eye"), "DiffuseColor", "..\\..\\..\\elsewhere\\b.png")
FILES: dict[str, str | bytes] = {
    "src/scan/b.fbx": FBX.binary(),
    "src/heads/ada.usda": HEAD,
    "src/body.usda": BODY,
    "src/parts/eye.usda": '#usda 1.0\ndef "Eye"\n{\n    asset iris = @iris.png@\n    asset lost = @lost.png@\n}\n',
    "src/parts/iris.png": "iris",
    "src/skin.1001.png": "left",
    "src/skin.1012.png": "right",
    "src/skin.other.png": "other",
    "src/scan/a.obj": "mtllib my skin.mtl # of the scan\nv 0 0 0\n",
    "src/scan/my skin.mtl": "newmtl a\nmap_Kd -s 1 1 1 tex\\a.png\n",
    "src/scan/tex/a.png": "a",
    "src/out.usda": "#usda 1.0\n(\n    subLayers = [@../elsewhere/secret.usda@]\n)\n",
    "elsewhere/secret.usda": "#usda 1.0\n",
}


@pytest.fixture
def copies(tmp_path: Path) -> Iterator[Mirror]:
    """A mirror of a store in this process's memory."""
    store = fsspec.filesystem("memory")
    for name, text in FILES.items():
        store.pipe_file(f"/show/{name}", text if isinstance(text, bytes) else text.encode())
    with mirror([ROOT], str(tmp_path / "local"), 10**6) as found:
        yield found
    store.rm("/show", recursive=True)


def fetched(copies: Mirror) -> set[str]:
    return {one.relative_to(copies.roots[0]).as_posix() for one in copies.roots[0].rglob("*") if one.is_file()}


@pytest.mark.parametrize(
    ("name", "files"),
    [
        (
            "heads/ada.usda",
            {"heads/ada.usda", "body.usda", "parts/eye.usda", "parts/iris.png", "skin.1001.png", "skin.1012.png"},
        ),
        ("scan/a.obj", {"scan/a.obj", "scan/my skin.mtl", "scan/tex/a.png"}),
        ("scan/b.fbx", {"scan/b.fbx", "scan/tex/a.png"}),
        ("scan", {"scan/b.fbx", "scan/a.obj", "scan/my skin.mtl", "scan/tex/a.png"}),
        ("none.usda", set()),
    ],
)
def test_what_a_file_names_comes_with_it(copies: Mirror, name: str, files: set[str]) -> None:
    (word,) = copies.words([f"{ROOT}/{name}"])
    assert fetched(copies) == files
    assert copies.name(Path(word)) == f"{ROOT}/{name}"
    copies.clear()
    assert fetched(copies) == set()


def test_a_layer_that_leads_out_of_the_roots_is_refused(copies: Mirror) -> None:
    with pytest.raises(InputError, match=r"memory://show/elsewhere/secret.usda: is outside the roots"):
        copies.words([f"{ROOT}/out.usda"])


def test_a_name_after_a_file_and_a_result_are_no_files(copies: Mirror) -> None:
    words = ["fit", f"{ROOT}/parts/eye.usda:smile", "--quality", f"ada={ROOT}/body.usda", "-o", f"{ROOT}/body.usda"]
    local = copies.words(words)
    assert fetched(copies) == {"parts/eye.usda", "parts/iris.png"}
    assert [word.removeprefix("ada=").startswith(str(copies.roots[0])) for word in local] == [False, True] * 3


def test_a_file_that_changes_while_it_is_read_is_read_again(copies: Mirror, monkeypatch: Any) -> None:
    from facepipe.tasks import remote

    get, store = remote.Store.get, fsspec.filesystem("memory")
    left = [b"second"]

    def changed(self: remote.Store, url: str, path: Path) -> None:
        get(self, url, path)
        if left:
            store.pipe_file("/show/src/parts/iris.png", left.pop())

    monkeypatch.setattr(remote.Store, "get", changed)
    (word,) = copies.words([f"{ROOT}/parts/iris.png"])
    assert Path(word).read_bytes() == b"second"
    left += [b"x"] * 10
    store.pipe_file("/show/src/parts/iris.png", b"third")
    copies.clear()
    with pytest.raises(InputError, match="changes while it is read"):
        copies.words([f"{ROOT}/parts/iris.png"])


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_copies_are_kept_through_no_link_out_of_the_roots(copies: Mirror, tmp_path: Path) -> None:
    sent, out = tmp_path / "sent", tmp_path / "out"
    sent.mkdir()
    out.mkdir()
    (sent / "copies").symlink_to(out)
    refused = pytest.raises(InputError, match="copies: is a link")
    with trusting(Trust(roots=(sent,))), refused, mirror([ROOT], str(sent), 10**6) as found:
        found.fetch([found.path(f"{ROOT}/body.usda")])
    assert list(out.iterdir()) == []
