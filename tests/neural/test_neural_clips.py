"""Recorded clips among the frames that a rig is learned from."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from command_line import failed, run
from neural_training import AMOUNTS, FEW, acted, chewing_face
from pxr import Sdf, Usd

from facepipe.core.errors import InputError
from facepipe.neural import FrameBlocksOptions, ReadClips, SampleMotion, SampleMotionOptions
from facepipe.neural.motion import controls_of
from facepipe.stage import save_parts
from facepipe.verbs.whole_faces import whole_face, whole_points

NONE = SampleMotionOptions(spread=0, sweep=0, together=0)


def declared(path: Path, tracks: dict[str, Sequence[float]]) -> Path:
    """A stage with nothing but numbers over time."""
    stage = Usd.Stage.CreateNew(str(path))
    prim = stage.DefinePrim("/Take")
    for name, values in tracks.items():
        own = prim.CreateAttribute(f"facepipe:control:{name}", Sdf.ValueTypeNames.Double)
        for code, value in enumerate(values):
            own.Set(value, float(code))
    stage.Save()
    return path


def test_clips_and_poses_of_the_face_itself_are_evaluated_by_its_rig(tmp_path: Path) -> None:
    """Straight in the shape; each animation apart; what no control explains is named."""
    save_parts(acted(), tmp_path / "head.usda")
    clips = ReadClips(options=FrameBlocksOptions(block=20, margin=3))(
        [tmp_path / "head.usda"], controls_of(chewing_face())
    )
    motion = SampleMotion(options=NONE)(acted(), "head.usda", clips=clips)
    assert motion.source == "rig and clips"
    assert np.bincount(motion.blocks).tolist() == [20, 17, 1]
    kept = np.delete(AMOUNTS, [20, 21, 22])
    assert np.allclose(motion.values, np.stack([np.zeros(38), [*kept, 0.75]], axis=1), atol=1e-6)
    smile = whole_face(chewing_face(), "head").deltas["smile"]
    assert np.allclose(motion.points, whole_points(chewing_face()) + motion.values[:, 1, None, None] * smile, atol=1e-4)
    assert [warning.partition("-> ")[2] for warning in motion.warnings] == [
        "talk: left out 1 names that are no controls of the face: jawOpen"
    ]


def test_clips_come_after_what_is_sampled_in_blocks_of_their_own(tmp_path: Path) -> None:
    path = declared(tmp_path / "take.usda", {"smile": AMOUNTS.tolist()})
    clips = ReadClips()([path, path], controls_of(chewing_face()))
    sample, face = SampleMotion(options=FEW), chewing_face()
    alone, both = sample(face, "head"), sample(face, "head", clips=clips)
    count = len(alone.values)
    assert np.array_equal(both.values[:count], alone.values)
    assert np.array_equal(both.points[:count], alone.points)
    assert np.array_equal(both.blocks[:count], alone.blocks)
    assert len(both.values) == count + 2 * len(AMOUNTS)
    assert both.blocks[count:].tolist() == [alone.blocks.max() + 1] * 40 + [alone.blocks.max() + 2] * 40


def test_controls_rest_where_a_clip_lacks_them_and_are_held_within_limits(tmp_path: Path) -> None:
    path = declared(tmp_path / "take.usda", {"chew": [-2.0, 0.25, 3.0]})
    clips = ReadClips()([path], controls_of(chewing_face()))
    assert clips.values.tolist() == [[-0.5, 0.0], [0.25, 0.0], [1.0, 0.0]]
    assert clips.warnings == ("clips go beyond the limits of chew, and are held there",)


def test_keys_apart_are_straight_between(tmp_path: Path) -> None:
    """What an animator keyed sparsely is what USD makes of it at the times of the others' keys."""
    path = declared(tmp_path / "take.usda", {"chew": [0.0, 0.1, 0.2, 0.3, 0.4], "smile": [0.0]})
    stage = Usd.Stage.Open(str(path))
    stage.GetPrimAtPath("/Take").GetAttribute("facepipe:control:smile").Set(1.0, 4.0)
    stage.Save()
    assert np.allclose(ReadClips()([path], controls_of(chewing_face())).values[:, 1], [0.0, 0.25, 0.5, 0.75, 1.0])


def test_clips_of_something_else_are_reported(tmp_path: Path) -> None:
    path = declared(tmp_path / "take.usda", {"wings": [0.0, 1.0]})
    with pytest.raises(InputError, match=r"take.usda: moves wings, expected some of chew, smile"):
        ReadClips()([path], controls_of(chewing_face()))
    with pytest.raises(InputError, match=r"none.usda: moves nothing, expected some of chew, smile"):
        ReadClips()([declared(tmp_path / "none.usda", {})], controls_of(chewing_face()))
    bad = declared(tmp_path / "bad.usda", {"smile": [0.0, float("nan")]})
    with pytest.raises(InputError, match=r"bad.usda -> /Take.facepipe:control:smile: NaN or infinity at time code 1"):
        ReadClips()([bad], controls_of(chewing_face()))


@pytest.mark.needs_torch
def test_the_command_learns_from_clips_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    head, take = tmp_path / "head.usda", declared(tmp_path / "take.usda", {"chew": (2.0 * AMOUNTS - 1.0).tolist()})
    save_parts(acted(), head)
    words = (
        "neural-rig",
        "train",
        head,
        "-o",
        tmp_path / "a.fpnr",
        "--width",
        4,
        "--steps",
        50,
        "--no-encoder",
        "--force",
    )
    few = ("--spread", 0, "--sweep", 0, "--together", 0, "--block", 10)
    code, out, err = run(capsys, *words, *few, "--clip", head, "--clip", take, "--json")
    assert code == 0, err
    printed = json.loads(out)
    assert printed["source"] == "rig and clips"
    assert printed["frames"] + printed["held_out"] == 2 * (40 - 3 * 2) + 1
    assert printed["between"] == 2 * 3 * 2
    assert err.count("warning") == len(printed["warnings"]) == 2
    for more, message in (
        (("--clip", head, "--source", "samples"), "--clip: given with --source samples"),
        (("--clip", head, "--controls", "/A"), "--clip: given with --controls"),
        (("--clip", tmp_path / "gone.usda"), "gone.usda: no such file"),
    ):
        assert message in failed(capsys, *words, *more, folder=tmp_path)
