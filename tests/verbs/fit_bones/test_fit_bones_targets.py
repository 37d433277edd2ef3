"""Targets of bone fits: every kind gives the points that it was made of, and mistakes say what they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bone_faces import (
    clip,
    head,
    in_metres_z_up,
    pose,
    save_cache,
    save_loose_clip,
    save_obj,
    saved,
    sculpt,
    skeletonless,
    small,
)
from faces import replace_mesh
from pxr import Usd, UsdGeom

import facepipe
from facepipe import registry
from facepipe.core.errors import FacepipeError, InputError
from facepipe.importers import load, obj
from facepipe.parts import FaceParts
from facepipe.rig import build
from facepipe.stage import Face
from facepipe.verbs.fit_bones import FitBones, Target, read_targets

ABOUT = 2e-6  # units: float32 of the files


def loader(path: Path) -> FaceParts:
    options = obj.Options(meters_per_unit=small().meters_per_unit)
    return load("obj", path, options).parts if path.suffix == ".obj" else load("gltf", path).parts


def one(face: Face, word: object) -> Target:
    (found,) = read_targets(face, [str(word)], loader)
    return found


def posed(parts: FaceParts, seed: int = 1) -> np.ndarray:
    rig = build(parts)
    return rig.evaluate(coefficients=pose(rig, seed))


def rig_face(tmp_path: Path, parts: FaceParts | None = None) -> Face:
    return facepipe.open(saved(parts or small(), tmp_path / "rig.usda"))


def glb(parts: FaceParts, path: Path) -> Path:
    exporter = registry.exporter(path)
    exporter.export(Face.from_parts(parts), path, exporter.Options())
    return path


# --- kinds


def test_blendshapes_by_name_weight_and_all_together(tmp_path: Path) -> None:
    face = rig_face(tmp_path)
    whole, half, *every = read_targets(face, ["jawOpen", "jawOpen=0.5", "shapes"])
    np.testing.assert_array_equal(whole.points, [face.evaluate({"jawOpen": 1.0})])
    np.testing.assert_array_equal(half.points, [face.evaluate({"jawOpen": 0.5})])
    assert [target.name for target in (whole, half, *every)] == [
        "jawOpen",
        "jawOpen_0_5",
        "jawOpen_2",
        "mouthSmileLeft",
    ]
    np.testing.assert_array_equal(every[1].points, [face.evaluate({"mouthSmileLeft": 1.0})])


def test_an_animation_of_the_face_gives_all_its_frames(tmp_path: Path) -> None:
    talk = clip(build(small()))
    face = rig_face(tmp_path, replace(small(), animations=(talk,)))
    found = one(face, "talk")
    expected = [build(small()).evaluate(coefficients=frame) for frame in talk.coefficients]
    np.testing.assert_allclose(found.points, expected, atol=ABOUT)
    np.testing.assert_allclose(found.times, talk.times)


FILES: dict[str, Callable[[FaceParts, Path], object]] = {
    "stage": lambda parts, folder: saved(parts, folder / "t.usdc"),
    "stage in metres, Z up": lambda parts, folder: saved(in_metres_z_up(parts), folder / "t.usda"),
    "obj with objects": lambda parts, folder: save_obj(parts, folder / "t.obj"),
    "obj of one piece": lambda parts, folder: save_obj(parts, folder / "t.obj", objects=False),
    "glb": lambda parts, folder: glb(parts, folder / "t.glb"),
    "gltf": lambda parts, folder: glb(parts, folder / "t.gltf"),
    "stage without a face": lambda parts, folder: save_cache(
        parts, np.concatenate([mesh.points for mesh in parts.meshes])[None], folder / "t.usda", moved=0.5
    ),
}


@pytest.mark.parametrize("kind", FILES)
def test_files_of_the_topology_give_their_points(kind: str, tmp_path: Path) -> None:
    wanted = posed(small())
    file = FILES[kind](sculpt(small(), wanted), tmp_path)
    found = one(rig_face(tmp_path), file)
    np.testing.assert_allclose(found.points, wanted[None], atol=ABOUT)
    assert found.known is None
    assert found.name == "t"


def test_a_real_head_comes_back_from_glb_and_obj(tmp_path: Path) -> None:
    """Quads as triangles, UV seams, ten meshes."""
    wanted = posed(head())
    face = rig_face(tmp_path, head())
    meshes = [
        replace_mesh(mesh, uv_sets=full.uv_sets)
        for mesh, full in zip(sculpt(head(), wanted).meshes, head().meshes, strict=True)
    ]
    made = replace(sculpt(head(), wanted), meshes=tuple(meshes))
    np.testing.assert_allclose(one(face, glb(made, tmp_path / "t.glb")).points[0], wanted, atol=ABOUT)
    (found,) = read_targets(
        face,
        [str(save_obj(made, tmp_path / "t.obj"))],
        lambda path: load("obj", path, obj.Options(meters_per_unit=0.1)).parts,
    )
    np.testing.assert_allclose(found.points[0], wanted, atol=ABOUT)


@pytest.mark.parametrize("suffix", [".obj", ".usda", ".glb"])
def test_meshes_that_a_file_lacks_do_not_count(suffix: str, tmp_path: Path) -> None:
    wanted, path = posed(small()), tmp_path / f"t{suffix}"
    only = sculpt(small(), wanted, ["Head"])
    {".obj": save_obj, ".usda": saved, ".glb": glb}[suffix](only, path)
    found = one(rig_face(tmp_path), path)
    assert found.known is not None
    np.testing.assert_array_equal(found.known, np.arange(len(wanted)) < 36)
    np.testing.assert_allclose(found.points[0, :36], wanted[:36], atol=ABOUT)
    assert found.notes == (f"{path}: lacks meshes, which don't count: Teeth",)


def test_a_single_mesh_of_another_name_is_the_one_that_the_word_names(tmp_path: Path) -> None:
    wanted = posed(small())
    only = sculpt(small(), wanted, ["Teeth"])
    path = save_obj(replace(only, meshes=(replace_mesh(only.meshes[0], name="Cube.001"),)), tmp_path / "t.obj")
    face = rig_face(tmp_path)
    for word in (f"{path}:Teeth", path):  # no other mesh has as many points
        found = one(face, word)
        assert found.known is not None
        np.testing.assert_array_equal(found.known, np.arange(len(wanted)) >= 36)
        np.testing.assert_allclose(found.points[0, 36:], wanted[36:], atol=ABOUT)
    with pytest.raises(FacepipeError, match=r"t.obj -> Head: 9 points, expected 36"):
        one(face, f"{path}:Head")


def test_points_over_time_with_and_without_a_face(tmp_path: Path) -> None:
    rig = build(small())
    wanted = np.stack([rig.evaluate(coefficients=frame) for frame in clip(rig).coefficients])
    face = rig_face(tmp_path)
    found = one(face, save_cache(small(), wanted, tmp_path / "cache.usda", moved=2.0))
    np.testing.assert_allclose(found.points, wanted, atol=ABOUT)
    np.testing.assert_allclose(found.times, np.arange(5) / 10)
    (tmp_path / "over.usda").write_text(
        '#usda 1.0\n(subLayers = [@./rig.usda@]\n timeCodesPerSecond = 10)\nover "Tiny"\n{\nover "Head"\n{\n'
        "point3f[] points.timeSamples = { 0: "
        + str([tuple(map(float, row)) for row in small().meshes[0].points])
        + ", 10: "
        + str([tuple(map(float, row)) for row in small().meshes[0].points + 1.0])
        + "}\n}\n}\n"
    )
    raised = one(face, tmp_path / "over.usda")
    assert raised.times is not None
    np.testing.assert_allclose(raised.times, [0.0, 1.0])
    np.testing.assert_allclose(raised.points[0], face.evaluate(), atol=ABOUT)
    np.testing.assert_allclose(raised.points[1, :36], face.evaluate()[:36] + 1.0, atol=ABOUT)
    np.testing.assert_allclose(raised.points[1, 36:], face.evaluate()[36:], atol=ABOUT)


def test_animations_of_other_stages_whether_they_have_a_face_or_not(tmp_path: Path) -> None:
    rig = build(small())
    talk = clip(rig)
    wanted = np.stack([rig.evaluate(coefficients=frame) for frame in talk.coefficients])
    face = rig_face(tmp_path)
    other = saved(replace(small(), animations=(talk,)), tmp_path / "other.usda")
    for file in (other, save_loose_clip(talk, small(), tmp_path / "clip.usda")):
        found = one(face, f"{file}:talk")
        assert found.name == "talk"
        np.testing.assert_allclose(found.points, wanted, atol=ABOUT)
        np.testing.assert_allclose(found.times, talk.times)


# --- mistakes


def broken(parts: FaceParts, **changes: object) -> FaceParts:
    """The first mesh changed."""
    first, *rest = sculpt(parts, build(parts).evaluate()).meshes
    return replace(FaceParts(), meshes=(replace_mesh(first, **changes), *rest))


def other_corner() -> FaceParts:
    indices = small().meshes[0].face_vertex_indices.copy()
    indices[5] = 9
    return broken(small(), face_vertex_indices=indices)


def fewer_points() -> FaceParts:
    teeth = broken(small()).meshes[1]
    return replace(FaceParts(), meshes=(replace_mesh(teeth, name="Head"), teeth))


def other_names() -> FaceParts:
    meshes = tuple(replace_mesh(mesh, name=f"My{mesh.name}") for mesh in broken(small()).meshes)
    return replace(FaceParts(), meshes=meshes)


def one_point_more() -> FaceParts:
    mesh = broken(small()).meshes[0]
    points = np.concatenate([mesh.points, [[0.0, 0.0, 5.0]]])
    return replace(FaceParts(), meshes=(replace_mesh(mesh, points=points, name="Sculpt"),))


TOPOLOGIES = {
    "corner": (other_corner, "Head: face 1 uses point 9, expected point 2 as in Tiny"),
    "points": (fewer_points, "Head: 9 points, expected 36 as in Tiny"),
    "names": (other_names, "meshes MyHead, MyTeeth, expected some of Head, Teeth"),
    "one": (one_point_more, "points is none of Head, Teeth, expected FILE:MESH to say which"),
}


@pytest.mark.parametrize("kind", TOPOLOGIES)
def test_another_topology_is_refused_with_its_first_difference(kind: str, tmp_path: Path) -> None:
    make, message = TOPOLOGIES[kind]
    path = saved(skeletonless(make()), tmp_path / "t.usda")
    with pytest.raises(FacepipeError) as refusal:
        one(rig_face(tmp_path), path)
    assert str(refusal.value).startswith(str(path))
    assert message in str(refusal.value)


def test_objs_of_another_topology_are_refused(tmp_path: Path) -> None:
    face = rig_face(tmp_path)
    for kind in ("corner", "names"):
        path = save_obj(TOPOLOGIES[kind][0](), tmp_path / f"{kind}.obj")
        with pytest.raises(FacepipeError) as refusal:
            one(face, path)
        assert TOPOLOGIES[kind][1] in str(refusal.value)


def test_triangles_of_another_topology_are_refused(tmp_path: Path) -> None:
    grid = sculpt(small(), build(small()).evaluate())
    first = grid.meshes[0]
    swapped = first.face_vertex_indices.copy()
    swapped[5] = 9  # as many triangles, other edges
    path = glb(replace(grid, meshes=(replace_mesh(first, face_vertex_indices=swapped),)), tmp_path / "t.glb")
    with pytest.raises(FacepipeError, match=r"t.glb -> Head: face 1 uses point 9, expected point 2 as in Tiny"):
        one(rig_face(tmp_path), path)
    path = glb(replace(grid, meshes=(replace_mesh(grid.meshes[1], name="Head"), grid.meshes[1])), tmp_path / "u.glb")
    with pytest.raises(FacepipeError, match=r"u.glb -> Head: 9 points, expected 36 as in Tiny"):
        one(rig_face(tmp_path), path)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("frown", "target frown: no such blendshape, animation or file type, expected one of jawOpen"),
        ("jawOpen=x", "target jawOpen=x: expected SHAPE=WEIGHT with a finite number"),
        ("jawOpen=nan", "target jawOpen=nan: expected SHAPE=WEIGHT"),
        ("jawOpen=1e308", "target jawOpen=1e308: expected SHAPE=WEIGHT with a finite number of at most 1e+06"),
        ("frown=1", "target frown=1: no such blendshape"),
        ("none.usda", "none.usda: no such file"),
        ("none.obj", "none.obj"),
        ("t.dae", "target t.dae: no such blendshape, animation or file type"),
        ("rig.usda:talk", "rig.usda: no animation 'talk'; there are none"),
        ("part.obj:Nose", "part.obj:Nose: the face has no mesh 'Nose', expected one of Head, Teeth"),
    ],
)
def test_words_that_name_nothing(word: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    face = rig_face(tmp_path)
    save_obj(sculpt(small(), build(small()).evaluate(), ["Head"]), Path("part.obj"))
    with pytest.raises(InputError) as refusal:
        one(face, word)
    assert str(refusal.value).startswith(message)


def test_ambiguous_and_double_words_and_shapes_of_none(tmp_path: Path) -> None:
    named = replace(clip(build(small())), name="jawOpen")
    face = Face.from_parts(replace(small(), animations=(named,)))
    with pytest.raises(InputError, match="is a blendshape and an animation, expected jawOpen=1"):
        read_targets(face, ["jawOpen"])
    with pytest.raises(InputError, match="target jawOpen=1: given twice"):
        read_targets(face, ["jawOpen=1", "jawOpen=1"])
    with pytest.raises(InputError, match="targets: none given"):
        read_targets(face, [])
    with pytest.raises(InputError, match=r"target shapes: .* has no blendshapes"):
        read_targets(Face.from_parts(skeletonless(small())), ["shapes"])
    with pytest.raises(InputError, match=r"suffix '\.obj' needs an importer"):
        read_targets(face, ["t.obj"])


def test_joints_of_a_clip_that_the_face_lacks(tmp_path: Path) -> None:
    talk = clip(build(small()))
    file = save_loose_clip(talk, small(), tmp_path / "clip.usda")
    text = file.read_text().replace('"root/jaw/lip"', '"root/jaw/tongue"')
    file.write_text(text)
    with pytest.raises(InputError, match=r"clip.usda -> talk: 'root/jaw/tongue' is not a joint of the skeleton"):
        one(rig_face(tmp_path), f"{file}:talk")


ROOT = {
    "joints": 'uniform token[] joints = ["root"]',
    "translations": "float3[] translations = [(0, 0, 0)]",
    "rotations": "quatf[] rotations = [(1, 0, 0, 0)]",
    "scales": "half3[] scales = [(1, 1, 1)]",
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"translations": "float3[] translations = [(nan, 0, 0)]"}, "/A -> translations: NaN or infinity"),
        ({"scales": "half3[] scales = [(inf, 1, 1)]"}, "/A -> scales: NaN or infinity"),
        ({"rotations": "quatf[] rotations = [(0, 0, 0, 0)]"}, "A -> root: a rotation quaternion of length 0"),
        ({"joints": 'uniform token[] joints = ["nose"]'}, "A: 'nose' is not a joint of the skeleton"),
        ({"joints": 'uniform token[] joints = ["root", "root"]'}, "1 values at a time sample, expected 2"),
        (
            {
                "joints": 'uniform token[] joints = ["root", "root"]',
                "translations": "float3[] translations = [(0, 0, 0), (1, 1, 1)]",
                "rotations": "",
                "scales": "",
            },
            "/A: 'root' twice, expected each joint and shape once",
        ),
        (
            {"translations": "float3[] translations.timeSamples = {1: [(0, 0, 0)], 2: []}"},
            "/A.translations: 0 values at a time sample, expected 1",
        ),
        (
            {"more": 'uniform token[] blendShapes = ["frown"]\nfloat[] blendShapeWeights = [1]'},
            "no shape 'frown', expected one of jawOpen",
        ),
    ],
)
def test_clips_that_make_no_sense_are_refused(change: dict[str, str], message: str, tmp_path: Path) -> None:
    lines = "\n".join({**ROOT, **change}.values())
    (tmp_path / "clip.usda").write_text(f'#usda 1.0\ndef SkelAnimation "A"\n{{\n{lines}\n}}\n')
    with pytest.raises(FacepipeError) as refusal:
        one(rig_face(tmp_path), f"{tmp_path / 'clip.usda'}:A")
    assert str(refusal.value).startswith(str(tmp_path / "clip.usda"))
    assert message in str(refusal.value)


def test_nan_and_changing_counts_in_caches_are_refused(tmp_path: Path) -> None:
    rig = build(small())
    frames = np.stack([rig.evaluate()] * 3)
    frames[1, 4, 2] = np.nan
    face = rig_face(tmp_path)
    with pytest.raises(InputError, match=r"</?.*Head.*NaN or infinity at time code 1|Head: points hold NaN .*code 1"):
        one(face, save_cache(small(), frames, tmp_path / "nan.usda"))
    file = save_cache(small(), frames[[0, 2]], tmp_path / "short.usda")
    stage = Usd.Stage.Open(str(file))
    UsdGeom.Mesh(stage.GetPrimAtPath("/Cache/Head")).GetPointsAttr().Set([(0, 0, 0)] * 35, 1)
    stage.GetRootLayer().Save()
    with pytest.raises(FacepipeError, match="35 points at a time sample, expected 36 as at the first"):
        one(face, file)


def changed_cache(tmp_path: Path, change: Callable[[Usd.Stage], object]) -> Path:
    """The face at rest over three samples, with `change` made to the stage."""
    file = save_cache(small(), np.stack([build(small()).evaluate()] * 3), tmp_path / "t.usda")
    stage = Usd.Stage.Open(str(file))
    change(stage)
    stage.GetRootLayer().Save()
    return file


def other_faces_later(stage: Usd.Stage) -> None:
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath("/Cache/Head")).GetFaceVertexIndicesAttr()
    first = list(attribute.Get())
    attribute.Clear()
    attribute.Set(first, 0)
    attribute.Set([first[1], first[0], *first[2:]], 1)


def scaled(factor: float) -> Callable[[Usd.Stage], object]:
    precision = UsdGeom.XformOp.PrecisionDouble
    return lambda stage: UsdGeom.Xformable(stage.GetPrimAtPath("/Cache")).AddScaleOp(precision).Set((factor, 1, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (other_faces_later, "/Cache/Head: faceVertexIndices change over time, expected the same faces throughout"),
        (lambda stage: UsdGeom.SetStageMetersPerUnit(stage, 0.0), "t.usda: metersPerUnit 0, expected a length above 0"),
        (lambda stage: UsdGeom.SetStageMetersPerUnit(stage, -1.0), "t.usda: metersPerUnit -1, expected a length"),
        (lambda stage: UsdGeom.SetStageMetersPerUnit(stage, 1e300), "t.usda: metersPerUnit 1e[+]300, expected a"),
        (lambda stage: UsdGeom.SetStageMetersPerUnit(stage, np.nan), "t.usda: metersPerUnit nan, expected a length"),
        (scaled(1e300), "target t: a coordinate of 2.5e[+]300, expected at most 1e[+]12"),
        (scaled(np.nan), "target t: NaN or infinity at frame 0"),
        (lambda stage: UsdGeom.Mesh(stage.GetPrimAtPath("/Cache/Head")).GetPointsAttr().Clear(), "don't fit 0 points"),
    ],
)
def test_caches_that_make_no_sense_are_refused(
    change: Callable[[Usd.Stage], object], message: str, tmp_path: Path
) -> None:
    file = changed_cache(tmp_path, change)
    with pytest.raises(FacepipeError, match=message):
        one(rig_face(tmp_path), file)


@pytest.mark.parametrize("factor", [100.0, 0.01])
def test_targets_of_another_size_are_reported(factor: float, tmp_path: Path) -> None:
    """A sculpt in other units than it says; points that don't count have any size."""
    face = rig_face(tmp_path)
    wanted = posed(small())
    goal = Target(name="t", points=factor * face.evaluate()[None])
    report = FitBones(max_iterations=1, rounds=0)(face, [goal])
    assert report.warnings[0] == f"t: is {factor:g} times as large as the face: are its units right?"
    far = Target(name="t", points=1e6 * wanted[None])
    with pytest.raises(InputError, match=r"target t: points .* times the face's size away, expected less than 1000"):
        FitBones()(face, [far])
    known = np.arange(45) < 36
    mixed = Target(name="t", points=np.where(known[:, None], wanted, 1e9 * wanted)[None], known=known)
    with pytest.raises(InputError, match="its stage has changed since it was read, expected a new Face of it"):
        FitBones()(face, [goal])
    report = FitBones(max_iterations=1, rounds=0)(Face(face.stage), [mixed])
    assert not any("units" in line for line in report.warnings)


@pytest.mark.parametrize(
    ("points", "more", "message"),
    [
        (np.full((1, 45, 3), np.nan), {}, "target t: NaN or infinity, expected finite points"),
        (np.full((2, 45, 3), np.inf), {"times": np.arange(2.0)}, "target t: NaN or infinity at frame 0"),
        (np.zeros((2, 45, 3)), {}, r"target t: points \(2, 45, 3\), expected \(1, n, 3\)"),
        (np.zeros((45, 3)), {}, "target t: points"),
        (np.zeros((1, 45, 3)), {"known": np.ones(44, bool)}, r"target t: known \(44,\), expected \(45,\)"),
    ],
)
def test_targets_of_python_are_checked(points: np.ndarray, more: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Target(name="t", points=points, **more)
