"""The sample's sliders: they move the face, within its limits, each in its own way, and left as right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import facepipe
from facepipe.cli import main
from facepipe.heads import make
from facepipe.processors.sliders.author_sliders import sliders_beyond
from facepipe.stage import Face, save_parts


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With head.usdc, the sample."""
    path = tmp_path_factory.mktemp("sample")
    save_parts(make(), path / "head.usdc")
    return path


@pytest.fixture(scope="module")
def face(folder: Path) -> Face:
    return facepipe.open(folder / "head.usdc")


@pytest.fixture(scope="module")
def moves(face: Face) -> dict[str, dict[float, np.ndarray]]:
    """Offsets (n, 3) in mm by slider and value, at both ends of each."""
    rest = face.evaluate()
    return {
        one.name: {
            value: (face.evaluate(sliders={one.name: value}) - rest) * face.mm_per_unit
            for value in (one.minimum, one.maximum)
            if value != one.default
        }
        for one in face.sliders
    }


def test_there_are_sliders_of_every_part_of_the_face(face: Face, moves: dict[str, dict[float, np.ndarray]]) -> None:
    groups = {one.group for one in face.sliders}
    assert len(face.sliders) >= 30
    assert groups >= {"nose", "jaw", "eyes", "brows", "cheeks", "mouth", "ears", "forehead", "expression"}
    for name, ends in moves.items():
        for offsets in ends.values():
            assert np.linalg.norm(offsets, axis=1).max() > 1.0, name


def test_defaults_leave_the_neutral_alone(face: Face) -> None:
    defaults = {one.name: one.default for one in face.sliders}
    np.testing.assert_allclose(face.evaluate(sliders=defaults), face.evaluate(), atol=1e-12)


def test_no_slider_leaves_the_limits(face: Face) -> None:
    assert sliders_beyond(face.sliders, face.skeleton.joints, face.parts().bone_limits) == ()


def test_no_slider_is_a_mix_of_others(face: Face, moves: dict[str, dict[float, np.ndarray]]) -> None:
    """What a fit needs to tell them apart: unit directions of all of them are well apart from dependent."""
    directions = np.array([moves[one.name][one.maximum].ravel() for one in face.sliders])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.linalg.svd(directions, compute_uv=False)[-1] > 0.2


def test_pairs_are_mirror_images(face: Face, moves: dict[str, dict[float, np.ndarray]]) -> None:
    pairs = [one for one in face.sliders if one.mirror is not None and one.name.endswith("Left")]
    assert len(pairs) >= 3
    head = face.split(face.evaluate())["Head"]
    for one in pairs:
        assert one.mirror == one.name.removesuffix("Left") + "Right"
        for value, offsets in moves[one.name].items():
            left, right = face.split(offsets)["Head"], face.split(moves[one.mirror][value])["Head"]
            assert np.linalg.norm(left, axis=1)[head[:, 0] < -1].max() < 0.1 * np.linalg.norm(left, axis=1).max()
            sums = [
                (np.sort(np.linalg.norm(side, axis=1)), (side * (sign, 1, 1)).sum(0))
                for side, sign in ((left, 1), (right, -1))
            ]
            np.testing.assert_allclose(sums[0][0], sums[1][0], atol=1e-3)
            np.testing.assert_allclose(sums[0][1], sums[1][1], atol=0.05)


def test_lids_bend(face: Face, moves: dict[str, dict[float, np.ndarray]]) -> None:
    ends = moves["eyeOpenLeft"]
    assert np.abs(ends[-1.0] + ends[1.0]).max() > 1.0


def test_render_draws_slider_values(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)

    def drawn(*words: str) -> np.ndarray:
        assert main(["render", "head.usdc", "-o", "out.png", "--size", "64", "--force", *words]) == 0
        return np.asarray(Image.open("out.png").convert("RGB"), dtype=int)

    neutral, ears = drawn(), drawn("--slider", "earAngle=-1")
    assert np.abs(ears - neutral).max() > 20
    assert np.abs(drawn("--slider", "earAngle=0", "--set", "jawOpen=1") - drawn("--set", "jawOpen=1")).max() == 0
    for words, message in (
        (("--slider", "earAngle=1", "--pose", "rest"), "--pose: given with --slider"),
        (("--slider", "earAngel=1"), "no slider 'earAngel'"),
    ):
        assert main(["render", "head.usdc", "-o", "x.png", *words]) == 2
        assert message in capsys.readouterr().err
