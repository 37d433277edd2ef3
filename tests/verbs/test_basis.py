"""The file of a basis: what was written is what is read, by plain loops too, and nothing else is."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Capsys
from faces import tiny_face
from person_corpus import grid_basis
from places import REPOSITORY

import facepipe
from facepipe.cli import main
from facepipe.core.errors import InputError
from facepipe.heads.assembly import skeleton
from facepipe.payload.basis import basis_body, decode_basis, digest_of, encode_basis
from facepipe.stage import save_parts
from facepipe.verbs.person_basis import head_basis


def test_what_was_written_is_read() -> None:
    made = grid_basis()
    data = encode_basis(made)
    read, digest = decode_basis(data, "square")
    assert digest == digest_of(basis_body(made)) == data[8:16]
    assert basis_body(read) == basis_body(made)
    np.testing.assert_array_equal(read.modes, made.modes)
    np.testing.assert_array_equal(read.places, made.places)
    assert (read.name, read.meshes, read.joints[0].path) == ("square", made.meshes, "root/jaw")
    assert [part.rows.tolist() for part in read.parts] == [part.rows.tolist() for part in made.parts]


def test_modes_are_what_plain_loops_read_by_the_page() -> None:
    """By docs/files.md alone, number by number."""
    made = grid_basis()
    body = zlib.decompress(encode_basis(made)[20:])
    sections, place = {}, 0
    while place < len(body):
        kind, place, length, shift = body[place] & 127, place + 1, 0, 0
        while True:
            length |= (body[place] & 127) << shift
            shift, place = shift + 7, place + 1
            if body[place - 1] < 128:
                break
        sections[kind], place = body[place : place + length], place + length
    data, n = sections[5], 149
    count, step = struct.unpack("<Hf", data[:6])
    assert (count, step) == (3, 0.5)
    numbers = 3 * count * n
    folded = [data[6 + i] | data[6 + numbers + i] << 8 for i in range(numbers)]
    rest = [(value >> 1) ^ -(value & 1) for value in folded]
    ordered = [*made.coarsest, *(row for level in made.levels for row in level.rows), *range(144, 149)]
    near = {
        int(row): list(zip(own.tolist(), shares.tolist(), strict=True))
        for level in made.levels
        for row, own, shares in zip(level.rows, level.neighbours, level.shares, strict=True)
    }
    for plane in range(3 * count):
        steps, before = {}, 0
        for i, row in enumerate(map(int, ordered)):
            value = rest[plane * n + i]
            if row >= 144:
                value += before
                before = value
            elif row in near:
                value += 32 + sum(share * steps[other] for other, share in near[row]) >> 6
            steps[row] = (value + 2**15) % 2**16 - 2**15
            before = before if row < 144 else steps[row]
        assert [steps[row] for row in range(n)] == made.modes[plane // 3, plane % 3].tolist()


def test_the_command_writes_what_the_package_has(tmp_path: Path) -> None:
    out = tmp_path / "head.fpbasis"
    assert main(["basis", "-o", str(out)]) == 0
    shipped = (REPOSITORY / "facepipe" / "heads" / "data" / "head.fpbasis").read_bytes()
    assert out.read_bytes()[:20] == shipped[:20]
    assert zlib.decompress(out.read_bytes()[20:]) == zlib.decompress(shipped[20:])


def test_joints_of_the_basis_are_where_the_skeleton_of_a_person_has_them() -> None:
    basis = head_basis()
    points = basis.shaped(np.random.default_rng(0).normal(size=100))
    places = [joint.shares @ points[joint.points] for joint in basis.content.joints]
    made = skeleton(points / 10)
    np.testing.assert_allclose(places, 10 * np.asarray(made.bind_transforms)[:, :3, 3], atol=1e-4)
    assert [joint.path for joint in basis.content.joints] == list(made.joints)


def test_a_studios_own_face_is_a_basis(tmp_path: Path, capsys: Capsys) -> None:
    face, out = tmp_path / "face.usda", tmp_path / "face.fpbasis"
    save_parts(tiny_face(), face)
    report = facepipe.basis(out=out, template=face)
    read, digest = decode_basis(out.read_bytes(), out)
    assert (digest.hex(), len(read.places)) == (report.digest, report.points)
    assert not len(read.modes)
    assert facepipe.person(face, out=tmp_path / "a.fpb", template=face).digest == report.digest
    assert facepipe.person(face, out=tmp_path / "me.fpb", database=out).digest == report.digest
    assert (
        main(
            [
                "apply-bones",
                str(face),
                str(tmp_path / "me.fpb"),
                "--database",
                str(out),
                "-o",
                str(face.with_stem("me")),
            ]
        )
        == 0
    )
    assert main(["basis", "-o", str(tmp_path / "new.fpbasis"), "--template", str(face), "--database", "x.fpdb"]) == 2
    assert "--template: given with --database" in capsys.readouterr().err


@pytest.mark.parametrize("place", [0, 4, 6, 8, 16, 25, -1])
def test_damage_is_refused(place: int) -> None:
    data = bytearray(encode_basis(grid_basis()))
    data[place] ^= 0x55
    with pytest.raises(InputError, match=r"^square"):
        decode_basis(bytes(data), "square")


def test_cut_and_longer_files_are_refused() -> None:
    data = encode_basis(grid_basis())
    for broken in (b"", data[:10], data[:20], data[:-1], data + b"x", data[:16] + struct.pack("<I", 1 << 30)):
        with pytest.raises(InputError, match=r"^square"):
            decode_basis(broken, "square")


def test_what_a_bad_writer_seals_is_refused_or_a_basis() -> None:
    """Bodies changed anywhere under a digest that fits: one line, and nothing but whole numbers that fit each other."""
    body, rng, refused = basis_body(grid_basis()), np.random.default_rng(1), 0
    taken = 0
    for _ in range(600):
        broken = bytearray(body)
        for place in rng.integers(0, len(body) if rng.random() < 0.3 else 400, rng.integers(1, 4)):
            broken[place] = rng.integers(256)
        if rng.random() < 0.2:
            del broken[rng.integers(len(body)) :]
        head = struct.pack("<4sHH8sI", b"FPBA", 1, 0, digest_of(bytes(broken)), len(broken))
        try:
            read, _ = decode_basis(head + zlib.compress(bytes(broken), 1), "square")
        except InputError as error:
            refused += str(error).startswith("square") and "\n" not in str(error)
            continue
        taken += 1
        assert len(read.places) == sum(mesh.points for mesh in read.meshes)
        assert all((level.neighbours < len(read.places)).all() for level in read.levels)
    assert refused + taken == 600
    assert min(refused, taken) > 100


def test_what_inflates_beyond_its_header_is_refused_at_once() -> None:
    bomb = struct.pack("<4sHH8sI", b"FPBA", 1, 0, bytes(8), 1000) + zlib.compress(bytes(1 << 26), 9)
    with pytest.raises(InputError, match="expected 1,000 bytes"):
        decode_basis(bomb, "bomb")


def test_sections_that_are_unknown_and_required_are_refused() -> None:
    body = basis_body(grid_basis())
    for kind, refused in ((0x80 | 90, True), (90, False)):
        changed = body + bytes([kind, 2]) + b"ab"
        head = struct.pack("<4sHH8sI", b"FPBA", 1, 0, digest_of(changed), len(changed))
        if refused:
            with pytest.raises(InputError, match="section of kind 90, which this version"):
                decode_basis(head + zlib.compress(changed), "square")
        else:
            assert decode_basis(head + zlib.compress(changed), "square")[0].name == "square"


def test_a_basis_of_a_million_parts_is_refused() -> None:
    """Each would be all points: 11 bytes of a file that 1 MB of memory is taken for."""
    made = grid_basis()
    with pytest.raises(InputError, match="more than 16 parts"):
        decode_basis(encode_basis(replace(made, parts=17 * made.parts[:1])), "square")


def test_shares_that_are_not_whole_are_refused() -> None:
    made = grid_basis()
    level = made.levels[0]
    wrong = replace(made, levels=(level._replace(shares=level.shares + np.int8(1)), *made.levels[1:]))
    with pytest.raises(InputError, match="sum is not 64"):
        decode_basis(encode_basis(wrong), "square")
