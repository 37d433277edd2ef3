"""One person's neutral with the shapes of another: `motion_of`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blend_faces import EYES, changed, head, livelier, only_shapes, rolling_eyes, same, with_shapes, without_shapes
from command_line import Capsys, done, failed
from faces import replace_mesh

from facepipe.core.errors import InputError
from facepipe.geometry.balls import fit_ball
from facepipe.parts import FaceParts, Inbetween, Mesh
from facepipe.stage import Face
from facepipe.verbs.blend import Blend, BlendOptions, BlendSession, Weights

WEIGHTS = Weights(regions={"mouth": (0.8, 0.2)}, default=(0.3, 0.7))
SHAPES = ("jawOpen", "eyeBlinkLeft")


def few(number: int, *shapes: str) -> FaceParts:
    return only_shapes(head("sample", number), *(shapes or SHAPES))


def session(*parts: FaceParts, **options: object) -> BlendSession:
    return BlendSession([Face.from_parts(one) for one in parts], BlendOptions(**options))  # type: ignore[arg-type]


def moved(blend: BlendSession, weights: Weights = WEIGHTS) -> dict[str, np.ndarray]:
    """(n, 3) offsets of every shape and inbetween."""
    solution, found = blend.solve(weights), {}
    for sculpt, offsets in zip(solution.sculpts, solution.offsets, strict=True):
        found[sculpt.name] = np.zeros(solution.neutral.points.shape)
        found[sculpt.name][sculpt.points] = offsets
    return found


@pytest.mark.parametrize("number", [1, 2])
def test_shapes_are_those_of_one_source_and_the_neutral_is_the_blend(number: int) -> None:
    faces = few(0), livelier(few(1), 1.5, 20.0)
    usual, one = (
        session(*faces, align="none", contacts=False),
        session(*faces, align="none", contacts=False, motion_of=number),
    )
    np.testing.assert_array_equal(one.neutral(WEIGHTS).points, usual.neutral(WEIGHTS).points)
    found = moved(one)
    for sculpt in usual.sculpts:
        own = np.zeros(found[sculpt.name].shape)
        own[sculpt.points] = sculpt.offsets[number - 1]
        own[np.linalg.norm(own, axis=1) * one.sources.mm_per_unit <= 0.001] = 0.0  # static in that source
        free = np.setdiff1d(np.arange(len(own)), one.kept.points)
        same(found[sculpt.name][free], own[free], 1e-6)
        assert not found[sculpt.name][~own.any(axis=1)].any()


def test_eyes_roll_as_the_one_persons_do_and_stay_balls() -> None:
    """Where the other's are smaller, so that the offsets of the one would squash them."""

    def smaller(mesh: Mesh) -> Mesh:
        if mesh.name not in EYES["sample"]:
            return mesh
        centre = fit_ball(mesh.points).centre
        return replace_mesh(with_shapes(mesh, lambda one: 0.6 * one), points=centre + 0.6 * (mesh.points - centre))

    first, second = (rolling_eyes(only_shapes(head("sample", number))) for number in range(2))
    blend = session(changed(first, smaller), second, motion_of=2)
    weights = Weights(default=(0.9, 0.1))
    solution, turning = blend.solve(weights), 0
    for number in np.unique(blend.kept.part):
        points = blend.kept.points[blend.kept.part == number]
        rest = solution.neutral.points[points]
        if fit_ball(rest).rms < 0.01 * fit_ball(rest).radius:
            balls = [fit_ball(rest + one[points]) for one in moved(blend, weights).values() if one[points].any()]
            turning += len(balls)
            assert all(ball.rms < 0.01 * ball.radius for ball in balls)
    assert turning == 4, "two looks of two eyes"


