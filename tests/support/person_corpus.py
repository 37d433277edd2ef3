"""Persons and bases as bytes, sound ones and damaged ones, on which every reader must give the verdicts of Python.

`write` makes a folder of corpora: cases (`NAME.cases`: uint32 length, bytes, one after another), verdicts
(`NAME.verdicts`: a line a case) and, for persons, the basis that they are on (`NAME.fpbasis`). A verdict is `no`, or
`ok` and four figures in nine digits: of the coordinates of points, then of joints, how they are turned and how shapes
are, the mean size, and the mean of each times 1 + i % 7. Figures of other readers may differ as rounding does:
`disagreements` says which differ by more.

    python tests/support/person_corpus.py FOLDER --cases 20000
"""

from __future__ import annotations

import argparse
import random
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from places import REPOSITORY
from small_sources import made

from facepipe.core.errors import InputError
from facepipe.geometry.point_levels import PointLevels
from facepipe.payload.basis import (
    IDENTITY_JOINTS,
    LIDS,
    BasisContent,
    JointPlace,
    JointWeights,
    MeshRun,
    RigidRows,
    basis_body,
    decode_basis,
    digest_of,
    encode_basis,
)
from facepipe.payload.coefficients import PayloadContent, decode, encode, joints_hash, read_header
from facepipe.payload.lid_tables import WAYS, EyeTables, LidTables
from facepipe.payload.person import (
    COEFFICIENTS,
    JOINTS,
    LOOK,
    PICTURES,
    POINTS,
    RIG,
    PersonContent,
    decode_person,
    encode_person,
)
from facepipe.payload.person_rig import LARGEST_STEPS, PersonRig
from facepipe.payload.sections import Section, pack, unpack, written_sections
from facepipe.payload.small_numbers import encode_numbers
from facepipe.rig.identity_joints import coefficients_of_steps
from facepipe.verbs.person_basis import Basis, head_basis, template_basis
from facepipe.verbs.person_rig import RigChange, joint_places
from facepipe.verbs.whole_faces import Topology

Rng = random.Random
SHARES = {"square": 0.45, "studio": 0.3, "head": 0.025, "bases": 0.225}  # of the cases
_NEAR, _NEARLY = 1e-4, 1e-6  # millimetres, and of the size, that figures may differ by
_BESIDE = (LOOK, PICTURES, COEFFICIENTS)  # kinds of sections that say nothing of the shape
_HEAD = 20  # bytes of a basis before its body
_HALVES = (0x7E00, 0xFE00, 0x7C00, 0xFC00, 0x7BFF, 0x5640, 0x5641, 0xD640, 0x3C00, 0x3C01, 0x4200, 0x4201, 0x8000, 1)
_STEPS = (0.001, 0.125, 0.5, 10)  # millimetres, of identity joints
_FLOATS = (np.nan, np.inf, -np.inf, 1e4, 10001, 1, 1.0000001, 3, 3.0000002, 1e-45, 3e38, -0.0, 0.7071068)


@cache
def grid_basis(side: int = 12, modes: int = 3) -> BasisContent:
    """Of a bumpy square of points, and five points beside it that are in no level."""
    rng = np.random.default_rng(0)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side)))
    points = np.vstack([np.stack([x, y, np.sin(x)], axis=1) * 5.0, rng.normal(size=(5, 3)) * 20])
    weights = rng.multinomial(255, [0.6, 0.3, 0.1], side * side)
    joints = JointWeights(  # of a point in no level, too
        first=1,
        places=(20 * rng.normal(size=(5, 3))).astype(np.float32),
        indices=rng.integers(0, 5, (side * side, 3)).astype(np.uint8),
        weights=weights.astype(np.uint8),
    )
    corners = np.array([i for i in range(side * side - side) if i % side < side - 1])
    triangles = np.vstack([np.stack([corners, corners + 1, corners + side], axis=1)])
    levels = PointLevels.of(points, triangles, np.arange(side * side))
    return BasisContent(
        name="square",
        meshes=(MeshRun("Square", side * side), MeshRun("Beside", 5)),
        topology=bytes(range(32)),
        grid=1000,
        places=np.rint(1000 * points).astype(np.int64),
        coarsest=levels.first,
        levels=levels.levels,
        step=0.5,
        modes=rng.integers(-30_000, 30_000, (modes, 3, len(points))).astype(np.int16),
        parts=(RigidRows(np.arange(144, 149), with_modes=False), RigidRows(np.array([0, 1, 7]), with_modes=True)),
        joints=(JointPlace("root/jaw", np.array([3, 9]), np.array([0.25, 0.75])),),
        identity_joints=joints,
        lids=_grid_lids(len(points)) if side == 12 else None,
    )


