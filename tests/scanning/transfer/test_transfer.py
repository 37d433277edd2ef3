"""Heads of others get shapes and keep all that they had; what can't be done is one line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_head
from command_line import done, failed, run
from node import three_load, validate
from parts_differences import differences
from pxr import Gf, Usd, UsdGeom

import facepipe
from facepipe.core.errors import FitError, InputError
from facepipe.geometry.polygons import point_triangles, triangle_normals
from facepipe.heads import make
from facepipe.importers import load, read_face
from facepipe.parts import Blendshape, FaceParts, Inbetween, Mesh
from facepipe.rig.conventions import ARKIT_SHAPES
from facepipe.scanning.transfer.cut import with_cut_mouth
from facepipe.scanning.transfer.head import Head, made_head
from facepipe.scanning.transfer.transfer import skin_lines, wanted_shapes
from facepipe.stage import save_parts
from facepipe.verbs.whole_faces import whole_face

Capsys = pytest.CaptureFixture[str]
KEPT = "mouthSmileLeft"  # the shape that the heads come with
FEW = ("jawOpen", "eyeBlinkLeft")
_FRAME = ("landmarks", "regions", "anchor", "point_subsets")


def bare(parts: FaceParts, *shapes: str) -> FaceParts:
    """A head as other tools make them: with these shapes alone, and nothing that facepipe knows of faces."""
    meshes = tuple(
        replace(
            mesh,
            blendshapes=tuple(shape for shape in mesh.blendshapes if shape.name in shapes),
            landmarks={},
            regions={},
            point_subsets={},
            anchor=None,
        )
        for mesh in parts.meshes
    )
    return replace(parts, meshes=meshes, sliders=())


def marks_of(parts: FaceParts) -> np.ndarray:
    head = parts.meshes[0]
    return np.asarray(head.points, np.float64)[head.landmarks["multipie68"].indices]


def put_marks(path: Path, points: np.ndarray, known: int = 68) -> Path:
    rows = [row if number < known else None for number, row in enumerate(points.tolist())]
    path.write_text(json.dumps({"points": rows}))
    return path


def own_of(result: FaceParts, source: FaceParts) -> FaceParts:
    """The result without what a transfer adds."""
    meshes = []
    for mesh, before in zip(result.meshes, source.meshes, strict=True):
        names = {shape.name for shape in before.blendshapes}
        shapes = tuple(shape for shape in mesh.blendshapes if shape.name in names)
        meshes.append(replace(mesh, blendshapes=shapes, **{name: getattr(before, name) for name in _FRAME}))
    return replace(result, meshes=tuple(meshes), sliders=source.sliders, recipe=source.recipe)


@pytest.fixture(scope="module")
def small() -> FaceParts:
    return small_head.make()


def test_landmarks_in_another_unit_are_named_with_the_one_that_fits(small: FaceParts, tmp_path: Path) -> None:
    marks = put_marks(tmp_path / "marks.json", 10.0 * marks_of(small))
    with pytest.raises(InputError, match=r"lie .* mm from it, expected on it, .*; taken in mm they would"):
        Head.of(bare(small), "head", marks)


def test_landmarks_beside_the_head_are_named_with_how_far(small: FaceParts, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"lie \d.*e\+03 mm from it, expected on it") as refused:
        Head.of(bare(small), "head", put_marks(tmp_path / "marks.json", 200.0 + marks_of(small)))
    assert "taken in" not in str(refused.value)


def test_too_few_landmarks_are_counted(small: FaceParts, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="5 of 68 are known, expected 6 or more"):
        Head.of(bare(small), "head", put_marks(tmp_path / "marks.json", marks_of(small), known=5))


def test_landmarks_may_be_off_and_in_part_unknown(small: FaceParts, tmp_path: Path) -> None:
    off = np.random.default_rng(0).normal(0.0, 0.3, (68, 3))  # 3 mm
    head = Head.of(bare(small), "head", put_marks(tmp_path / "marks.json", marks_of(small) + off, known=30))
    assert head.landmarks.known.sum() == 30
    assert head.source == "marks.json"


@pytest.mark.parametrize("coarser", [False, True])
def test_levels_of_detail_are_not_sewn_to_the_skin(small: FaceParts, tmp_path: Path, *, coarser: bool) -> None:
    """One that has the same border: all of the finest is skin, wherever it is in the file, and nothing else."""
    head = bare(small)
    skin = head.meshes[0]
    triangles = point_triangles(skin.face_vertex_counts, skin.face_vertex_indices)
    again = replace(skin, name="Head_LOD1")
    if coarser:
        kept = triangles[np.arange(len(triangles)) % 9 > 0]
        again = replace(again, face_vertex_counts=np.full(len(kept), 3), face_vertex_indices=kept.ravel())
    marks = put_marks(tmp_path / "marks.json", marks_of(small))
    alone = Head.of(head, "head", marks)
    meshes = (again, *head.meshes) if coarser else (*head.meshes, again)
    both = Head.of(replace(head, meshes=meshes), "head", marks)
    assert len(both.skin()) == len(alone.skin())
    assert {both.parts.meshes[number].name for number in both.surface.mesh[both.skin()]} == {skin.name}


def test_the_name_of_the_mesh_with_the_skin_says_nothing_of_its_pieces(small: FaceParts, tmp_path: Path) -> None:
    skin, *others = bare(small).meshes
    head = replace(bare(small), meshes=(replace(skin, name="Brown_teeth"), *others))
    found = Head.of(head, "head", put_marks(tmp_path / "marks.json", marks_of(small)))
    names = found.hints().name
    assert names is not None
    assert set(names[found.surface.mesh == 0]) == {-1}
    assert np.array_equal(names[found.surface.mesh > 0], found.surface.mesh[found.surface.mesh > 0])


def test_inward_triangles_are_turned_and_said(small: FaceParts, tmp_path: Path) -> None:
    head = bare(small)
    skin = head.meshes[0]
    triangles = point_triangles(skin.face_vertex_counts, skin.face_vertex_indices)
    turned = replace(
        skin, face_vertex_counts=np.full(len(triangles), 3), face_vertex_indices=triangles[:, ::-1].ravel()
    )
    marks = put_marks(tmp_path / "marks.json", marks_of(small))
    usual = Head.of(head, "head", marks)
    inside_out = Head.of(replace(head, meshes=(turned, *head.meshes[1:])), "head", marks)
    assert skin_lines(usual, usual.skin()) == []
    what = f"{len(triangles)} triangles face inward: they are taken as turned, and stay as they are"
    assert skin_lines(inside_out, inside_out.skin()) == [what]
    normals = [triangle_normals(one.sewn, one.surface.triangles).sum(axis=0) for one in (usual, inside_out)]
    assert np.allclose(*normals, atol=1e-6)


def test_triangles_of_a_mirrored_node_face_outward(small: FaceParts, tmp_path: Path) -> None:
    mirror, meshes = np.diag([-1.0, 1.0, 1.0, 1.0]), []
    for mesh in bare(small).meshes:
        corners = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)[:, ::-1].ravel()
        faces = {"face_vertex_counts": np.full(len(corners) // 3, 3), "face_vertex_indices": corners, "normals": None}
        meshes.append(replace(mesh, points=mesh.points * mirror.diagonal()[:3], transform=mirror, skin=None, **faces))
    marks = put_marks(tmp_path / "marks.json", marks_of(small))
    assert not Head.of(replace(bare(small), meshes=tuple(meshes)), "head", marks).turned.any()


def test_a_mouth_that_is_open_is_not_cut(small: FaceParts) -> None:
    with pytest.raises(FitError, match="the lips are open already, expected a mouth that triangles seal"):
        with_cut_mouth(Head.of(small, "head", None))


def renamed(parts: FaceParts, name: str) -> FaceParts:
    """With the shape that heads come with called by another tool's name."""
    head = parts.meshes[0]
    shapes = tuple(replace(one, name=name) for one in head.blendshapes if one.name == KEPT)
    return replace(parts, meshes=(replace(head, blendshapes=shapes), *bare(parts).meshes[1:]))


