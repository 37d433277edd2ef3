"""Face databases: what they hold, that adding is starting over, that files come back and damage is refused."""

from __future__ import annotations

import functools
import json
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from database_faces import SHAPES, person, source, sources
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from import_data import damaged, refused
from places import SUPPORT

from facepipe.core.errors import FacepipeError, InputError, TopologyError
from facepipe.parts import Blendshape, FaceParts
from facepipe.scanning.database import (
    AddOptions,
    DatabaseOptions,
    FaceDatabase,
    Quality,
    add_faces,
    carried_mean,
    create_database,
    load_database,
    predicted_shapes,
    quality_from,
    remove_faces,
    save_database,
)
from facepipe.scanning.database.changes import stage_sources
from facepipe.scanning.database.database_file import FORMAT
from facepipe.verbs.array_file import read_arrays, write_arrays
from facepipe.verbs.whole_faces import Topology, WholeFace, whole_face

EXACT = DatabaseOptions(tolerance_mm=1e-4)
GOOD = Quality(surface_mean_mm=0.1, surface_p95_mm=0.4, coverage=0.9, flipped_triangles=0)


def check_same(one: FaceDatabase, other: FaceDatabase) -> None:
    """To a thousandth of a millimetre, and a millionth of the deviations."""
    assert one.shapes == other.shapes
    assert one.left_out == other.left_out
    assert one.shape_meshes == other.shape_meshes
    assert [entry.name for entry in one.entries] == [entry.name for entry in other.entries]
    np.testing.assert_allclose(one.identity.deviations, other.identity.deviations, rtol=1e-6)
    np.testing.assert_allclose(one.neutrals(), other.neutrals(), atol=1e-3)
    for entry in one.entries:
        found, expected = one.deltas(entry.name), other.deltas(entry.name)
        assert list(found) == list(expected)
        for name in found:
            np.testing.assert_allclose(found[name], expected[name], atol=1e-3)


def test_neutrals_and_shapes_of_all_entries_come_back_within_the_stated_error() -> None:
    for tolerance in (1e-4, 1.0):
        made = create_database(sources(6), DatabaseOptions(tolerance_mm=tolerance)).database
        for number, entry in enumerate(made.entries):
            face = source(number)()
            np.testing.assert_allclose(made.neutrals()[number], face.points, atol=1e-9)
            off = [np.linalg.norm(made.deltas(entry.name)[name] - face.deltas[name], axis=1) for name in SHAPES]
            assert entry.stored_error is not None
            assert np.sqrt(np.square(off).mean(axis=1)).max() <= tolerance + 1e-6
            assert np.max(off) == pytest.approx(entry.stored_error.max_mm, abs=1e-5)
            assert np.sqrt(np.square(off).mean()) == pytest.approx(entry.stored_error.rms_mm, abs=1e-5)
    assert made.expressions is not None
    assert len(made.expressions.basis) < 6 * len(SHAPES)


@pytest.mark.parametrize("parts", [(4, 1), (4, 1, 1, 1), (2, 5)])
def test_adding_faces_through_files_is_starting_over(parts: tuple[int, ...], tmp_path: Path) -> None:
    people = sources(sum(parts))
    path = tmp_path / "faces.fpdb"
    save_database(create_database(people[: parts[0]], EXACT).database, path)
    done = parts[0]
    for count in parts[1:]:
        save_database(add_faces(load_database(path), people[done : done + count]).database, path)
        done += count
    again = create_database(people, EXACT).database
    check_same(load_database(path), again)
    assert load_database(path).version == len(parts)
    assert [update.verb for update in load_database(path).history] == ["create", *["add"] * (len(parts) - 1)]
    model, expected = load_database(path).expressions, again.expressions
    assert model is not None
    assert expected is not None
    stranger = source(99)()
    known = {"jawOpen": stranger.points + stranger.deltas["jawOpen"]}
    found = model.shapes(model.identity_from(known, stranger.points))
    np.testing.assert_allclose(found, expected.shapes(expected.identity_from(known, stranger.points)), atol=1e-3)