def _grid_lids(points: int) -> LidTables:
    """Lids of two eyes on a square, of ten rings with a point above and one below each."""
    rng = np.random.default_rng(1)
    eyes = tuple(
        EyeTables(
            lids=first + np.arange(20),
            shell=first + np.arange(20, 27),
            ball=(points - 5, points - 1),
            centre=np.array([first, 20.0, -15.0]),
            joints=(0, 0),
            shares=rng.random((2, 20)),
            balls=rng.normal(size=(2, 4)).astype(np.float32).astype(np.float64),
            stretches=rng.normal(size=(2, 2)).astype(np.float32).astype(np.float64),
            ends=rng.normal(size=(2, 20, 3)),
            ways=rng.normal(size=(len(WAYS), 20, 3)),
        )
        for first in (12, 72)
    )
    return LidTables(
        rings=np.repeat(np.arange(10), 2),
        upper=np.arange(20) % 2 == 0,
        corners=(0, 19),
        links=np.full(20, 3),
        beside=tuple(rng.integers(0, 20, rng.integers(0, 4)) for _ in range(20)),
        reach=rng.uniform(10, 12, (4, 4)),
        eyes=(eyes[0], eyes[1]),
    )


@cache
def basis(name: str) -> Basis:
    """That of persons of a corpus."""
    if name == "head":
        return head_basis()
    if name == "studio":
        return template_basis(made(0), "studio")
    return _of(grid_basis())


def _of(content: BasisContent) -> Basis:
    topology = Topology(names=(), points=(), counts=(), indices=())
    rows = np.arange(len(content.places))
    return Basis(topology=topology, content=content, fitted=rows, digest=digest_of(basis_body(content)))


@cache
def basis_file(name: str) -> bytes:
    """The bytes of a basis."""
    if name == "head":  # the package's: deflating it takes 5 seconds
        return (REPOSITORY / "facepipe" / "heads" / "data" / "head.fpbasis").read_bytes()
    return encode_basis(basis(name).content)


def write(folder: Path, cases: int, seed: int = 0) -> dict[str, int]:
    """Write the corpora; how many cases each has."""
    counts = {name: max(round(share * cases), 1) for name, share in SHARES.items()}
    for name, count in counts.items():
        data = list(corpus(name, count, Rng(f"{name} {seed}")))
        (folder / f"{name}.cases").write_bytes(b"".join(struct.pack("<I", len(one)) + one for one in data))
        judged = map(basis_verdict, data) if name == "bases" else (person_verdict(basis(name), one) for one in data)
        (folder / f"{name}.verdicts").write_text("".join(f"{line}\n" for line in judged))
        if name != "bases":
            (folder / f"{name}.fpbasis").write_bytes(basis_file(name))
    return counts


def write_poses(folder: Path, cases: int, seed: int = 0) -> None:
    """Write the corpus `poses`, of bone coefficients. Figures are of nine numbers a joint and frame, then of times."""
    rng = Rng(f"poses {seed}")
    data = [_unsealed_or_sealed(rng, sound_poses(rng)) for _ in range(cases)]
    (folder / "poses.cases").write_bytes(b"".join(struct.pack("<I", len(one)) + one for one in data))
    (folder / "poses.verdicts").write_text("".join(f"{poses_verdict(one)}\n" for one in data))


def disagreements(folder: Path, name: str, lines: Sequence[str]) -> list[str]:
    """Where another reader's verdicts on a corpus are not Python's."""
    expected = (folder / f"{name}.verdicts").read_text().splitlines()
    if len(lines) != len(expected):
        return [f"{name}: {len(lines)} verdicts, expected {len(expected)}"]
    pairs = enumerate(zip(expected, lines, strict=True))
    return [f"{name}, case {i}: {other}, expected {own}" for i, (own, other) in pairs if not _same(own, other)]