@pytest.mark.parametrize(
    "name", [KEPT, "A38_Mouth_Smile_Left", "mouthSmile_L", "MouthSmileLeft", "blendShape1.mouthSmileLeft"]
)
def test_shapes_that_a_head_has_by_any_name_are_kept(small: FaceParts, name: str) -> None:
    names, kept = wanted_shapes(small, renamed(small, name), (), anew=False)
    assert kept == {KEPT: name}
    assert KEPT not in names
    assert {*names} == {*small.shapes} & {*ARKIT_SHAPES} - {KEPT}
    assert KEPT in wanted_shapes(small, renamed(small, name), (), anew=True)[0]


def test_a_shape_that_a_head_has_in_halves_is_not_made_beside_them(small: FaceParts) -> None:
    head = small.meshes[0]
    halves = [replace(one, name=f"cheekPuff_{side}") for one in head.blendshapes[:1] for side in "LR"]
    parts = replace(small, meshes=(replace(head, blendshapes=tuple(halves)), *bare(small).meshes[1:]))
    names, kept = wanted_shapes(small, parts, ("cheekPuff", "jawOpen"), anew=True)
    assert (names, kept) == (("jawOpen",), {"cheekPuff": "cheekPuff_L, cheekPuff_R"})


@pytest.mark.slow
def test_shapes_made_anew_have_the_names_that_the_head_has_for_them(
    small: FaceParts, tmp_path: Path, capsys: Capsys
) -> None:
    """One of them by another name on each mesh, as Maya's namespaces have it."""
    called = [{"jawOpen": f"{where}.JawOpen", "eyeBlinkLeft": "Blink_L"} for where in ("head", "inside")]
    meshes = []
    for mesh, names in zip(small.meshes, [called[0], *[called[1]] * (len(small.meshes) - 1)], strict=True):
        shapes = [one for one in mesh.blendshapes if one.name in names]
        faint = tuple(replace(one, name=names[one.name], offsets=0.1 * one.offsets, inbetweens=()) for one in shapes)
        meshes.append(replace(mesh, blendshapes=faint))
    source = replace(small, meshes=tuple(meshes), sliders=())
    save_parts(source, tmp_path / "head.usda")
    words = ("transfer", tmp_path / "head.usda", "-o", tmp_path / "out.usda", "--shapes", *FEW, "--replace")
    done(capsys, *words, quiet=False)
    result = read_face(tmp_path / "out.usda").parts()
    assert result.shapes == source.shapes
    for found, before in zip(result.meshes, source.meshes, strict=True):
        for one, faint in zip(found.blendshapes, before.blendshapes, strict=True):
            assert one.name == faint.name
            if len(faint.point_indices) > 100:
                assert np.abs(one.offsets).max() > 5.0 * np.abs(faint.offsets).max()


