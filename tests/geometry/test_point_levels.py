"""Points by levels: what was written is what is read, nearer with more bytes, and no bytes do harm."""

from __future__ import annotations

import random
from functools import cache

import numpy as np
import pytest

from facepipe.core.errors import InputError
from facepipe.geometry.point_levels import PointLevels
from facepipe.geometry.polygons import point_triangles
from facepipe.heads.asset import asset
from facepipe.payload.range_coder import BitReader, BitWriter


@cache
def surface() -> tuple[np.ndarray, np.ndarray]:
    """Points of the built-in head's skin in millimetres, and triangles."""
    head = asset()
    triangles = point_triangles(head.counts, head.indices)
    part = head.parts["Head"].points
    return 10 * head.points[part], triangles[(triangles < part.stop).all(axis=1)]


@cache
def skin() -> PointLevels:
    """Its levels."""
    return PointLevels.of(*surface())


@cache
def bumps(width: float = 30.0, size: float = 3.0) -> np.ndarray:
    """(n, 3) smooth offsets in millimetres."""
    rng, points = np.random.default_rng(1), surface()[0]
    centres = points[rng.choice(len(points), 60)]
    squares = ((points[:, None] - centres) ** 2).sum(axis=2)
    offsets = np.exp(-squares / (2 * width**2)) @ rng.standard_normal((60, 3))
    return size * offsets / np.sqrt((offsets**2).sum(axis=1).mean())


@pytest.mark.parametrize("seed", range(40))
def test_a_coder_gives_back_what_it_was_given(seed: int) -> None:
    chance = random.Random(seed)
    odds = [0.01, 0.5, 0.9, 0.9999, 0.0]
    ops: list[tuple[str, int, int]] = []
    for _ in range(chance.choice([0, 1, 30, 4000])):
        kind = chance.choice("bbbng")
        context = chance.randrange(len(odds))
        value = {"b": int(chance.random() < odds[context]), "n": chance.randrange(1 << 7)}
        ops.append((kind, context, value.get(kind, int(chance.expovariate(0.02)))))
    writer = BitWriter(len(odds))
    for kind, context, value in ops:
        if kind == "b":
            writer.bit(context, value)
        elif kind == "n":
            writer.number(value, 7)
        else:
            writer.growing(value)
    reader = BitReader(writer.bytes(), len(odds), "coder")
    for kind, context, value in ops:
        read = reader.bit(context) if kind == "b" else reader.number(7) if kind == "n" else reader.growing()
        assert read == value


def test_bits_take_what_they_are_worth() -> None:
    """100,000 bits of which one in fifty is set are worth 14,144 of information."""
    chance, writer = random.Random(0), BitWriter(1)
    for _ in range(100_000):
        writer.bit(0, int(chance.random() < 0.02))
    assert 14_144 / 8 * 0.97 < len(writer.bytes()) < 14_144 / 8 * 1.12


@pytest.mark.parametrize("step", [0.2, 1.0, 7.0])
def test_readers_get_what_the_writer_says_within_the_step(step: float) -> None:
    data, got = skin().encode(bumps(), step)
    np.testing.assert_array_equal(skin().decode(data, "points"), got)
    assert np.abs(got - bumps()).max() <= 0.5301 * step
    assert np.linalg.norm(got - bumps(), axis=1).max() > 0.1 * step, "a bound that is far from reached says nothing"


def test_more_bytes_are_nearer_and_coarse_levels_alone_are_smooth() -> None:
    sizes, errors = [], []
    for coarse in (3, 5, 7, None):
        data, got = skin().encode(bumps(), 0.4, coarse)
        sizes.append(len(data))
        errors.append(np.linalg.norm(got - bumps(), axis=1).mean())
    assert sizes == sorted(sizes)
    assert errors == sorted(errors, reverse=True)
    assert errors[1] < 0.35 * np.linalg.norm(bumps(), axis=1).mean(), "a few hundred points predict the others"


