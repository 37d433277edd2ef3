"""Fitted bones where they are used: a USD viewer, the GLB, the ONNX deformer; figures recomputed from there."""

from __future__ import annotations

import contextlib
import functools
import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gltf_reader
import numpy as np
import pytest
from agreement import limited
from bone_faces import saved, small
from command_line import exit_code
from hypothesis import given, settings
from hypothesis import strategies as st
from import_data import shared
from oracle import difference, played, random_coefficients
from small_head import make

import facepipe
from facepipe.importers import load
from facepipe.parts import FaceParts, all_regions
from facepipe.rig import CHANNELS, build, coefficient_matrices, rest_coefficients
from facepipe.stage import Face
from facepipe.verbs.fit_bones import read_targets
from facepipe.verbs.fit_bones.target_fits import with_half_scales

TOLERANCE = 1e-5  # head heights
THRESHOLD = 0.1  # mm


SHAPES = ("jawOpen", "mouthSmileLeft")


@functools.cache
def sample() -> FaceParts:
    return limited(make(0), 8)


def makehuman() -> FaceParts:
    return limited(load("makehuman", shared("makehuman/makehuman_head.npz"), None).parts, 8)


def nose(folder: Path) -> Path:
    """A target that MakeHuman's bones can't reach."""
    assert exit_code("import", "makehuman", shared("makehuman/makehuman_head.npz"), folder / "nose.usdc", *HUMP) == 0
    return folder / "nose.usdc"


HUMP = ("--targets", "nose/nose-hump-incr=0.8")


class Fitted:
    """A fit by the command line, as files."""

    def __init__(self, folder: Path, rig: Path, words: list[str], *more: object) -> None:
        self.out, self.residual = folder / "fitted.usda", "--residual" in more
        targets = [part for word in words for part in ("--target", word)]
        with contextlib.redirect_stdout(io.StringIO()) as out:
            self.code = exit_code("fit-bones", rig, *targets, "-o", self.out, "--rounds", 0, "--json", *more)
        self.report: dict[str, Any] = json.loads(out.getvalue())
        self.rig, self.face = facepipe.open(rig), facepipe.open(self.out)
        taken = {animation.name for animation in self.rig.animations}
        self.goals = {f"{one.name}_2" if one.name in taken else one.name: one for one in read_targets(self.rig, words)}

    def off(self, points: np.ndarray, name: str) -> np.ndarray:
        """(T, n) distances in millimetres."""
        return np.asarray(np.linalg.norm(points - self.goals[name].points, axis=-1) * self.rig.mm_per_unit)

    def coefficients(self, name: str) -> np.ndarray:
        """(T, m, 9) as the prim has them: float32."""
        prim = next(one for one in self.face.stage.Traverse() if str(one.GetName()) == name and "Anim" in str(one))
        attribute = prim.GetAttribute("facepipe:boneCoefficients")
        times: list[Any] = attribute.GetTimeSamples()
        values = [attribute.Get(time) for time in times] or [attribute.Get()]
        return np.array(values, dtype=np.float32).reshape(len(values), -1, 9)


def check_distances(stated: Mapping[str, float], values: np.ndarray, tolerance: float) -> None:
    """The figures of a report against distances (T, n), sorted and summed here."""
    flat = sorted(values.ravel().tolist())
    assert stated["points"] == values.shape[-1]
    assert stated["mean_mm"] == pytest.approx(sum(flat) / len(flat), abs=tolerance)
    assert stated["rms_mm"] == pytest.approx((sum(one * one for one in flat) / len(flat)) ** 0.5, abs=tolerance)
    place = 0.95 * (len(flat) - 1)
    low, share = flat[int(place)], place - int(place)
    assert stated["p95_mm"] == pytest.approx(low + share * (flat[min(int(place) + 1, len(flat) - 1)] - low), abs=1e-3)
    assert stated["max_mm"] == pytest.approx(flat[-1], abs=tolerance)


def fitted_sample(folder: Path, *more: str) -> Fitted:
    """Two shapes and a clip."""
    return Fitted(folder, saved(sample(), folder / "rig.usdc"), [*SHAPES, sample().animations[0].name], *more)


