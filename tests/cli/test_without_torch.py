"""What needs torch says so in one line where it is missing, before it works."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_head import make
from without_torch import HINT, without_torch

from facepipe.stage import save_parts


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """face.usdc."""
    folder = tmp_path_factory.mktemp("studio")
    save_parts(make(0), folder / "face.usdc")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        "train-photo face.usdc -o start.onnx",
        "neural-rig train face.usdc -o rig.fpnr",
        "export face.usdc --sliders --distil -o sliders.onnx",
    ],
    ids=lambda words: words.split()[0],
)
def test_it_is_one_line(studio: Path, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(studio)
    assert without_torch(*words.split()) == (2, HINT)
    assert {one.name for one in studio.iterdir()} == {"face.usdc"}