def test_still_points_take_no_bytes() -> None:
    assert len(skin().encode(np.zeros_like(surface()[0]), 0.1)[0]) <= 12
    one = np.zeros_like(surface()[0])
    one[4000] = [0, 3, 0]
    data, got = skin().encode(one, 0.1)
    assert len(data) < 150
    assert np.abs(got - one).max() <= 0.0531


def test_noise_takes_what_noise_is_worth() -> None:
    """Offsets that nothing predicts: within a tenth of the entropy of their steps."""
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 1, surface()[0].shape)
    data, _ = skin().encode(noise, 1.0)
    # of a normal variable in steps of its deviation, 2.05 bits; levels add noise of their own, up to twice the square
    assert len(data) < noise.size * 2.6 / 8


@pytest.mark.parametrize("kind", ["one place", "line", "two", "few", "heap", "no triangles"])
def test_odd_surfaces_work(kind: str) -> None:
    rng = np.random.default_rng(0)
    points = {
        "one place": np.zeros((500, 3)),
        "line": np.outer(np.arange(300.0), [1, 0, 0]),
        "two": np.array([[0.0, 0, 0], [1, 0, 0]]),
        "few": rng.normal(size=(20, 3)),
        "heap": np.vstack([rng.normal(size=(100, 3)) * 100, rng.normal(size=(4000, 3)) * 1e-3]),
        "no triangles": rng.normal(size=(700, 3)) * 50,
    }[kind]
    triangles = np.zeros((0, 3), np.int64)
    if kind != "no triangles":
        triangles = np.array([[i, i + 1, (i + 2) % len(points)] for i in range(len(points) - 1)])
    levels = PointLevels.of(points, triangles)
    offsets = rng.normal(size=points.shape)
    data, got = levels.encode(offsets, 0.1)
    np.testing.assert_array_equal(levels.decode(data, "points"), got)
    assert np.abs(got - offsets).max() < 0.06


def test_levels_are_the_same_whatever_the_order_of_neighbours_in_a_tree() -> None:
    """A head whose halves mirror each other has many ties: none of them may be broken by rounding."""
    side = np.random.default_rng(0).uniform(1, 80, (400, 3)).round()
    points = np.vstack([side, side * [-1, 1, 1]])
    offsets = np.random.default_rng(1).normal(size=points.shape)
    triangles = np.array([[i, i + 1, i + 2] for i in range(398)])
    triangles = np.vstack([triangles, triangles[:, ::-1] + 400])
    one = PointLevels.of(points, triangles).encode(offsets, 0.3)[0]
    far = PointLevels.of(points + 1e-9, triangles).encode(offsets, 0.3)[0]
    assert one == far


def test_bytes_that_nobody_wrote_are_refused_or_give_numbers() -> None:
    data, _ = skin().encode(bumps(), 1.0, 6)
    rng = np.random.default_rng(0)
    for _ in range(300):
        broken = bytearray(data)
        for place in rng.integers(0, len(data), rng.integers(1, 4)):
            broken[place] = rng.integers(0, 256)
        cut = bytes(broken[: rng.integers(0, len(data) + 1)]) if rng.random() < 0.3 else bytes(broken)
        try:
            got = skin().decode(cut, "points")
        except InputError:
            continue
        assert np.isfinite(got).all()
        assert np.abs(got).max() <= 1e4


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "0 bytes, expected at least 5"),
        (b"\0\0\0\0\1", "steps of 0 mm, expected more than 0 and at most 10000"),
        (b"\0\0\xc0\x7f\1", "steps of nan mm"),
        (b"\0\0\x80\x3f\xff", "255 levels, expected at most the 10 of these points"),
        (b"\0\0\x80\x3f\x08" + b"\xff" * 40, "expected"),
    ],
)
def test_headers_are_checked(data: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        skin().decode(data, "points")