def _same(own: str, other: str) -> bool:
    if own == "no" or other == "no" or not other.startswith("ok "):
        return own == other
    first, second = (np.array(line.split()[1:], np.float64) for line in (own, other))
    sizes = np.repeat(first[[0, 2]], 2)
    return len(second) == 4 and bool((np.abs(first - second) <= _NEAR + _NEARLY * sizes).all())


def person_verdict(basis: Basis, data: bytes) -> str:
    """The line of a person, of a reader of shapes alone: it leaves out looks, pictures and bones, where it may."""
    try:
        rows = unpack(data, "case")
        if any(row.required and row.kind in _BESIDE for row in rows):
            return "no"
        shape = pack([row for row in rows if row.kind not in _BESIDE])
        content = decode_person(shape, "case")
        points = basis.rebuilt(content, "case")
    except InputError:
        return "no"
    return _figures(points.ravel(), joints_and_turns(basis, content, points))


def joints_and_turns(basis: Basis, content: PersonContent, points: np.ndarray) -> np.ndarray:
    """Numbers of a rebuilt person: places of joints, rows of how each is turned, and of how shapes are."""
    return np.concatenate(_rig(basis.content, points, basis.rig_change(content)))


def _rig(content: BasisContent, points: np.ndarray, change: RigChange, *others: np.ndarray) -> list[np.ndarray]:
    worlds = change.worlds(joint_places(content, points))
    return [worlds[:, :3, 3].ravel(), *map(np.ravel, others), worlds[:, :3, :3].ravel(), change.shapes.ravel()]


def basis_verdict(data: bytes) -> str:
    """The line of a basis: of the points that all its modes give, and a step of 1 mm of all numbers of its joints.

    Beside places of joints are all numbers of what lids are fitted by, the right eye's as the file has them. Digests
    are the names that others give them.
    """
    try:
        content, _ = decode_basis(data, "case", trusted=True)
    except InputError:
        return "no"
    points = content.mean + content.step * content.modes.sum(axis=0, dtype=np.int64).T
    if joints := _of(content).joints:
        points[joints.rows] += joints.offsets(coefficients_of_steps(np.ones((len(joints.places), 9)), 1.0))
    lids = [] if content.lids is None else _numbers_of_lids(content.lids)
    still = RigChange.of(None, len(content.joints))
    return _figures(points.ravel(), np.concatenate(_rig(content, points, still, *lids)))


def _numbers_of_lids(lids: LidTables) -> list[np.ndarray]:
    found = [lids.reach]
    for eye, sign in zip(lids.eyes, (1, -1), strict=True):
        mirror = np.array([sign, 1, 1])
        balls = eye.balls * np.append(mirror, 1)
        found += [eye.centre * mirror, eye.shares, balls, eye.stretches, eye.ends * mirror, eye.ways * mirror]
    return found


def poses_verdict(data: bytes) -> str:
    """The line of bone coefficients, of a reader who does not know which joints they are for."""
    try:
        header = read_header(data, "case")
        joints = tuple(map(str, range(header.joints)))
        named = data[:24] + joints_hash(joints) + data[32:-4]
        content = decode(_sealed(named), joints, "case")
    except InputError:
        return "no"
    return _figures(content.frames.ravel(), np.zeros(0) if content.times is None else content.times)


def _figures(*both: np.ndarray) -> str:
    figures = []
    for values in both:
        count = max(len(values), 1)
        figures += [np.abs(values).sum() / count, (values * (1 + np.arange(len(values)) % 7)).sum() / count]
    return " ".join(["ok", *(f"{figure:.9g}" for figure in figures)])


# ---- cases


def corpus(name: str, count: int, rng: Rng) -> Iterator[bytes]:
    """Cases: a third sound."""
    sound = sound_basis if name == "bases" else lambda rng: sound_person(basis(name), rng)
    damages = _BASIS_DAMAGES if name == "bases" else _PERSON_DAMAGES
    for _ in range(count):
        data = sound(rng)
        yield data if rng.random() < 1 / 3 else rng.choice(damages)(rng, data)