@pytest.mark.parametrize("gone", [(0,), (4,), (1, 3), (0, 1, 2)])
def test_removing_faces_through_files_is_never_having_had_them(gone: tuple[int, ...], tmp_path: Path) -> None:
    path = tmp_path / "faces.fpdb"
    save_database(create_database(sources(5), EXACT).database, path)
    made = remove_faces(load_database(path), [f"p{number}" for number in gone])
    assert made.warnings == ()
    save_database(made.database, path)
    found = load_database(path)
    again = create_database([source(number) for number in range(5) if number not in gone], EXACT).database
    check_same(found, again)
    assert [(update.verb, len(update.entries)) for update in found.history] == [("create", 5), ("remove", len(gone))]
    save_database(add_faces(found, [source(number) for number in gone]).database, path)
    for entry, points in zip(load_database(path).entries, load_database(path).neutrals(), strict=True):
        np.testing.assert_allclose(points, source(int(entry.name[1:]))().points, atol=1e-3)
    model, expected = found.expressions, again.expressions
    assert model is not None
    assert expected is not None
    stranger = source(99)()
    known = {"jawOpen": stranger.points + stranger.deltas["jawOpen"]}
    shapes = model.shapes(model.identity_from(known, stranger.points))
    np.testing.assert_allclose(shapes, expected.shapes(expected.identity_from(known, stranger.points)), atol=2e-3)


def test_nothing_of_who_was_removed_stays_in_the_basis() -> None:
    first = create_database([source(0), source(1, shapes=("jawOpen",))], EXACT).database
    made = remove_faces(add_faces(first, [source(2, shapes=("jawOpen",))]).database, ["p0"]).database
    assert made.expressions is not None
    assert len(made.expressions.basis) == 2
    assert "p0" not in str(made.entries)


def test_removing_who_has_shapes_or_lacks_them() -> None:
    bare = source(3, shapes=())
    made = remove_faces(create_database([source(0), bare, source(1)], EXACT).database, ["p0"])
    check_same(made.database, create_database([bare, source(1)], EXACT).database)
    both = create_database([bare, source(0), source(4, shapes=())], EXACT).database
    without = remove_faces(both, ["p0"])
    assert without.database.expressions is None
    assert "no shapes" in without.warnings[0]
    check_same(without.database, create_database([bare, source(4, shapes=())], EXACT).database)
    some = create_database([source(0), source(1, shapes=("jawOpen",)), source(2)], EXACT).database
    left = remove_faces(some, ["p1"])
    assert left.database.shapes == ("jawOpen",)
    assert "no face lacks browInnerUp, mouthSmileLeft any more" in left.warnings[0]


def test_units_and_axes_are_honoured() -> None:
    made = create_database([source(0), source(1, units=0.001)], EXACT).database
    np.testing.assert_allclose(made.neutrals()[1], whole_face(person(1), "p1").points, atol=1e-9)
    upright = person(2)
    turned = replace(
        upright,
        up_axis="Z",
        meshes=tuple(
            replace(
                mesh,
                points=mesh.points[:, [0, 2, 1]] * [1, -1, 1],
                blendshapes=tuple(
                    replace(shape, offsets=shape.offsets[:, [0, 2, 1]] * [1, -1, 1]) for shape in mesh.blendshapes
                ),
            )
            for mesh in upright.meshes
        ),
    )
    one, other = whole_face(upright, "p"), whole_face(turned, "p")
    np.testing.assert_allclose(one.points, other.points, atol=1e-12)
    np.testing.assert_allclose(one.deltas["jawOpen"], other.deltas["jawOpen"], atol=1e-12)


def test_meshes_in_another_order_are_the_same_face() -> None:
    base, other = person(0), person(1)
    swapped = replace(other, meshes=other.meshes[::-1])
    topology = whole_face(base, "p0").topology
    np.testing.assert_array_equal(whole_face(swapped, "x", topology).points, whole_face(other, "x").points)


def test_a_shape_that_a_face_lacks_is_left_out_and_said() -> None:
    people = [source(0), source(1, shapes=("jawOpen", "browInnerUp")), source(2)]
    made = create_database(people, EXACT)
    assert made.database.shapes == ("jawOpen", "browInnerUp")
    assert made.database.left_out == {"mouthSmileLeft": ("p1",)}
    assert any("mouthSmileLeft (p1)" in line for line in made.warnings)
    assert made.database.shape_meshes["jawOpen"] == ("Head", "Teeth")


