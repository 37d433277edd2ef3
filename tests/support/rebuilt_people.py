"""People of all kinds as payloads, and the bar of readers on devices: points and joints within 1e-4 mm of Python's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from device_readers import rebuilt
from person_corpus import basis, basis_file
from small_sources import made

from facepipe.heads import make
from facepipe.payload.person import decode_person
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.whole_faces import whole_points

_BAR = 1e-4  # millimetres


def drawn(seed: int = 7) -> np.ndarray:
    """(n, 3) of a person of the head in the box."""
    return whole_points(make(seed))


def blended() -> np.ndarray:
    """The left of one person and the right of another, beyond the modes."""
    one, other = drawn(7), drawn(8)
    share = 1 / (1 + np.exp(-one[:, :1] / 15))
    return np.asarray(share * one + (1 - share) * other)


def placed() -> np.ndarray:
    """A person who stands elsewhere, larger, and looks away."""
    turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    return np.asarray(1.1 * drawn() @ (turn * np.sign(np.linalg.det(turn))).T + [40, -300, 7])


def _head(points: np.ndarray, within: float) -> bytes:
    return encode_points(head_basis(), points, within=within)[0]


def _square() -> bytes:
    square = basis("square")
    return encode_points(square, square.mean + np.sin(square.mean), within=0.05)[0]


PEOPLE: Mapping[str, tuple[str, Callable[[], bytes]]] = {  # which basis, and the payload
    "drawn": ("head", lambda: _head(drawn(), 50.0)),
    "drawn with points": ("head", lambda: _head(drawn(), 0.5)),
    "blended": ("head", lambda: _head(blended(), 0.3)),
    "placed": ("head", lambda: _head(placed(), 50.0)),
    "studio": ("studio", lambda: encode_points(basis("studio"), whole_points(made(1)), within=0.05)[0]),
    "square": ("square", _square),
}


def assert_rebuilt_as_python(driver: Sequence[str], name: str, folder: Path) -> None:
    """That a driver's points and joints of a person are Python's."""
    of, payload = PEOPLE[name]
    own, data = basis(of), payload()
    (folder / "own.fpbasis").write_bytes(basis_file(of))
    (folder / "me.fpb").write_bytes(data)
    expected = own.rebuilt(decode_person(data, name), name)
    points, joints = rebuilt(driver, folder / "own.fpbasis", folder / "me.fpb", len(expected))
    assert np.abs(points - expected).max() <= _BAR
    places = [joint.shares @ expected[joint.points] for joint in own.content.joints]
    np.testing.assert_allclose(joints, np.reshape(places, (-1, 3)), rtol=0, atol=_BAR)
    assert of != "head" or len(joints) == 44