def sound_person(basis: Basis, rng: Rng) -> bytes:
    """A person, of some of the layers that there are."""
    draw = np.random.default_rng(rng.getrandbits(32))
    parts, count, modes = len(basis.rigid), len(basis.mean), len(basis.modes)
    size = rng.choice([0.0, 0.01, 1.0, 20.0])
    content = PersonContent(
        basis=basis.digest, modes=draw.normal(0, size, rng.choice([0, modes, rng.randint(0, modes)])).astype(np.float16)
    )
    if rng.random() < 0.4:
        content = replace(content, placement=_placements(draw, 1, 500, rng.random() < 0.2)[0].astype(np.float32))
    if parts and rng.random() < 0.6:
        moves = _placements(draw, parts, 3, rng.random() < 0.2)
        moves[:, 3:6] *= rng.random() < 0.5
        content = replace(content, parts=moves.astype(np.float16))
    if rng.random() < 0.5:
        offsets = draw.normal(0, rng.choice([0.01, 0.3, 30.0]), (count, 3)) * (draw.random((count, 1)) < rng.random())
        coarse = rng.choice([None, rng.randint(0, len(basis.levels.levels))])
        coarse = rng.randint(0, 3) if count > 10_000 else coarse  # all of a head are 20 KB, which take a second
        content = replace(content, points=basis.levels.encode(offsets, rng.choice([0.01, 0.2, 3.0]), coarse)[0])
    if rng.random() < 0.5:
        content = replace(content, joints=_joints(rng, draw, basis), step=float(np.float16(rng.choice(_STEPS))))
    if rng.random() < 0.4:
        content = replace(content, rig=_sound_rig(rng, draw, len(basis.content.joints)))
    data = encode_person(content)
    if rng.random() < 0.1:
        beside = Section(rng.choice([*_BESIDE, 60, 127]), draw.bytes(rng.randint(0, 9)), False)
        data = pack(sorted([*unpack(data, "person"), beside]))
    return data


def _sound_rig(rng: Rng, draw: np.random.Generator, most: int) -> PersonRig:
    """Joints, of as many as there are or fewer, and shapes that stay or turn."""
    numbers = draw.normal(0, rng.choice([0.5, 3, 60]), (rng.choice([most, rng.randint(0, most)]), 6))
    return PersonRig(
        shapes=(_placements(draw, 1, 0, rng.random() < 0.2)[0, 3:] * (rng.random() < 0.7)).astype(np.float16),
        move=float(np.float16(rng.choice(_STEPS))),
        turn=float(np.float16(rng.choice((1e-4, 5e-4, 0.01, 0.0999)))),
        steps=np.rint(numbers).astype(np.int64).clip(-LARGEST_STEPS, LARGEST_STEPS),
    )


def _joints(rng: Rng, draw: np.random.Generator, basis: Basis) -> np.ndarray:
    """Numbers of as many joints as there are, or fewer, of any size."""
    most = 0 if basis.joints is None else len(basis.joints.places)
    numbers = draw.normal(0, rng.choice([0.5, 3, 60]), (rng.choice([most, rng.randint(0, most)]), 9))
    return np.rint(numbers).astype(np.int64).clip(-LARGEST_STEPS, LARGEST_STEPS)


def _placements(draw: np.random.Generator, count: int, reach: float, half: bool) -> np.ndarray:
    turns = draw.normal(0, 0.1, (count, 3))
    if half:
        turns /= np.linalg.norm(turns, axis=1, keepdims=True) * 1.0001
    return np.hstack([draw.normal(0, reach, (count, 3)), turns, draw.normal(0, 0.1, (count, 1))])


def sound_basis(rng: Rng) -> bytes:
    """A small basis, deflated in one of many ways."""
    content = rng.choice([grid_basis(), basis("studio").content, grid_basis(3, 1)])
    if rng.random() < 0.5:
        content = replace(content, parts=(), joints=content.joints[: rng.randint(0, 1)])
        content = replace(content, lids=content.lids if content.joints else None)
    if rng.random() < 0.3:
        content = replace(content, identity_joints=None)
    return sealed_basis(rng, basis_body(content))


