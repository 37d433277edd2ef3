"""Limits of bone coefficients from the rig and from files, and how much points count."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bone_faces import small
from faces import replace_mesh
from hypothesis import given
from hypothesis import strategies as st

from facepipe.core.errors import InputError
from facepipe.parts import BoneLimits, FaceParts
from facepipe.rig import CHANNELS
from facepipe.verbs.fit_bones import LimitRules, read_limits
from facepipe.verbs.fit_bones.target_fits import point_weights

JOINTS = ("root", "root/jaw", "root/jaw/lip", "root/eyeLeft", "root/eyeRight")
LEAST = float(np.nextafter(np.float32(0.01), np.float32(1)))  # the float32 above 0.01
NUMBERS = st.floats(-1e9, 1e9)


def resolved(content: object, tmp_path: Path, base: BoneLimits | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Limits of `JOINTS` on a stage in centimetres."""
    file = tmp_path / "limits.json"
    file.write_text(json.dumps(content))
    return read_limits(file).resolve(JOINTS, 0.01, base)


def at(table: np.ndarray, joint: str, channel: str) -> float:
    return float(table[JOINTS.index(joint), CHANNELS.index(channel)])


def test_later_rules_win_and_single_channels_win_over_their_kind(tmp_path: Path) -> None:
    content = {
        "joints": {
            "*": {"t": [-1, 1], "r": [-0.5, 0.5]},
            "jaw": {"rx": [0, 0.25], "r": [-0.125, 0.125], "tz": [None, 0]},
            "root/eye*": {"*": [0.5, 2]},
        }
    }
    lower, upper = resolved(content, tmp_path)
    assert (at(lower, "root", "ty"), at(upper, "root", "ty")) == (-1, 1)
    assert (at(lower, "root", "sx"), at(upper, "root", "sx")) == (LEAST, np.inf)  # not mirrored
    assert (at(lower, "root/jaw", "rx"), at(upper, "root/jaw", "rx")) == (0, 0.25)
    assert (at(lower, "root/jaw", "ry"), at(upper, "root/jaw", "ry")) == (-0.125, 0.125)
    assert (at(lower, "root/jaw", "tz"), at(upper, "root/jaw", "tz")) == (-np.inf, 0)
    assert (at(lower, "root/jaw/lip", "rx"), at(upper, "root/jaw/lip", "rx")) == (-0.5, 0.5)
    for channel in CHANNELS:
        assert (at(lower, "root/eyeRight", channel), at(upper, "root/eyeRight", channel)) == (0.5, 2)


def test_a_star_stands_for_all_channels_in_their_units_and_narrower_names_win(tmp_path: Path) -> None:
    """Whatever their order in the file: translations are millimetres on a stage in centimetres."""
    ranges = {"*": [-2, 4], "r": [-0.5, 0.5], "tx": [0, 10], "s": [None, 3], "sz": [0.5, 2]}
    for names in (list(ranges), list(ranges)[::-1]):
        content = {"joints": {"jaw": {name: ranges[name] for name in names}}, "units": "mm"}
        lower, upper = resolved(content, tmp_path)
        fifth = float(np.nextafter(np.float32(-0.2), np.float32(0)))  # within -2 mm
        assert [at(lower, "root/jaw", one) for one in CHANNELS] == [
            0,
            fifth,
            fifth,
            -0.5,
            -0.5,
            -0.5,
            LEAST,
            LEAST,
            0.5,
        ]
        assert at(upper, "root/jaw", "tx") == 1
        assert at(upper, "root/jaw", "ty") == pytest.approx(0.4, rel=1e-7)
        assert [at(upper, "root/jaw", one) for one in CHANNELS[3:]] == [0.5, 0.5, 0.5, 3, 3, 2]


def test_locks_keep_channels_at_rest_whatever_the_rules_say(tmp_path: Path) -> None:
    content = {"joints": {"*": {"s": [2, 3], "tx": [1, 2]}}, "lock": ["root:*", "eye*:s", "jaw:tx"]}
    lower, upper = resolved(content, tmp_path)
    np.testing.assert_array_equal(lower[0], [0] * 6 + [1] * 3)
    np.testing.assert_array_equal(upper[0], lower[0])
    assert (at(lower, "root/eyeLeft", "sy"), at(upper, "root/eyeLeft", "sy")) == (1, 1)
    assert (at(lower, "root/eyeLeft", "tx"), at(upper, "root/eyeLeft", "tx")) == (1, 2)
    assert (at(lower, "root/jaw", "tx"), at(upper, "root/jaw", "tx")) == (0, 0)
    assert (at(lower, "root/jaw", "sx"), at(upper, "root/jaw", "sx")) == (2, 3)