def test_a_face_that_lacks_a_shape_is_refused_or_the_shape_goes() -> None:
    made = create_database(sources(3), EXACT).database
    lacking = source(3, shapes=("jawOpen",))
    with pytest.raises(InputError, match="p3: lacks mouthSmileLeft, browInnerUp"):
        add_faces(made, [lacking])
    grown = add_faces(made, [lacking], AddOptions(drop_shapes=True)).database
    assert grown.history[-1].dropped == ("mouthSmileLeft", "browInnerUp")
    check_same(grown, create_database([*sources(3), lacking], EXACT).database)


def test_faces_without_shapes_enter_the_identity_model_alone() -> None:
    people = [source(0, shapes=()), source(1), source(2, shapes=()), source(3)]
    made = create_database(people, EXACT)
    model = made.database.expressions
    assert model is not None
    assert model.count == 2
    assert made.database.identity.count == 4
    assert any("p0: has no shapes" in line for line in made.warnings)
    bare = create_database([people[0], people[2]], EXACT).database
    assert bare.expressions is None
    grown = add_faces(bare, [people[1], people[3]]).database
    again = create_database([people[0], people[2], people[1], people[3]], EXACT).database
    check_same(grown, again)


def test_a_mesh_that_stays_still_is_said() -> None:
    face = person(1)
    still = replace(face, meshes=(face.meshes[0], replace(face.meshes[1], blendshapes=())))
    made = create_database([source(0), lambda: whole_face(still, "still")], EXACT)
    assert made.warnings == ("still: meshes that stay still, unlike in other faces: jawOpen (Teeth)",)


def moved(parts: FaceParts, scale: float, shift: float) -> FaceParts:
    meshes = tuple(replace(mesh, points=mesh.points * scale + shift) for mesh in parts.meshes)
    return replace(parts, meshes=meshes)


def test_what_can_t_come_is_refused() -> None:
    made = create_database(sources(3), EXACT).database
    copy = lambda: replace(source(1)(), name="copy")  # noqa: E731
    with pytest.raises(InputError, match="copy: is the same face as p1"):
        add_faces(made, [copy])
    with pytest.raises(InputError, match="p1: a face of that name"):
        add_faces(made, [lambda: replace(source(8)(), name="p1")])
    with pytest.raises(InputError, match="same face as p5"):
        add_faces(made, [source(5), lambda: replace(source(5)(), name="again")])
    with pytest.raises(InputError, match=r"9\.99 times as large"):
        add_faces(made, [lambda: whole_face(moved(person(4), 10.0, 0.0), "large")])
    with pytest.raises(InputError, match="stands 1732 mm"):
        add_faces(made, [lambda: whole_face(moved(person(4), 1.0, 100.0), "far")])
    with pytest.raises(InputError, match="1 face, expected 2"):
        create_database(sources(1))
    with pytest.raises(InputError, match="no face, expected 1"):
        add_faces(made, [])
    other = person(4)
    with pytest.raises(TopologyError, match="no mesh 'Teeth'"):
        whole_face(replace(other, meshes=other.meshes[:1]), "bald", made.topology, "faces.fpdb")
    broken = Blendshape(name="jawOpen", point_indices=np.arange(1, dtype=np.int32), offsets=np.full((1, 3), np.nan))
    bad = replace(other, meshes=(replace(other.meshes[0], blendshapes=(broken,)), other.meshes[1]))
    with pytest.raises(InputError, match="bad -> jawOpen: NaN"):
        add_faces(made, [lambda: whole_face(bad, "bad")])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"surface_mean_mm": 0.31}, "mean surface distance 0.31 mm, expected at most 0.3"),
        ({"surface_p95_mm": 1.5}, "95th percentile of the surface distance 1.5 mm, expected at most 1"),
        ({"coverage": 0.5}, "coverage 0.5, expected at least 0.6"),
        ({"flipped_triangles": 21}, "flipped triangles 21, expected at most 20"),
    ],
)
def test_the_gate_refuses_each_miss_and_says_why(change: dict[str, float], reason: str) -> None:
    made = create_database(sources(3), EXACT).database
    add_faces(made, [source(4)], qualities={"p4": GOOD})
    bad = replace(GOOD, **change)
    with pytest.raises(InputError, match=f"p4: refused: {reason}"):
        add_faces(made, [source(4)], qualities={"p4": bad})
    forced = add_faces(made, [source(4)], AddOptions(ignore_quality=True), qualities={"p4": bad})
    assert forced.database.history[-1].ignored == (f"p4: {reason}{' mm' if 'mm' in reason else ''}",) or any(
        reason in line for line in forced.database.history[-1].ignored
    )
    assert forced.database.entries[-1].quality == bad