def test_shapes_are_those_asked_for_or_all(small: FaceParts) -> None:
    nothing = bare(small)
    assert wanted_shapes(small, nothing, FEW, anew=False) == (FEW, {})
    assert wanted_shapes(small, nothing, ("all",), anew=False)[0] == tuple(small.shapes)
    with pytest.raises(InputError, match="no shape of the template 'jawopen', did you mean 'jawOpen'"):
        wanted_shapes(small, nothing, ("jawopen",), anew=False)


def put_other_stage(path: Path) -> Path:
    """A triangle as another tool writes one."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.0254)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Hero").GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/Hero/Skin")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 0, 1)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    stage.Save()
    return path


def test_a_stage_of_another_tool_is_a_head_too(small: FaceParts, tmp_path: Path) -> None:
    made = made_head(put_other_stage(tmp_path / "hero.usda"))
    assert made is not None
    parts = made[0]
    assert (parts.meters_per_unit, parts.up_axis, [mesh.name for mesh in parts.meshes]) == (0.0254, "Z", ["Skin"])
    save_parts(bare(small), tmp_path / "face.usda")
    assert made_head(tmp_path / "face.usda") is None


@pytest.mark.parametrize("metres", [1.0, 0.1, 0.01, 0.001])
@pytest.mark.parametrize(("high", "deep"), [(1.7, 0.3), (0.24, 0.2)])
def test_bodies_and_heads_without_a_unit_get_one_by_their_size(
    metres: float, high: float, deep: float, tmp_path: Path
) -> None:
    box = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (0.0, 1.0) for z in (-0.5, 0.5)]) * [deep, high, deep]
    rows = [f"v {x:g} {y:g} {z:g}" for x, y, z in (box / metres).tolist()]
    faces = ["f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4"]
    (tmp_path / "box.obj").write_text("\n".join(["mtllib lost.mtl", *rows, *faces]))
    made = made_head(tmp_path / "box.obj")
    assert made is not None
    assert made[0].meters_per_unit == metres
    assert any("lost.mtl" in line for line in made[1])


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("empty.obj", "", "no points"),
        ("cloud.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
        ("nan.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "expected finite numbers"),
        ("head.blend", "BLENDER", "suffix '.blend'"),
        ("head.glb", "glTF", "expected a GLB header"),
        ("head.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", "head.ply"),
    ],
)
@pytest.mark.parametrize("verb", ["transfer", "conform"])
def test_what_is_no_head_is_one_line(
    verb: str, name: str, content: str, says: str, tmp_path: Path, capsys: Capsys
) -> None:
    (tmp_path / name).write_text(content)
    marks = put_marks(tmp_path / "marks.json", np.random.default_rng(0).random((68, 3)))
    assert says in failed(
        capsys, verb, tmp_path / name, "--landmarks", marks, "-o", tmp_path / "out.usda", folder=tmp_path
    )


def test_flags_that_contradict_each_other_are_named(tmp_path: Path, capsys: Capsys) -> None:
    head = put_other_stage(tmp_path / "hero.usda")
    words = (head, "-o", tmp_path / "out.usda", "--shapes", "jawOpen", "--only", "regions")
    assert "--only without shapes" in failed(capsys, "transfer", *words, folder=tmp_path)
    assert "is an input" in failed(capsys, "transfer", head, "-o", head, "--force", folder=tmp_path)
    template = (head, "-o", tmp_path / "out.usda", "--from", head)
    assert failed(capsys, "transfer", *template, folder=tmp_path)


@pytest.fixture(scope="module")
def hero(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a person as a GLB with skin, clip, textures and a shape, its landmarks, and `out.usda` of it."""
    folder = tmp_path_factory.mktemp("hero")
    person = make(3, textures=64)
    save_parts(bare(person, KEPT), folder / "person.usda")
    put_marks(folder / "hero.landmarks.json", marks_of(person))
    assert facepipe.export(folder / "person.usda", folder / "hero.glb", animations=True) is not None
    facepipe.transfer(head=folder / "hero.glb", out=folder / "out.usda", shapes=(*FEW, KEPT))
    return folder