def test_units_scale_translations_alone(tmp_path: Path) -> None:
    for unit, factor in (("stage", 1.0), ("mm", 0.1), ("cm", 1.0), ("m", 100.0)):
        lower, upper = resolved({"joints": {"*": {"t": [-5, 10], "r": [-5, 10]}}, "units": unit}, tmp_path)
        np.testing.assert_allclose([at(lower, "root", "tx"), at(upper, "root", "tx")], [-5 * factor, 10 * factor])
        assert (at(lower, "root", "rx"), at(upper, "root", "rx")) == (-5, 10)


def test_rules_stand_over_the_limits_of_the_rig(tmp_path: Path) -> None:
    base = BoneLimits(lower=np.full((5, 9), -0.25), upper=np.full((5, 9), 2.0))
    lower, upper = resolved({"joints": {"jaw": {"rx": [None, None], "tx": [-1, 1]}}}, tmp_path, base)
    expected = np.full((5, 9), -0.25)
    expected[1, [0, 3]] = -1, -np.inf
    np.testing.assert_array_equal(lower, expected)
    assert (at(upper, "root/jaw", "tx"), at(upper, "root/jaw", "rx"), at(upper, "root", "tx")) == (1, np.inf, 2)
    np.testing.assert_array_equal(base.upper, np.full((5, 9), 2.0))
    crossed = base.lower.copy()
    crossed[2, 4] = 3
    with pytest.raises(InputError, match="bone limits -> root/jaw/lip -> ry: lower limit 3 above the upper 2"):
        LimitRules().resolve(JOINTS, 0.01, replace(base, lower=crossed))


@given(st.tuples(NUMBERS, NUMBERS).map(sorted), st.sampled_from(["stage", "mm", "m"]))
def test_limits_are_float32_and_never_wider_than_asked_for(pair: list[float], units: str) -> None:
    rules = LimitRules(joints=(("*", {"r": (pair[0], pair[1])}),), units=units)
    lower, upper = rules.resolve(JOINTS, 0.01)
    low, high = at(lower, "root", "rx"), at(upper, "root", "rx")
    assert (low, high) == (float(np.float32(low)), float(np.float32(high)))
    assert low <= high
    if np.float32(pair[1]) > np.nextafter(np.float32(pair[0]), np.float32(np.inf)):
        assert pair[0] <= low
        assert high <= pair[1]


def test_scales_are_mirrored_only_where_a_limit_says_so() -> None:
    rules = LimitRules(joints=(("jaw", {"s": (None, 2)}), ("lip", {"s": (-1, None)}), ("eyeLeft", {"s": (None, -2)})))
    lower, upper = rules.resolve(JOINTS, 0.01)
    assert [at(lower, joint, "sy") for joint in JOINTS] == [LEAST, LEAST, -1, -2, LEAST]
    assert [at(upper, joint, "sy") for joint in JOINTS] == [np.inf, 2, np.inf, -2, np.inf]