@pytest.fixture(scope="module")
def with_residual(tmp_path_factory: pytest.TempPathFactory) -> Fitted:
    return fitted_sample(tmp_path_factory.mktemp("residual"), "--residual")


@pytest.fixture(scope="module")
def bones_alone(tmp_path_factory: pytest.TempPathFactory) -> Fitted:
    return fitted_sample(tmp_path_factory.mktemp("bones"))


def test_bones_and_residual_meet_the_threshold_in_usdskel(with_residual: Fitted) -> None:
    """The file as it is, posed by UsdSkel alone, whose scales are half precision."""
    check_threshold(with_residual, SHAPES)


@pytest.mark.slow
def test_makehumans_bones_and_residual_meet_the_threshold_in_usdskel(tmp_path: Path) -> None:
    rig = saved(makehuman(), tmp_path / "rig.usdc")
    fit = Fitted(tmp_path, rig, [str(nose(tmp_path))], "--residual")
    check_threshold(fit, fit.report["targets"])


def check_threshold(fit: Fitted, names: Iterable[str]) -> None:
    assert fit.code == 0
    for name in names:
        one = fit.report["targets"][name]
        assert one["distances"]["max_mm"] > 1.0
        shown = fit.off(played(fit.out, animation=name), name)
        assert shown.max() <= THRESHOLD
        check_distances(one["residual"]["distances"], shown, 1e-3)


def test_the_report_is_what_usdskel_shows_of_the_bones(with_residual: Fitted, tmp_path: Path) -> None:
    """Distances of each target and region, with the residual's weight taken off the file."""
    fit = with_residual
    bare = replace(
        fit.face.parts(),
        animations=tuple(replace(animation, shapes=(), shape_weights=None) for animation in fit.face.animations),
    )
    saved(bare, tmp_path / "bare.usdc")
    masks = all_regions(fit.rig.meshes)
    largest = np.stack(list(masks.values())).argmax(axis=0)
    for name in SHAPES:
        one = fit.report["targets"][name]
        shown = fit.off(played(tmp_path / "bare.usdc", animation=name), name)
        check_distances(one["distances"], shown, 1e-3)
        for number, region in enumerate(masks):
            if region in one["regions"]:
                check_distances(one["regions"][region], shown[:, largest == number], 1e-3)
        assert set(one["regions"]) == {region for number, region in enumerate(masks) if (largest == number).any()}


def test_raw_coefficients_of_the_file_are_within_the_limits_exactly(tmp_path: Path) -> None:
    """float32 on the prim against float32 on the prim, with limits that bite and residuals that round scales."""
    limits = tmp_path / "limits.json"
    limits.write_text(
        '{"joints": {"*": {"t": [-0.7, 1.3], "r": [-0.013, 0.017], "s": [0.993, 1.0071]}}, "units": "mm"}'
    )
    rig = saved(replace(sample(), bone_limits=None), tmp_path / "rig.usdc")
    fit = Fitted(tmp_path, rig, [*SHAPES], "--residual", "--limits", limits)
    low = np.repeat([-0.7 / fit.rig.mm_per_unit, -0.013, 0.993], 3)
    high = np.repeat([1.3 / fit.rig.mm_per_unit, 0.017, 1.007], 3)
    for name, one in fit.report["targets"].items():
        values = fit.coefficients(name).astype(np.float64)
        assert ((low <= values) & (values <= high)).all()
        assert len(one["at_limits"]) > 10
        assert fit.off(played(fit.out, animation=name), name).max() <= THRESHOLD


