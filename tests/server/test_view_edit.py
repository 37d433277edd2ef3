"""`facepipe view --edit` opens the studio of a folder, which `facepipe serve` has too."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest
from browser import built
from command_line import Capsys, failed
from faces import tiny_face
from served import Serve, kept, saved

EDIT = ("view", "--edit")


def test_the_browser_opens_the_studio_of_a_folder(serve: Serve, tmp_path: Path) -> None:
    """What is kept there is kept for `facepipe serve`."""
    built()
    opened, browser = tmp_path / "opened.txt", tmp_path / "browser.py"
    browser.write_text(f"import sys; open({str(opened)!r}, 'w').write(sys.argv[1])\n", encoding="utf-8")
    edit = serve(command=EDIT, environment={"BROWSER": f"{sys.executable} {browser} %s"})
    face = kept(edit.client, saved(tiny_face(), tmp_path / "head.usdc"))
    page = edit.client.get("/")
    assert page.status_code == 200
    assert "studio.js" in page.text
    until = time.monotonic() + 60
    while not (opened.exists() and opened.read_text()):
        assert time.monotonic() < until
        time.sleep(0.1)
    assert opened.read_text() == edit.url
    assert edit.stop() == 0
    again = serve()
    assert [one["id"] for one in again.client.get("/api/v1/faces").json()["faces"]] == [face]


@pytest.mark.parametrize("words", [(), ("head.usdc", "--edit", "faces")])
def test_a_face_or_a_folder(words: tuple[str, ...], tmp_path: Path, capsys: Capsys) -> None:
    assert "expected a face or --edit FOLDER" in failed(capsys, "view", *words, folder=tmp_path)