def test_measures_of_nobody_or_of_no_sense_are_refused() -> None:
    made = create_database(sources(3), EXACT).database
    with pytest.raises(InputError, match="quality -> p9"):
        add_faces(made, [source(4)], qualities={"p9": GOOD})
    for bad in ({}, {"coverage": 1.0}, {**vars(GOOD), "coverage": 2.0}, {**vars(GOOD), "surface_mean_mm": "0"}, [1], 5):
        with pytest.raises(InputError, match=r"^report.json"):
            quality_from(bad, "report.json")
    assert quality_from({"quality": vars(GOOD), "more": 1}, "report.json") == GOOD


def test_a_file_comes_back_and_the_same_database_is_the_same_bytes(tmp_path: Path) -> None:
    made = add_faces(create_database(sources(4)).database, [source(7)], qualities={"p7": GOOD}).database
    save_database(made, tmp_path / "a.fpdb")
    read = load_database(tmp_path / "a.fpdb")
    assert read.entries == made.entries
    assert read.history == made.history
    assert read.topology.digest == made.topology.digest
    check_same(read, made)
    save_database(read, tmp_path / "b.fpdb")
    again = add_faces(create_database(sources(4)).database, [source(7)], qualities={"p7": GOOD}).database
    save_database(again, tmp_path / "c.fpdb")
    first = (tmp_path / "a.fpdb").read_bytes()
    assert first == (tmp_path / "b.fpdb").read_bytes() == (tmp_path / "c.fpdb").read_bytes()


def test_a_header_reads_as_safetensors(tmp_path: Path) -> None:
    """By the format's own words: a size, JSON, then arrays at the offsets that it states."""
    made = create_database(sources(3)).database
    save_database(made, tmp_path / "a.fpdb")
    data = (tmp_path / "a.fpdb").read_bytes()
    size = int.from_bytes(data[:8], "little")
    head = json.loads(data[8 : 8 + size])
    place = head["identity/mean"]
    start, end = place["data_offsets"]
    mean = np.frombuffer(data[8 + size :][start:end], "<f4").reshape(place["shape"])
    np.testing.assert_allclose(mean, made.identity.mean, rtol=1e-6)
    assert all(isinstance(text, str) for text in head["__metadata__"].values())


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("database") / "small.fpdb"
    save_database(create_database(sources(3), DatabaseOptions(tolerance_mm=5.0)).database, path)
    return path


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_is_refused_in_one_line(small: Path, data: st.DataObject) -> None:
    whole = small.read_bytes()
    harmed = small.with_name("harmed.fpdb")
    content = data.draw(damaged(whole))
    harmed.write_bytes(content)
    assert content == whole or refused(lambda: load_database(harmed), harmed) is not None


@pytest.mark.parametrize("content", [{"a": "0" * 64}, {"sha256": "0" * 64}])
def test_content_that_looks_like_an_open_sum_is_kept(tmp_path: Path, content: dict[str, str]) -> None:
    write_arrays(tmp_path / "a.fpdb", FORMAT, content, {"x": np.ones(3)})
    assert read_arrays(tmp_path / "a.fpdb", FORMAT).content == content


ARRAYS = ("identity/components", "identity/coefficients", "expressions/core", "topology/0/indices", "topology/points")


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_files_with_sound_sums_and_wrong_content_are_refused_or_read(small: Path, data: st.DataObject) -> None:
    """What someone might make by hand: nothing but our own errors, and what is read can be used."""
    arrays, content = read_arrays(small, FORMAT)
    changed, text = dict(arrays), dict(content)
    if data.draw(st.booleans()):
        name = data.draw(st.sampled_from(ARRAYS))
        array = changed.pop(name)
        kind = data.draw(st.sampled_from(["gone", "shorter", "axis", "negative", "type"]))
        if kind != "gone":
            replaced = {"shorter": array[:-1], "axis": array[None], "negative": -array - 1}.get(kind)
            changed[name] = (
                array.astype(np.float64 if array.dtype.kind == "i" else np.int32)
                if kind == "type"
                else (np.ascontiguousarray(replaced))
            )
    else:
        name = data.draw(st.sampled_from(sorted(text)))
        junk = st.sampled_from([None, 3, -1, "x", [], {}, [1], ["a", "a"], {"a": 1}, [[1]], True])
        value = text.pop(name)
        if isinstance(value, list) and value and data.draw(st.booleans()):
            text[name] = [data.draw(junk), *value[1:]]
        elif data.draw(st.booleans()):
            text[name] = data.draw(junk)
    harmed = small.with_name("made.fpdb")
    write_arrays(harmed, FORMAT, text, changed)
    if refused(lambda: load_database(harmed), harmed) is None:
        read = load_database(harmed)
        read.neutrals()
        read.deltas(read.entries[0].name)