def test_inbetweens_are_that_persons_too() -> None:
    def between(parts: FaceParts, weight: float) -> FaceParts:
        def change(mesh: Mesh) -> Mesh:
            shapes = [
                replace_mesh(shape, inbetweens=(Inbetween(name="half", weight=weight, offsets=0.7 * shape.offsets),))
                for shape in mesh.blendshapes
            ]
            return replace_mesh(mesh, blendshapes=tuple(shapes))

        return changed(parts, change)

    faces = between(few(0, "jawOpen"), 0.4), between(few(1, "jawOpen"), 0.6)
    assert set(moved(session(*faces))) == {"jawOpen", "jawOpen@0.4", "jawOpen@0.6"}
    found = moved(session(*faces, motion_of=2))
    assert set(found) == {"jawOpen", "jawOpen@0.6"}
    free = np.linalg.norm(found["jawOpen"], axis=1) > 0.1
    np.testing.assert_allclose(found["jawOpen@0.6"][free], 0.7 * found["jawOpen"][free], rtol=0.05, atol=0.01)


def test_shapes_that_the_one_lacks_follow_missing_and_those_of_others_alone_go() -> None:
    first, second = few(0), without_shapes(few(1), "jawOpen")
    third = few(1, *SHAPES, "mouthSmileLeft")
    with pytest.raises(InputError, match="no shape 'jawOpen', which other sources have; expected it"):
        session(first, second, third, motion_of=2)
    weights = Weights(default=(0.5, 0.3, 0.2))
    skipped = session(first, second, third, motion_of=2, missing="skip")
    assert skipped.skipped == ("jawOpen", "mouthSmileLeft")
    carried = session(first, second, third, motion_of=2, missing="transfer")
    assert (carried.skipped, [shape for shape, _ in carried.transferred]) == (("mouthSmileLeft",), ["jawOpen"])
    lost = moved(session(first, few(1), third, motion_of=2, missing="skip"), weights)["jawOpen"]
    assert np.linalg.norm(moved(carried, weights)["jawOpen"] - lost) < 0.2 * np.linalg.norm(lost)
    third_alone = session(first, second, third, motion_of=3)
    assert third_alone.skipped == ()
    assert not third_alone.transferred, "what others lack does not matter"
    assert {"jawOpen", "eyeBlinkLeft", "mouthSmileLeft"} == {sculpt.shape for sculpt in third_alone.sculpts}


def test_the_report_counts_from_the_shapes_of_the_one() -> None:
    faces = few(0), livelier(few(1), 1.5, 20.0)
    blend = session(*faces, align="none", motion_of=2)
    report = Blend(weights=Weights(default=(1.0, 0.0)))(Face.from_parts(faces[0]), blend)
    own = session(faces[1], motion_of=1)
    for sculpt in own.sculpts:
        largest = 10.0 * np.linalg.norm(sculpt.offsets[0], axis=1).max()
        assert report.shapes[sculpt.name].largest_offset_mm == pytest.approx(largest, rel=0.05)
        assert report.shapes[sculpt.name].border_step_mm < 0.1


def test_the_option_on_the_command_line_and_in_recipes(folder: Path, capsys: Capsys) -> None:
    done(capsys, "blend", "a.usda", "b.usda", "-o", "plain.usda")
    assert "motion_of" not in Path("plain.usda").read_text(), "recipes are as before there was the option"
    done(capsys, "blend", "a.usda", "b.usda", "-o", "c.usda", "--motion-of", "2")
    assert "motion_of" in Path("c.usda").read_text()
    done(capsys, "blend", "--edit", "plain.usda", "--motion-of", "2", "-o", "d.usda")
    assert Path("d.usda").read_bytes() == Path("c.usda").read_bytes()
    done(capsys, "blend", "--edit", "c.usda", "-o", "e.usda")
    assert Path("e.usda").read_bytes() == Path("c.usda").read_bytes()
    for number in ("0", "-1"):
        error = failed(capsys, "blend", "a.usda", "b.usda", "-o", "f.usda", "--motion-of", number)
        assert "option motion_of: is" in error
    error = failed(capsys, "blend", "a.usda", "b.usda", "-o", "f.usda", "--motion-of", "3")
    assert "option motion_of: source 3, expected the number of one, from 1 to 2" in error
