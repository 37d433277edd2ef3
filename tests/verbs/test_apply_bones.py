"""Faces rebuilt from payloads: what a USD viewer shows, and coefficients beyond the limits of the face."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import done, exit_code, failed, run
from faces import tiny_face
from oracle import difference, played
from small_head import make

import facepipe
from facepipe.core.errors import InputError
from facepipe.parts import BoneLimits, FaceParts
from facepipe.payload import PayloadContent, Precision, encode
from facepipe.rig import rest_coefficients
from facepipe.stage import Face, save_parts
from facepipe.stage.face import play
from facepipe.verbs.apply_bones import apply_bones

Capsys = pytest.CaptureFixture[str]
TOLERANCE = 1e-5  # head heights


def moved(face: Face, frames: int | None = None, precision: Precision = "float32") -> PayloadContent:
    """Joints moved at random; scales that SkelAnimation holds."""
    rng = np.random.default_rng(7)
    count = len(face.skeleton.joints)
    values = np.tile(rest_coefficients(count), (frames or 1, 1, 1))
    reach = [0.02 * face.head_height] * 3 + [0.2] * 3 + [0.2] * 3
    values += rng.uniform(-1, 1, values.shape) * reach
    values[..., 6:] = values[..., 6:].astype(np.float16)
    values = values.astype(np.float32).astype(np.float64)
    return PayloadContent(
        joints=face.skeleton.joints,
        coefficients=values if frames else values[0],
        times=np.arange(frames) / 24 if frames else None,
        meters_per_unit=face.meters_per_unit,
        precision=precision,
    )


def sent(content: PayloadContent, path: Path) -> Path:
    path.write_bytes(encode(content).data)
    return path


@pytest.mark.parametrize("more", [(), ("--flatten",)], ids=["layer", "standalone"])
@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
@pytest.mark.parametrize("frames", [None, 3])
def test_a_viewer_shows_the_rebuilt_face(
    frames: int | None, suffix: str, more: tuple[str, ...], tmp_path: Path
) -> None:
    """UsdSkel alone, on the file as it is written, poses the face as facepipe evaluates the coefficients."""
    save_parts(replace(make(0), bone_limits=None), tmp_path / "face.usdc")
    face = facepipe.open(tmp_path / "face.usdc")
    content = moved(face, frames)
    out = tmp_path / f"out{suffix}"
    assert exit_code("apply-bones", tmp_path / "face.usdc", sent(content, tmp_path / "p.fpb"), "-o", out, *more) == 0
    times = [None] if content.times is None else list(content.times)
    for pose, points in zip(content.frames, played(out, times), strict=True):
        expected = face.evaluate(coefficients=pose)
        assert difference(face, expected, face.evaluate()) > 0.01
        assert difference(face, points, expected) < TOLERANCE


def test_of_several_poses_the_first_is_shown_and_of_two_payloads_the_last(tmp_path: Path) -> None:
    save_parts(tiny_face(), tmp_path / "face.usda")
    face = facepipe.open(tmp_path / "face.usda")
    several = replace(moved(face, 2), times=None)
    payload = sent(several, tmp_path / "a.fpb")
    assert exit_code("apply-bones", tmp_path / "face.usda", payload, "-o", tmp_path / "a.usda") == 0
    assert difference(face, played(tmp_path / "a.usda")[0], face.evaluate(coefficients=several.frames[0])) < TOLERANCE
    single = replace(several, coefficients=several.frames[1])
    payload = sent(single, tmp_path / "b.fpb")
    assert exit_code("apply-bones", tmp_path / "a.usda", payload, "-o", tmp_path / "b.usda") == 0
    assert difference(face, played(tmp_path / "b.usda")[0], face.evaluate(coefficients=several.frames[1])) < TOLERANCE
    assert np.array_equal(facepipe.open(tmp_path / "b.usda").evaluate(), face.evaluate())
    with pytest.raises(InputError, match="no animation 'c'"):
        play(facepipe.open(tmp_path / "b.usda"), "c")


@pytest.mark.parametrize("rate", [24.0, 30.0, 29.97])
def test_clips_keep_their_frames_through_float32_seconds(rate: float, tmp_path: Path) -> None:
    """Frames stay on whole time codes of the stage; what lies between them stays where it is."""
    save_parts(tiny_face(), tmp_path / "face.usda")
    face = facepipe.open(tmp_path / "face.usda")
    face.stage.SetTimeCodesPerSecond(rate)
    codes = np.array([0.0, 1.0, 7.0, 7.5, 2000.0, 86399.0])
    content = replace(moved(face, len(codes)), times=codes / rate)
    face.stage.GetRootLayer().Save()
    payload = sent(content, tmp_path / "p.fpb")
    assert exit_code("apply-bones", tmp_path / "face.usda", payload, "-o", tmp_path / "out.usda") == 0
    stage = facepipe.open(tmp_path / "out.usda").stage
    prim = stage.GetPrimAtPath("/Tiny/Animations/p")
    found = np.array(prim.GetAttribute("translations").GetTimeSamples())
    np.testing.assert_allclose(found[[0, 1, 2, 4, 5]], codes[[0, 1, 2, 4, 5]], rtol=1e-15)
    np.testing.assert_allclose(found[3], codes[3], rtol=1e-7)


def test_points_that_float32_can_not_hold_are_refused(tmp_path: Path, capsys: Capsys) -> None:
    save_parts(tiny_face(), tmp_path / "face.usda")
    values = moved(facepipe.open(tmp_path / "face.usda"), 2)
    values.coefficients[1, :, 6:] = 1e25
    payload = sent(values, tmp_path / "p.fpb")
    err = failed(capsys, "apply-bones", tmp_path / "face.usda", payload, "-o", tmp_path / "out.npz", folder=tmp_path)
    assert "</Tiny> -> frame 1: points too large for float32, expected smaller coefficients" in err


# --- limits


def limited(reach: float) -> FaceParts:
    """The small face with limits that end in numbers that no binary fraction is."""
    parts = tiny_face()
    rest = rest_coefficients(len(parts.skeleton.joints))
    limits = BoneLimits(lower=(rest - reach).astype(np.float32), upper=(rest + reach).astype(np.float32))
    return replace(parts, bone_limits=limits)


def at_limits(parts: FaceParts, precision: Precision, further: float = 0.0) -> PayloadContent:
    """Every channel of every joint at a limit, and one `further`."""
    assert parts.bone_limits is not None
    values = np.where(np.indices((3, 9)).sum(axis=0) % 2, parts.bone_limits.lower, parts.bone_limits.upper)
    values = values.astype(np.float64)
    values[1, 3] += further  # root/jaw:rx, at its upper limit
    return PayloadContent(
        joints=parts.skeleton.joints, coefficients=values, meters_per_unit=parts.meters_per_unit, precision=precision
    )


@pytest.mark.parametrize("precision", ["float16", "float32"])
@pytest.mark.parametrize("reach", [0.1, 0.3, 0.7])
def test_coefficients_at_a_limit_are_within_it_whatever_the_rounding(
    precision: Precision, reach: float, tmp_path: Path, capsys: Capsys
) -> None:
    parts = limited(reach)
    save_parts(parts, tmp_path / "face.usda")
    payload = sent(at_limits(parts, precision), tmp_path / "p.fpb")
    for words in (("-o", tmp_path / "out.usda"), ("-o", tmp_path / "out.npz"), ("--info",)):
        report = json.loads(done(capsys, "apply-bones", tmp_path / "face.usda", payload, *words, "--json"))
        assert report["beyond_limits"] == []


@pytest.mark.parametrize("precision", ["float16", "float32"])
def test_what_is_beyond_a_limit_is_reported_or_brought_back(
    precision: Precision, tmp_path: Path, capsys: Capsys
) -> None:
    parts = limited(0.1)
    assert parts.bone_limits is not None
    save_parts(parts, tmp_path / "face.usda")
    face = facepipe.open(tmp_path / "face.usda")
    content = at_limits(parts, precision, further=0.001)
    payload = sent(content, tmp_path / "p.fpb")
    apply = ("apply-bones", tmp_path / "face.usda", payload)
    code, out, err = run(capsys, *apply, "-o", tmp_path / "out.usda", "--json")
    assert (code, json.loads(out)["beyond_limits"]) == (1, ["root/jaw:rx"])
    assert err == "facepipe: warning: 1 channels beyond the limits of the face: jaw:rx\n"
    code, out, _ = run(capsys, *apply, "--info")
    assert code == 1
    assert out.endswith("1 channels beyond the limits of the face: jaw:rx\n")
    assert exit_code(*apply, "-o", tmp_path / "out.npz", "--json") == 1
    kept = np.load(tmp_path / "out.npz")["points"]
    code, _, err = run(capsys, *apply, "-o", tmp_path / "in.usda", "--clamp")
    assert code == 0
    assert "1 channels brought into the limits" in err
    assert exit_code(*apply, "-o", tmp_path / "in.npz", "--clamp") == 0
    (within,) = facepipe.open(tmp_path / "in.usda").animations
    assert within.coefficients is not None
    assert (within.coefficients >= parts.bone_limits.lower).all()
    assert (within.coefficients <= parts.bone_limits.upper).all()
    brought = np.load(tmp_path / "in.npz")["points"]
    assert difference(face, brought, face.evaluate(coefficients=within.coefficients[0])) < 1e-6
    assert difference(face, brought, kept) > 1e-5
    recipe = facepipe.open(tmp_path / "in.usda").parts().recipe
    assert recipe is not None
    assert recipe.options["clamp"] is True


def test_limits_that_cross_are_named_and_nothing_is_written(tmp_path: Path, capsys: Capsys) -> None:
    parts = limited(0.1)
    assert parts.bone_limits is not None
    upper = np.array(parts.bone_limits.upper)
    upper[2, 8] = 0.5
    save_parts(replace(parts, bone_limits=replace(parts.bone_limits, upper=upper)), tmp_path / "face.usda")
    payload = sent(at_limits(parts, "float32"), tmp_path / "p.fpb")
    for words in (("-o", tmp_path / "out.usda"), ("-o", tmp_path / "out.npz", "--clamp"), ("--info",)):
        err = failed(capsys, "apply-bones", tmp_path / "face.usda", payload, *words, folder=tmp_path)
        assert "bone limits -> root/jaw/lip -> sz: lower limit 0.9 above the upper 0.5" in err


def test_info_and_units_of_another_face(tmp_path: Path, capsys: Capsys) -> None:
    """The same joints in other units: --info says what applying says."""
    save_parts(tiny_face(), tmp_path / "face.usda")
    face = facepipe.open(tmp_path / "face.usda")
    payload = sent(replace(moved(face), meters_per_unit=1.0), tmp_path / "p.fpb")
    code, out, _ = run(capsys, "apply-bones", tmp_path / "face.usda", payload, "--info", "--json")
    assert (code, json.loads(out)["fits"]) == (1, False)
    err = failed(capsys, "apply-bones", tmp_path / "face.usda", payload, "-o", tmp_path / "out.npz", folder=tmp_path)
    assert "units of 1 m, expected 0.01 m" in err
    with pytest.raises(InputError, match="units of 1 m"):
        apply_bones(Face.from_parts(tiny_face()), replace(moved(face), meters_per_unit=1.0), "x")
