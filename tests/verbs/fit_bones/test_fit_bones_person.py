"""Where bones miss another person on the head in the box, the report says how near its payload comes."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bone_faces import in_metres_z_up, small
from command_line import Capsys, run

import facepipe
from facepipe.core.arrays import BoolArray
from facepipe.heads import make
from facepipe.parts import FaceParts
from facepipe.payload.person import decode_person
from facepipe.rig import build
from facepipe.stage import Face, save_parts
from facepipe.verbs.fit_bones import FitBones, Target
from facepipe.verbs.fit_bones.person_reach import person_reach
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.whole_faces import whole_points

_FEW = ("--max-iterations", "3", "--rounds", "0")  # steps: how near bones come does not matter


@cache
def drawn(seed: int) -> FaceParts:
    return make(seed)


def target(parts: FaceParts, known: BoolArray | None = None) -> Target:
    return Target(name="goal", points=build(parts).evaluate()[None], person=True, known=known)


@pytest.mark.slow
def test_it_is_what_facepipe_person_writes(tmp_path: Path, capsys: Capsys) -> None:
    for name, seed in (("anna", 1), ("bob", 2)):
        save_parts(drawn(seed), tmp_path / f"{name}.usdc")
    rig, goal = tmp_path / "anna.usdc", tmp_path / "bob.usdc"
    code, said, _ = run(capsys, "fit-bones", rig, "--target", goal, "-o", tmp_path / "fit.usda", *_FEW)
    assert code == 1
    facepipe.person(goal, out=tmp_path / "bob.fpb")
    data = (tmp_path / "bob.fpb").read_bytes()
    off = head_basis().rebuilt(decode_person(data, "bob"), "bob") - whole_points(drawn(2))
    mean = np.linalg.norm(off, axis=1).mean()
    assert f"`facepipe person` {mean:.3f} mm in {len(data)} bytes" in said
    assert mean < 0.1


@pytest.mark.slow
def test_units_and_axes_of_the_stage_do_not_matter() -> None:
    off = np.ones(drawn(1).point_count)
    one, other = (
        person_reach(parts, target(goal), off)
        for parts, goal in ((drawn(1), drawn(2)), (in_metres_z_up(drawn(1)), in_metres_z_up(drawn(2))))
    )
    assert one is not None
    assert other is not None
    assert abs(one.bytes - other.bytes) <= 2
    np.testing.assert_allclose(one.mean_mm, other.mean_mm, rtol=0.01)
    assert one.bones_mean_mm == 1.0


def test_a_face_of_another_topology_has_none() -> None:
    parts = small()
    other = target(parts)
    moved = Target(name="goal", points=other.points + 1.0, person=True)
    face = Face.from_parts(parts)
    (report,) = FitBones(max_iterations=1, rounds=0)(face, [moved]).targets.values()
    assert report.distances.max_mm > 0.1
    assert report.person is None


def test_a_target_without_some_of_the_head_has_none() -> None:
    parts = drawn(1)
    known = np.ones(parts.point_count, bool)
    known[0] = False
    assert person_reach(parts, target(drawn(2), known=known), np.ones(parts.point_count)) is None