@pytest.mark.parametrize("lost", ["rms_mm", "p95_mm", "max_mm"])
def test_a_stored_error_that_lacks_a_field_is_refused(small: Path, tmp_path: Path, lost: str) -> None:
    arrays, content = read_arrays(small, FORMAT)
    del content["entries"][1]["stored_error"][lost]
    write_arrays(tmp_path / "a.fpdb", FORMAT, content, arrays)
    with pytest.raises(InputError, match=rf"a.fpdb -> entries -> 1 -> stored_error: no '{lost}'"):
        load_database(tmp_path / "a.fpdb")


def test_other_files_are_refused(tmp_path: Path) -> None:
    for name, data in (("a.fpdb", b""), ("b.fpdb", b"PK\x03\x04" * 50), ("c.fpdb", b"\x02" + b"\0" * 7 + b"{}")):
        (tmp_path / name).write_bytes(data)
        assert refused(lambda name=name: load_database(tmp_path / name), tmp_path / name) is not None
    assert refused(lambda: load_database(tmp_path / "none.fpdb"), tmp_path / "none.fpdb") is not None
    with pytest.raises(InputError, match=r"suffix '.npz', expected .fpdb"):
        load_database(tmp_path / "x.npz")
    write_arrays(tmp_path / "d.fpdb", "facepipe face database 9", {}, {})
    with pytest.raises(InputError, match="database 9', expected facepipe face database 1"):
        load_database(tmp_path / "d.fpdb")


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_an_update_killed_while_it_writes_leaves_the_file_as_it_was(small: Path, tmp_path: Path) -> None:
    path = tmp_path / "faces.fpdb"
    path.write_bytes(small.read_bytes())
    script = f"""
import os, signal, sys
sys.path.insert(0, {str(SUPPORT)!r})
from database_faces import sources
from facepipe.scanning.database import add_faces, load_database, save_database
os.fsync = lambda file: os.kill(os.getpid(), signal.SIGKILL)  # all is written, nothing renamed yet
save_database(add_faces(load_database({str(path)!r}), sources(1, 5)).database, {str(path)!r})
"""
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -signal.SIGKILL
    (temporary,) = tmp_path.glob(".facepipe-*/faces.fpdb")
    assert temporary.stat().st_size > 0
    assert path.read_bytes() == small.read_bytes()
    load_database(path)


def test_a_refused_update_leaves_the_file_as_it_was(small: Path, tmp_path: Path) -> None:
    path = tmp_path / "faces.fpdb"
    path.write_bytes(small.read_bytes())
    with pytest.raises(FacepipeError):
        save_database(add_faces(load_database(path), [source(0)]).database, path)
    database = load_database(path)
    broken = replace(database, coefficients=database.coefficients * np.nan)
    with pytest.raises(InputError, match="NaN"):
        save_database(broken, path)
    assert path.read_bytes() == small.read_bytes()
    assert [one.name for one in tmp_path.iterdir()] == ["faces.fpdb"]


SEEN = (
    *("jawOpen", "mouthSmile_L", "mouthSmile_R", "browInnerUp_L", "browInnerUp_R", "browDown_L", "browDown_R"),
    *("eyeBlink_L", "eyeBlink_R", "mouthPucker", "mouthFunnel", "cheekSquint_L", "cheekSquint_R", "noseSneer_L"),
    *("noseSneer_R", "mouthFrown_L", "mouthFrown_R", "eyeSquint_L", "eyeSquint_R", "mouthLeft", "mouthRight"),
)