@settings(max_examples=50)
@given(st.integers(0, 1000), st.floats(1e-5, 0.3), st.floats(1e-5, 0.3))
def test_half_scales_are_near_within_limits_and_what_skelanimation_holds(seed: int, below: float, above: float) -> None:
    rig, rng = build(small()), np.random.default_rng(seed)
    turned = random_coefficients(rng, 3, 0.5)
    turned[:, 6:] = turned[:, 6:7]  # even: else rotations shear
    rig = replace(rig, rest=rig.rest @ coefficient_matrices(turned))
    lower = rest_coefficients(3) - below * rng.uniform(0, 1, (3, 9))
    upper = rest_coefficients(3) + above * rng.uniform(0, 1, (3, 9))
    wanted = rng.uniform(lower, upper).astype(np.float32).astype(np.float64)
    wanted = np.clip(wanted, lower, upper)
    found = with_half_scales(rig, wanted, lower, upper)
    assert np.array_equal(found[:, :6], wanted[:, :6])
    assert ((lower <= found) & (found <= upper)).all()
    sizes = np.linalg.norm(rig.local_transforms(found)[:, :3, :3], axis=1)
    before = np.linalg.norm(rig.local_transforms(wanted)[:, :3, :3], axis=1)
    changed = found[:, 6:] != wanted[:, 6:]
    np.testing.assert_allclose(sizes[changed], sizes[changed].astype(np.float16), rtol=2e-7)
    assert (np.abs(sizes - before) <= 2.0**-10 * before * (1 + 1e-6)).all()
    roomy = (upper - lower)[:, 6:] > 2.0**-8  # two halves fit in
    apart = np.abs(sizes - sizes.astype(np.float16).astype(float))
    assert (apart[roomy] <= 2e-7 * sizes[roomy]).all()


def glb_points(glb: gltf_reader.Gltf, face: Face, name: str, time: float) -> np.ndarray:
    found = glb.pose(name, time)
    return np.concatenate([found[mesh.name] for mesh in face.meshes]) / face.meters_per_unit


@pytest.fixture(params=[pytest.param("bones_alone", marks=pytest.mark.slow), "with_residual"])
def fit(request: pytest.FixtureRequest) -> Fitted:
    found: Fitted = request.getfixturevalue(request.param)
    return found


def test_the_glb_plays_what_was_fitted(fit: Fitted, tmp_path: Path) -> None:
    """Poses and a clip, read back by a decoder of its own."""
    assert exit_code("export", fit.out, "-o", tmp_path / "x.glb", "--animations", "--influences", 8) == 0
    glb = gltf_reader.read(tmp_path / "x.glb")
    for name in fit.report["targets"]:
        own = next(animation for animation in fit.face.animations if animation.name == name)
        times = [0.0] if own.times is None else [float(time) for time in own.times]
        for frame in sorted({0, len(times) // 2, len(times) - 1}):
            weights = {} if own.shape_weights is None else dict(zip(own.shapes, own.shape_weights[frame], strict=True))
            expected = fit.face.evaluate(weights, coefficients=fit.coefficients(name)[frame])
            points = glb_points(glb, fit.face, name, times[frame])
            used = np.isfinite(points[:, 0])
            assert used.mean() > 0.9
            assert difference(fit.face, points[used], expected[used]) < TOLERANCE
            if fit.residual:
                assert fit.off(points[None], name)[frame if len(times) > 1 else 0][used].max() <= THRESHOLD


def test_the_deformer_takes_the_same_coefficients(fit: Fitted, tmp_path: Path) -> None:
    """`facepipe eval` of the exported fit, coefficients word by word."""
    assert exit_code("export", fit.out, "-o", tmp_path / "x.onnx") == 0
    values = fit.coefficients("jawOpen")[0]
    words: list[object] = ["--set", "jawOpen_residual=1"] if fit.residual else []
    for joint, row in zip(fit.face.skeleton.joints, values, strict=True):
        for channel, value in zip(CHANNELS, row, strict=True):
            words += ["--bone", f"{joint}:{channel}={float(value)!r}"]
    assert exit_code("eval", tmp_path / "x.onnx", *words, "-o", tmp_path / "points.npz") == 0
    points = np.load(tmp_path / "points.npz")["points"].reshape(-1, 3)
    weights = {"jawOpen_residual": 1.0} if fit.residual else {}
    assert difference(fit.face, points, fit.face.evaluate(weights, coefficients=values)) < TOLERANCE
    assert difference(fit.face, points, fit.face.evaluate()) > 0.01
    if fit.residual:
        assert fit.off(points, "jawOpen").max() <= THRESHOLD