def test_rules_as_json_are_the_rules_in_their_order() -> None:
    rules = LimitRules(joints=(("z*", {"tx": (0, 1), "r": (None, 2)}), ("a*", {})), lock=("b:s",), units="mm")
    assert rules.to_json() == {
        "joints": [["z*", {"r": [None, 2], "tx": [0, 1]}], ["a*", {}]],
        "lock": ["b:s"],
        "units": "mm",
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"joints": {"jaw": {"tx": [0.5, 0.1]}}}', "joints -> jaw -> tx: lower limit 0.5 above the upper 0.1"),
        ('{"joints": {"jaw": {"tw": [0, 1]}}}', "joints -> jaw -> tw: unknown channel 'tw', expected tx ty"),
        ('{"joints": {"jaw": {"": [0, 1]}}}', "joints -> jaw -> : unknown channel '', expected tx"),
        (
            '{"joints": {"chin": {"tx": [0, 1]}}}',
            "joints -> chin: matches none of 5 joints, expected some of root, jaw",
        ),
        ('{"joints": {"jaw": {"tx": [0, NaN]}}}', "joints -> jaw -> tx -> 1: nan, expected a finite number"),
        ('{"joints": {"jaw": {"tx": [-Infinity, 0]}}}', "joints -> jaw -> tx -> 0: -inf, expected a finite number"),
        ('{"joints": {"jaw": {"tx": [0, 1e999]}}}', "joints -> jaw -> tx -> 1: inf, expected a finite number"),
        ('{"joints": {"jaw": {"tx": [0, 1' + "0" * 400 + "]}}}", "joints -> jaw -> tx -> 1: 100"),
        (
            '{"joints": {"jaw": {"tx": [0]}}}',
            "joints -> jaw -> tx: [0], expected a list of 2 of which each is a finite number or null",
        ),
        ('{"joints": {"jaw": {"tx": [true, 1]}}}', "joints -> jaw -> tx -> 0: True, expected a finite number or null"),
        ('{"joints": {"jaw": {"tx": 1}}}', "joints -> jaw -> tx: 1, expected a list of 2"),
        ('{"joints": {"jaw": [1]}}', "joints -> jaw: [1], expected an object of which each value is a list of 2"),
        ('{"joints": [1]}', "joints: [1], expected an object"),
        ('{"joint": {}}', "option 'joint' is unknown, did you mean 'joints'?"),
        ('{"lock": "root:*"}', "lock: 'root:*', expected a list of which each is a text"),
        ('{"lock": ["root"]}', "lock -> root: expected JOINT:CHANNEL"),
        ('{"lock": ["root:q"]}', "lock -> root:q: unknown channel 'q'"),
        ('{"lock": ["chin:t"]}', "lock -> chin:t: matches none of 5 joints"),
        ('{"units": "inch"}', "units: 'inch', expected one of stage, mm, cm, m"),
        ('{"units": 1}', "units: 1, expected a text"),
        ('{"joints": {"jaw": {}, "jaw": {}}}', "'jaw' twice, expected each key once"),
        ("[1]", "[1], expected a JSON object"),
        ("{", "is not JSON"),
    ],
)
def test_mistakes_in_the_file_name_the_place(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "limits.json"
    file.write_text(text)
    with pytest.raises(InputError) as refusal:
        read_limits(file).resolve(JOINTS, 0.01)
    assert str(refusal.value).startswith(f"{file}")
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


# --- point weights


def soft(parts: FaceParts) -> np.ndarray:
    return np.asarray(parts.meshes[0].regions["mouth"], float)


def test_regions_weigh_their_points_by_their_masks() -> None:
    parts = small()
    mouth = soft(parts)
    weights = point_weights(parts, {"mouth": 3.0, "neck": 0.0}, ())
    np.testing.assert_allclose(weights[:36], 3 * mouth, atol=1e-6)  # the two masks sum to 1
    np.testing.assert_array_equal(weights[36:], 1.0)
    np.testing.assert_array_equal(point_weights(parts, {}, ()), 1.0)


def test_masks_leave_what_they_hold() -> None:
    weights = point_weights(small(), {"mouth": 2.0}, ["lips"])
    assert np.flatnonzero(weights).tolist() == [3, 5]
    np.testing.assert_allclose(weights[[3, 5]], 1 + soft(small())[[3, 5]], atol=1e-6)
    both = point_weights(small(), {}, ["lips", "mouth"])
    np.testing.assert_allclose(both[:36][[3, 5]], 1.0)
    np.testing.assert_allclose(both[[0, 1]], soft(small())[[0, 1]], atol=1e-6)


def test_a_subset_on_several_meshes_is_one_mask() -> None:
    loose = replace_mesh(small().meshes[1], point_subsets={"lips": np.array([8], np.int32)})
    parts = replace(small(), meshes=(small().meshes[0], loose))
    assert np.flatnonzero(point_weights(parts, {}, ["lips"])).tolist() == [3, 5, 44]


@pytest.mark.parametrize(
    ("regions", "mask", "message"),
    [
        ({"nose": 1.0}, (), "region nose: no such region or point subset, expected one of lips, mouth, neck"),
        ({}, ("nose",), "mask nose: no such region or point subset"),
        ({"mouth": -1.0}, (), "region mouth: weight -1.0, expected a number from 0"),
        ({"mouth": np.nan}, (), "region mouth: weight nan"),
        ({"lips": 0.0}, ("lips",), "weights: all points weigh 0"),
    ],
)
def test_weights_that_can_not_be(regions: dict[str, float], mask: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError) as refusal:
        point_weights(small(), regions, mask)
    assert str(refusal.value).startswith(message)