@pytest.mark.slow
def test_seen_expressions_show_how_an_actor_makes_others() -> None:
    """Actors with their own ways: from 21 of 53 expressions the others come nearer than by neutral and mean."""
    from scan_actors import Actor, ict_face

    model = ict_face()
    names, triangles = model.names, model.triangles
    topology = Topology(
        names=("Face",),
        points=(len(model.neutral),),
        counts=(np.full(len(triangles), 3, np.int32),),
        indices=(triangles.ravel().astype(np.int32),),
    )

    people = functools.cache(functools.partial(Actor, model=model))

    @functools.cache
    def actor(seed: int) -> WholeFace:
        person = people(seed)
        deltas = {name: person.shape(name).astype(np.float32) for name in names}
        return WholeFace(name=f"a{seed}", topology=topology, points=person.neutral, deltas=deltas)

    database = create_database([functools.partial(actor, seed) for seed in range(100, 124)]).database
    actor.cache_clear()
    people.cache_clear()
    assert database.expressions is not None
    hidden = [name for name in names if name not in SEEN]
    rows = []
    for seed in range(130, 136):
        one, mean = actor(seed), database.expressions.shapes(np.zeros(23))
        known = {name: one.points + one.deltas[name] for name in SEEN}
        alone = database.expressions.shapes(database.expressions.identity_from({}, one.points))
        plain = database.expressions.shapes(database.expressions.identity_from(known, one.points))
        carried = dict(zip(names, carried_mean(database, one.points), strict=True))
        generic = {name: people(seed).transferred(name) for name in hidden}
        guesses = [dict(zip(names, found, strict=True)) for found in (mean, alone, plain)]
        guesses += [carried, generic, predicted_shapes(database, one.points, known)]
        rows.append([_missed(one, guess, hidden) for guess in guesses])
    found = np.array(rows)
    kinds = ("neutral + mean expression", "vector from the neutral", "vector from 21 expressions", "mean carried over")
    for kind, (rms, face) in zip((*kinds, "generic transfer", "predicted"), found.mean(axis=0), strict=True):
        print(f"{kind:28} {rms:.3f} of the RMS, {face:.3f} mm in the face")
    mean, alone, plain, carried, generic, predicted = found.transpose(1, 0, 2)
    assert (plain[:, 0] < mean[:, 0]).mean() > 0.8
    assert plain[:, 0].mean() < 0.95 * mean[:, 0].mean()
    assert (predicted < mean).all()
    assert (predicted.mean(axis=0) < [0.9 * mean[:, 0].mean(), 0.85 * mean[:, 1].mean()]).all()
    assert predicted[:, 0].mean() < 0.95 * carried[:, 0].mean()


def _missed(face: WholeFace, guess: Mapping[str, np.ndarray], names: Sequence[str]) -> tuple[float, float]:
    """RMS error over the RMS of the deltas, and mean distance in the face area, millimetres."""
    own = np.stack([face.deltas[name] for name in names]).astype(np.float64)
    off = np.stack([guess[name] for name in names]) - own
    return float(np.sqrt(np.square(off).sum() / np.square(own).sum())), float(np.linalg.norm(off, axis=2).mean())


def test_predicted_shapes_are_the_mean_s_on_the_mean_face() -> None:
    database = create_database(sources(5), EXACT).database
    assert database.expressions is not None
    mean = database.expressions.shapes(np.zeros(4))
    neutral = database.expressions.neutral(np.zeros(4))
    carried = carried_mean(database, neutral)
    np.testing.assert_allclose(carried, mean, atol=0.05)
    known = {name: neutral + delta for name, delta in zip(SHAPES, carried, strict=True)}
    for name, delta in predicted_shapes(database, neutral, known).items():
        np.testing.assert_allclose(delta, carried[SHAPES.index(name)], atol=1e-6)
    with pytest.raises(InputError, match="no expression 'wink'"):
        predicted_shapes(database, neutral, {"wink": neutral})
    with pytest.raises(InputError, match="has no expressions"):
        predicted_shapes(create_database([source(0, shapes=()), source(1, shapes=())]).database, neutral)


@pytest.mark.parametrize("face_names", [("a", "a"), ("a", " ")])
def test_names_of_files_are_given_and_differ(face_names: tuple[str, str]) -> None:
    paths = [Path("one.usda"), Path("other.usda")]
    with pytest.raises(InputError, match="empty or twice"):
        stage_sources(paths, face_names)
    assert [each.name for each in stage_sources(paths, ("a", "b"))] == ["a", "b"]