@pytest.mark.slow
@pytest.mark.gate
def test_all_that_a_head_has_stays_as_import_reads_it(hero: Path) -> None:
    source, result = read_face(hero / "hero.glb").parts(), read_face(hero / "out.usda").parts()
    assert source.skeleton.joints
    assert source.animations
    assert any(mesh.material_faces or mesh.material for mesh in source.meshes)
    assert differences(source, own_of(result, source)) == []
    assert {*result.shapes} == {*FEW, KEPT}
    assert len(result.meshes[0].landmarks["multipie68"].indices) == 68


@pytest.mark.slow
def test_shapes_of_the_template_come_as_they_are_on_people_of_its_own(hero: Path) -> None:
    truth = whole_face(make(3), "truth").deltas["jawOpen"]
    found = whole_face(read_face(hero / "out.usda").parts(), "found").deltas["jawOpen"][: len(truth)]
    assert (found * truth).sum() > 0.98 * np.linalg.norm(found) * np.linalg.norm(truth)


def blink(parts: FaceParts) -> Blendshape:
    return next(one for one in parts.meshes[0].blendshapes if one.name == "eyeBlinkLeft")


@pytest.mark.slow
def test_blinks_go_round_the_eye_and_leave_the_rest_of_the_head(hero: Path) -> None:
    parts = read_face(hero / "out.usda").parts()
    shape = blink(parts)
    assert [one.weight for one in shape.inbetweens] == [0.25, 0.5, 0.75]
    assert all(isinstance(one, Inbetween) for one in shape.inbetweens)
    assert len(shape.point_indices) < len(parts.meshes[0].points) / 2


