"""People of all kinds as payloads, and the bar of readers on devices: points and joints within 1e-4 mm of Python's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from device_readers import lids, rebuilt
from person_corpus import basis, basis_file, joints_and_turns
from small_sources import made

from facepipe.heads import make
from facepipe.heads.assembly import LIDS, average
from facepipe.heads.asset import arrays
from facepipe.payload.person import decode_person, encode_person
from facepipe.payload.person_rig import PersonRig
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.person_neutral import with_neutral
from facepipe.verbs.person_rig import RigChange
from facepipe.verbs.whole_faces import whole_points

_BAR = 1e-4  # millimetres
RIG = PersonRig(  # as of who was blended by regions, but larger
    shapes=np.array([0.06, -0.02, 0.01, 0.05], np.float16),
    move=float(np.float16(0.1)),
    turn=float(np.float16(0.002)),
    steps=np.random.default_rng(3).integers(-20, 21, (43, 6)) // [1, 1, 1, 4, 4, 4],
)


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


def with_rig(payload: bytes) -> bytes:
    """A payload with that rig."""
    return encode_person(replace(decode_person(payload, "me"), rig=RIG))


def _square() -> bytes:
    square = basis("square")
    return encode_points(square, square.mean + np.sin(square.mean), within=0.05)[0]


PEOPLE: Mapping[str, tuple[str, Callable[[], bytes]]] = {  # which basis, and the payload
    "drawn": ("head", lambda: _head(drawn(), 50.0)),
    "drawn with points": ("head", lambda: _head(drawn(), 0.5)),
    "blended": ("head", lambda: _head(blended(), 0.3)),
    "placed": ("head", lambda: _head(placed(), 50.0)),
    "blended with a rig": ("head", lambda: with_rig(_head(blended(), 0.3))),
    "studio": ("studio", lambda: encode_points(basis("studio"), whole_points(made(1)), within=0.05)[0]),
    "square": ("square", _square),
}
HEADS = [name for name, (of, _) in PEOPLE.items() if of == "head"]


def assert_rebuilt_as_python(driver: Sequence[str], name: str, folder: Path) -> None:
    """That a driver's points and joints of a person are Python's."""
    of, payload = PEOPLE[name]
    own, data = basis(of), payload()
    (folder / "own.fpbasis").write_bytes(basis_file(of))
    (folder / "me.fpb").write_bytes(data)
    content = decode_person(data, name)
    expected = own.rebuilt(content, name)
    points, joints = rebuilt(driver, folder / "own.fpbasis", folder / "me.fpb", len(expected))
    assert np.abs(points - expected).max() <= _BAR
    np.testing.assert_allclose(joints.ravel(), joints_and_turns(own, content, expected), rtol=0, atol=_BAR)
    assert of != "head" or len(joints) == 4 * 44 + 3


def python_lids(points: np.ndarray, rig: RigChange | None = None) -> dict[tuple[str, float], np.ndarray]:
    """(k, 3) offsets in millimetres, by shape and weight, of lids of who has points (n, 3) of the head in the box."""
    face = with_neutral(average(), head_basis(), points, rig)
    head, found = face.meshes[0], {}
    for shape in head.blendshapes:
        if shape.name in LIDS:
            own = arrays("lids")["lids"][int(shape.name.endswith("Right"))]
            for weight, offsets in ((1.0, shape.offsets), *((one.weight, one.offsets) for one in shape.inbetweens)):
                whole = np.zeros((len(head.points), 3))
                whole[shape.point_indices] = offsets
                found[shape.name, weight] = 10 * whole[own]
    return found


def assert_lids_as_python(driver: Sequence[str], name: str, folder: Path) -> None:
    """That a driver's shapes of lids of a person are Python's, and not those of the head that everyone has."""
    data = PEOPLE[name][1]()
    (folder / "head.fpbasis").write_bytes(basis_file("head"))
    (folder / "me.fpb").write_bytes(data)
    rows, offsets = lids(driver, folder / "head.fpbasis", folder / "me.fpb")
    content = decode_person(data, name)
    expected = python_lids(head_basis().rebuilt(content, name), head_basis().rig_change(content))
    assert len(rows) == len(set(rows))
    assert set(rows) == set(expected)
    for row, own in zip(rows, offsets, strict=True):
        assert np.abs(own - expected[row]).max() <= _BAR, row
    usual = python_lids(head_basis().mean)
    assert max(np.abs(usual[row] - expected[row]).max() for row in rows) > 1