def sealed_basis(rng: Rng, body: bytes) -> bytes:
    """The file of a basis with such a body."""
    strategies = (zlib.Z_DEFAULT_STRATEGY, zlib.Z_FIXED, zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE, zlib.Z_FILTERED)
    deflater = zlib.compressobj(
        rng.choice([0, 1, 6, 9]), zlib.DEFLATED, rng.randint(9, 15), rng.choice([1, 8]), rng.choice(strategies)
    )
    packed = deflater.compress(body[: len(body) // 2])
    packed += deflater.flush(rng.choice([zlib.Z_NO_FLUSH, zlib.Z_SYNC_FLUSH])) + deflater.compress(
        body[len(body) // 2 :]
    )
    return struct.pack("<4sHH8sI", b"FPBA", 1, 0, digest_of(body), len(body)) + packed + deflater.flush()


def sound_poses(rng: Rng) -> bytes:
    """Bone coefficients: a pose, poses or a clip, of some joints or all."""
    draw = np.random.default_rng(rng.getrandbits(32))
    count, frames = rng.randint(1, 40), rng.choice([None, 1, 3])
    values = draw.normal(0, 1, (frames or 1, count, 9))
    values[:, draw.random(count) < rng.random()] = [0.0] * 6 + [1.0] * 3
    content = PayloadContent(
        joints=tuple(map(str, range(count))),
        coefficients=values if frames else values[0],
        times=np.cumsum(draw.random(frames) + 0.01) if frames and rng.random() < 0.5 else None,
        meters_per_unit=0.01,
        precision=rng.choice(["float16", "float32"]),
    )
    return encode(content).data


# ---- damage


def _sealed(body: bytes) -> bytes:
    return body + struct.pack("<I", zlib.crc32(body))


def _scattered(rng: Rng, data: bytes, start: int) -> bytes:
    """Some bytes changed, mostly after the start."""
    broken = bytearray(data)
    for _ in range(rng.randint(1, 4) if broken else 0):
        place = (
            rng.randrange(len(broken))
            if rng.random() < 0.1
            else rng.randrange(min(start, len(broken) - 1), len(broken))
        )
        broken[place] = rng.choice([broken[place] ^ 1 << rng.randrange(8), rng.randrange(256), 0, 255, 127, 128])
    return bytes(broken)


def _cut(rng: Rng, data: bytes) -> bytes:
    place, count = rng.randrange(len(data) + 1), rng.randint(1, 9)
    return rng.choice(
        [data[:place], data[:place] + data[place + count :], data[:place] + rng.randbytes(count) + data[place:]]
    )


def _bytes_of_person(rng: Rng, data: bytes) -> bytes:
    return _sealed(_scattered(rng, data[:-4], 18))


def _cut_of_person(rng: Rng, data: bytes) -> bytes:
    return _sealed(_cut(rng, data[:-4]))


def _unsealed(rng: Rng, data: bytes) -> bytes:
    return rng.choice([_cut, lambda rng, data: _scattered(rng, data, 0)])(rng, data)


def _sections(rng: Rng, data: bytes) -> bytes:
    """Sections in another order, twice, gone, with other kinds or lengths."""
    rows = list(unpack(data, "person"))
    i, j = rng.randrange(len(rows)), rng.randrange(len(rows))
    what = rng.randrange(6)
    if what == 0:
        rows[i], rows[j] = rows[j], rows[i]
    elif what == 1:
        rows.insert(i, rows[j])
    elif what == 2:
        rows.pop(i)
    elif what == 3:
        rows[i] = rows[i]._replace(kind=rng.randint(0, 127), required=rng.random() < 0.5)
    elif what == 4:
        rows[i] = rows[i]._replace(data=_cut(rng, rows[i].data), required=rng.random() < 0.5)
    else:
        rows += [Section(kind, b"", False) for kind in range(100 - rng.randint(50, 65), 100)]
    return pack(rows)


def _numbers(rng: Rng, data: bytes) -> bytes:
    """Numbers at their limits, beyond them, and none."""
    rows = list(unpack(data, "person"))
    for _ in range(rng.randint(1, 2)):
        i = rng.randrange(len(rows))
        own, width = bytearray(rows[i].data), 4 if rows[i].kind in (3, 6) else 2
        if len(own) < width:
            continue
        place = 0 if rows[i].kind in (POINTS, JOINTS) else width * rng.randrange(len(own) // width)
        number = struct.pack("<f", rng.choice(_FLOATS)) if width == 4 else struct.pack("<H", rng.choice(_HALVES))
        own[place : place + width] = number
        rows[i] = rows[i]._replace(data=bytes(own))
    return pack(rows)


def _joints_of_person(rng: Rng, data: bytes) -> bytes:
    """Identity joints of other counts and steps, with numbers beyond limits, and cut."""
    rows = [row for row in unpack(data, "person") if row.kind != JOINTS]
    numbers = np.array([[rng.choice((0, 0, 1, -1, 9, -20, 127)) for _ in range(9)] for _ in range(rng.randint(1, 9))])
    count, bits = len(numbers), encode_numbers(numbers)
    what = rng.randrange(4)
    if what == 0:
        count = rng.randrange(256)
    elif what == 1:
        place = rng.randrange(numbers.size)
        numbers.flat[place] = rng.choice((-1, 1)) * rng.choice((126, 127, 128, 141, 142, 32780, 32781, 70_000))
        bits = encode_numbers(numbers)
    elif what == 2:
        bits = _scattered(rng, bits, 0)
    step = rng.choice((*_HALVES, 0x4900, 0x4901)) if what == 3 else 0x3000  # the most, and beyond
    own = struct.pack("<HB", step, count) + bits
    own = _cut(rng, own) if rng.random() < 0.2 else own
    return pack(sorted([*rows, Section(JOINTS, own, rng.random() < 0.9)]))


def _rig_of_person(rng: Rng, data: bytes) -> bytes:
    """Rigs of other counts and steps, with numbers beyond limits, and cut."""
    rows = [row for row in unpack(data, "person") if row.kind != RIG]
    numbers = np.array([[rng.choice((0, 0, 1, -1, 9, -20, 127)) for _ in range(6)] for _ in range(rng.randint(0, 3))])
    numbers = numbers.reshape(-1, 6)
    count = rng.randrange(256) if rng.random() < 0.3 else len(numbers)
    if len(numbers) and rng.random() < 0.3:
        numbers.flat[rng.randrange(numbers.size)] = rng.choice((-1, 1)) * rng.choice((126, 127, 128, 141, 142, 70_000))
    halves = [*(rng.choice((0, 0x3000, 0xB000, 0x3BFF)) for _ in range(4)), 0x2E66, 0x1019]
    if rng.random() < 0.5:
        halves[rng.randrange(6)] = rng.choice((*_HALVES, 0x4900, 0x4901, 0x2E66, 0x2E67))  # the most, and beyond
    bits = encode_numbers(numbers)
    own = struct.pack("<6HB", *halves, count) + (_scattered(rng, bits, 0) if rng.random() < 0.2 else bits)
    own = _cut(rng, own) if rng.random() < 0.2 else own
    return pack(sorted([*rows, Section(RIG, own, rng.random() < 0.9)]))


def _unsealed_or_sealed(rng: Rng, data: bytes) -> bytes:
    """Two thirds damaged, mostly under the right sum, half of them in the header."""
    if rng.random() < 1 / 3:
        return data
    if rng.random() < 0.5:
        return _sealed(_scattered(rng, data[:32], 4) + data[32:-4])
    return rng.choice([_unsealed, lambda rng, data: _sealed(_scattered(rng, data[:-4], 32)), _cut_of_person])(rng, data)


_Damage = Callable[[Rng, bytes], bytes]
_PERSON_DAMAGES: tuple[_Damage, ...] = (
    _bytes_of_person,
    _bytes_of_person,
    _cut_of_person,
    _unsealed,
    _sections,
    _numbers,
    _joints_of_person,
    _rig_of_person,
)


def _body_of_basis(rng: Rng, data: bytes) -> bytes:
    """Bytes anywhere, or where counts are: among the first of the sections."""
    body = zlib.decompress(data[_HEAD:])
    places = [0, 0, *(body.find(section.data, 1) for section in _sections_of_basis(body))]
    start = rng.choice(places)
    end = start + rng.choice([12, 60, len(body)])
    return sealed_basis(rng, body[:start] + _scattered(rng, body[start:end], 0) + body[end:])


def _sections_of_basis(body: bytes) -> list[Section]:
    """Those of a body that is sound."""
    return list(unpack(_sealed(b"FPBC\2\0\0\0" + body), "basis"))


def _rows_of_basis(rng: Rng, data: bytes) -> bytes:
    """Sections gone, twice, of other kinds, cut."""
    changed = _sections(rng, _sealed(b"FPBC\2\0\0\0" + zlib.decompress(data[_HEAD:])))
    return sealed_basis(rng, changed[8:-4])


def _joints_of_basis(rng: Rng, data: bytes) -> bytes:
    """Counts, places, joints and weights of identity joints."""
    rows = _sections_of_basis(zlib.decompress(data[_HEAD:]))
    kinds = [row.kind for row in rows]
    if IDENTITY_JOINTS not in kinds:
        return data
    number = kinds.index(IDENTITY_JOINTS)
    own = bytearray(rows[number].data)
    what, joints = rng.randrange(5), own[0]
    if what == 0:
        place = rng.choice([0, 1, 2, 6, 9])
        own[place] = rng.choice([own[place] + 1 & 255, own[place] - 1 & 255, 0, 255])
    elif what == 4:
        own[2:6] = struct.pack("<I", rng.choice([5, 6]))  # five points have none: the last it can be, and beyond
    elif what == 1:
        place = 10 + 4 * rng.randrange(3 * joints)
        own[place : place + 4] = struct.pack("<f", rng.choice((np.nan, -np.inf, 3e38, 1e5, -1e5, 100_001)))
    else:
        place = rng.randrange(10 + 12 * joints, len(own))
        own[place] = rng.choice([own[place] + 1 & 255, 0, joints - 1, joints])
    own += bytes(rng.random() < 0.2)  # one more
    rows[number] = rows[number]._replace(data=bytes(own))
    return sealed_basis(rng, written_sections(rows))


def _lids_of_basis(rng: Rng, data: bytes) -> bytes:
    """Counts, rings, rows and numbers of what lids are fitted by."""
    rows = _sections_of_basis(zlib.decompress(data[_HEAD:]))
    if rows[-1].kind != LIDS:
        return data
    own = bytearray(rows[-1].data)
    for _ in range(rng.randint(1, 2)):
        what = rng.randrange(4)
        place = rng.randrange((9, 9 + 4 * 20, len(own), len(own) - 3)[what])
        if what == 3:
            own[place : place + 4] = struct.pack("<f", rng.choice((np.nan, -np.inf, 3e38, 1e5, -1e5, 100_001)))
        else:
            own[place] = rng.choice([own[place] + 1 & 255, own[place] - 1 & 255, 0, 19, 20, 255])
    own += bytes(rng.random() < 0.1)  # one more
    return sealed_basis(rng, written_sections([*rows[:-1], rows[-1]._replace(data=bytes(own))]))


def _cut_of_basis(rng: Rng, data: bytes) -> bytes:
    return sealed_basis(rng, _cut(rng, zlib.decompress(data[_HEAD:])))


def _stream(rng: Rng, data: bytes) -> bytes:
    """A stream that is damaged under the sum of what it should be, or was."""
    return data[:_HEAD] + _scattered(rng, data[_HEAD:-4], 0) + data[-4:]


def _reached(rng: Rng, data: bytes) -> bytes:
    """A damaged stream with size and sum of what it inflates to."""
    stream = zlib.decompressobj(-15)
    packed = _scattered(rng, data[_HEAD + 2 : -4], 0)
    try:
        body = stream.decompress(packed, 1 << 20)
    except zlib.error:
        return _stream(rng, data)
    head = data[:16] + struct.pack("<I", len(body)) + data[_HEAD : _HEAD + 2]
    return head + packed + struct.pack(">I", zlib.adler32(body))


def _file_of_basis(rng: Rng, data: bytes) -> bytes:
    return rng.choice([_cut(rng, data), _scattered(rng, data[:32], 0) + data[32:]])


_BASIS_DAMAGES: tuple[_Damage, ...] = (
    *(_body_of_basis, _body_of_basis, _rows_of_basis, _cut_of_basis, _joints_of_basis, _lids_of_basis, _stream),
    *(_reached, _reached, _file_of_basis),
)


def main() -> None:
    """Write the corpora, and say how many cases are sound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    chosen.folder.mkdir(parents=True, exist_ok=True)
    for name, count in write(chosen.folder, chosen.cases, chosen.seed).items():
        sound = (chosen.folder / f"{name}.verdicts").read_text().count("ok ")
        print(f"{name}: {count} cases, {sound} sound")


if __name__ == "__main__":
    main()