@pytest.mark.slow
@pytest.mark.gate
def test_three_js_plays_what_is_exported(hero: Path) -> None:
    facepipe.export(hero / "out.usda", hero / "out.glb")
    issues = validate([hero / "out.glb"])[hero / "out.glb"]["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0)
    loaded = three_load(hero / "out.glb", {"jawOpen": 1.0}, {})
    assert loaded


@pytest.mark.slow
def test_cook_makes_it_anew_when_the_head_has_changed(hero: Path, tmp_path: Path, capsys: Capsys) -> None:
    """Other colours are another file of the same head; --edit asks for another shape of it."""
    for name in ("hero.glb", "hero.landmarks.json"):
        (tmp_path / name).write_bytes((hero / name).read_bytes())
    words = (tmp_path / "hero.glb", "-o", tmp_path / "out.usda", "--shapes", "browInnerUp", "--only", "shapes")
    done(capsys, "transfer", *words, "-q")
    changed = bare(make(4, textures=64), KEPT)
    save_parts(changed, tmp_path / "person.usda")
    put_marks(tmp_path / "hero.landmarks.json", marks_of(make(4)))
    facepipe.export(tmp_path / "person.usda", tmp_path / "hero.glb", overwrite=True)
    done(capsys, "cook", tmp_path / "out.usda", "-q")
    result = read_face(tmp_path / "out.usda").parts()
    assert {*result.shapes} == {"browInnerUp", KEPT}
    assert not any(mesh.regions or mesh.landmarks for mesh in result.meshes)
    np.testing.assert_allclose(result.meshes[0].points, changed.meshes[0].points, atol=1e-4)


def put_away(path: Path, turned: Usd.Stage, inches: bool) -> np.ndarray:
    """A stage, flattened, whose head hangs below a transform far away in another unit; and that transform (4, 4)."""
    unit = 0.0254 if inches else 1.0
    UsdGeom.SetStageMetersPerUnit(turned, unit)
    UsdGeom.SetStageUpAxis(turned, UsdGeom.Tokens.z)
    matrix = Gf.Matrix4d(Gf.Rotation(Gf.Vec3d(1, 0, 0), 90), Gf.Vec3d(0))
    matrix = matrix * Gf.Matrix4d().SetScale(0.01 / unit) * Gf.Matrix4d().SetTranslate(Gf.Vec3d(70, -30, 9) / unit)
    prim = turned.GetDefaultPrim()
    UsdGeom.Xformable(prim).AddTransformOp().Set(matrix)
    turned.Export(str(path))
    return np.array(matrix)


@pytest.mark.slow
def test_units_axes_and_places_change_nothing(hero: Path, tmp_path: Path) -> None:
    matrix = put_away(tmp_path / "away.usda", Usd.Stage.Open(str(hero / "person.usda")), inches=True)
    marks = np.pad(marks_of(make(3)), ((0, 0), (0, 1)), constant_values=1.0) @ matrix
    put_marks(tmp_path / "away.landmarks.json", marks[:, :3])
    facepipe.transfer(head=tmp_path / "away.usda", out=tmp_path / "out.usda", shapes=FEW, only=("shapes",))
    here, away = (read_face(one / "out.usda").parts() for one in (hero, tmp_path))
    size = float(np.ptp(here.meshes[0].points, axis=0).max())
    for name in FEW:
        pair = [np.zeros((len(parts.meshes[0].points), 3)) for parts in (here, away)]
        for dense, parts in zip(pair, (here, away), strict=True):
            shape = next(one for one in parts.meshes[0].blendshapes if one.name == name)
            dense[shape.point_indices] = shape.offsets
        assert np.abs(pair[0] - pair[1]).max() < 1e-4 * size


@pytest.mark.slow
def test_what_is_no_face_is_made_with_its_limits_told(tmp_path: Path, capsys: Capsys) -> None:
    """A ball that landmarks were put on, with a hat."""
    import trimesh

    ball, hat = trimesh.creation.icosphere(4, 10.0), trimesh.creation.cylinder(6.0, 3.0)
    hat.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    hat.apply_translation([0, 13, 0])
    rows, first = [], 1
    for name, points, faces in (("Ball", ball.vertices, ball.faces), ("Hat", hat.vertices, hat.faces)):
        rows += [f"o {name}", *("v {} {} {}".format(*point) for point in points)]
        rows += ["f {} {} {}".format(*(first + corners)) for corners in faces]
        first += len(points)
    (tmp_path / "ball.obj").write_text("\n".join(rows))
    marks = marks_of(make(0))
    put_marks(tmp_path / "ball.landmarks.json", 10.0 * marks / np.linalg.norm(marks, axis=1, keepdims=True))
    words = (tmp_path / "ball.obj", "-o", tmp_path / "out.usda", "--shapes", *FEW, "--json")
    code, out, _ = run(capsys, "transfer", *words)
    assert code == 1
    report = json.loads(out)
    assert report["not_made"] == {"eyeBlinkLeft": "eyes are paint"}
    assert report["missed"]
    assert report["still"] == ["Hat"]
    assert load("usd", tmp_path / "out.usda").parts.shapes == ("jawOpen",)


@pytest.mark.slow
def test_skins_of_more_points_than_a_minute_is_enough_for_are_counted(tmp_path: Path) -> None:
    side = 560
    x, y = np.meshgrid(np.arange(side) - side / 2, np.arange(side) - side / 2)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1)
    number = np.arange(side * side).reshape(side, side)
    corners = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    sheet = Mesh(
        name="Sheet",
        points=points,
        face_vertex_counts=np.full(len(corners), 4, np.int32),
        face_vertex_indices=corners.ravel().astype(np.int32),
    )
    marks = put_marks(tmp_path / "marks.json", points[:: side * side // 67][:68])
    with pytest.raises(InputError, match="its skin has 313,600 points, expected at most 300,000"):
        Head.of(FaceParts(meshes=(sheet,)), "sheet", marks).skin()
    # before landmarks are searched, which would find no face
    with pytest.raises(InputError, match="its skin has 313,600 points, expected at most 300,000"):
        Head.of(FaceParts(meshes=(sheet,)), "sheet", None)
