"""UsdSkel files as other tools write them: whatever their layout, they deform as UsdSkel says they do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faces import replace_mesh
from foreign_stages import HEAD, SKELETON, TEETH, foreign_stage, read, rich_face, warned, written
from full_faces import PNG, full_face
from layers import attribute
from network_faces import network, networked
from oracle import bake, difference, random_coefficients
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils

import facepipe
from facepipe import parts as p
from facepipe.checks import validate
from facepipe.core.errors import FacepipeError, InputError, SchemaError, TopologyError
from facepipe.rig import coefficient_matrices
from facepipe.stage import Face, save_parts
from facepipe.stage.author import author
from facepipe.stage.prims import prims_below
from facepipe.stage.values import floats, ints, to_floats, to_ints, to_matrices, to_vec3f

TOLERANCE = 1e-5  # of the head height

Quirk = Callable[[Usd.Stage], None]


# ---- layouts that mean the same


def unsorted_points(stage: Usd.Stage) -> None:
    shape = f"{HEAD}/jawOpen."
    order = [2, 0, 3, 1]
    for name in ("pointIndices", "offsets", "normalOffsets", "inbetweens:half"):
        values = list(attribute(stage, shape + name).Get())
        attribute(stage, shape + name).Set([values[i] for i in order])


def dense_shape(stage: Usd.Stage) -> None:
    """A shape of all points without pointIndices."""
    stage.GetPrimAtPath(f"{HEAD}/mouthSmileLeft").RemoveProperty("pointIndices")


def mesh_joints(stage: Usd.Stage) -> None:
    """Indices into skel:joints of the mesh, in another order than the skeleton's."""
    UsdSkel.BindingAPI(stage.GetPrimAtPath(HEAD)).CreateJointsAttr(["root/jaw/lip", "root", "root/jaw"])
    indices = attribute(stage, f"{HEAD}.primvars:skel:jointIndices")
    indices.Set(to_ints(np.array([1, 2, 0])[ints(indices.Get())]))


def late_parents(stage: Usd.Stage) -> None:
    """Joints children first, everything that counts them along."""
    for name in ("joints", "bindTransforms", "restTransforms"):
        values = list(attribute(stage, f"{SKELETON}.{name}").Get())
        attribute(stage, f"{SKELETON}.{name}").Set([values[2], values[0], values[1]])
    indices = attribute(stage, f"{HEAD}.primvars:skel:jointIndices")
    indices.Set(to_ints(np.array([1, 2, 0])[ints(indices.Get())]))


def no_rest(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath(SKELETON).RemoveProperty("restTransforms")


def no_bind(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath(SKELETON).RemoveProperty("bindTransforms")


def late_parents_no_bind(stage: Usd.Stage) -> None:
    late_parents(stage)
    no_bind(stage)


def short_rest(stage: Usd.Stage) -> None:
    attribute(stage, f"{SKELETON}.restTransforms").Set(to_matrices(np.eye(4)[None]))


def no_skel_root(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/Rich").SetTypeName("Xform")


def untyped_root(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/Rich").SetTypeName("")


def no_api(stage: Usd.Stage) -> None:
    for path in (HEAD, TEETH, SKELETON):
        stage.GetPrimAtPath(path).RemoveAPI(UsdSkel.BindingAPI)


def bound_above(stage: Usd.Stage) -> None:
    """The binding stands on the SkelRoot and holds for all below."""
    for path in (HEAD, TEETH):
        stage.GetPrimAtPath(path).RemoveProperty("skel:skeleton")
    UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath("/Rich")).CreateSkeletonRel().SetTargets([SKELETON])


def unbound(stage: Usd.Stage) -> None:
    for path in (HEAD, TEETH):
        stage.GetPrimAtPath(path).RemoveProperty("skel:skeleton")


def joint_names(stage: Usd.Stage) -> None:
    """jointNames are there for some tools and not for others; paths are what counts."""
    UsdSkel.Skeleton(stage.GetPrimAtPath(SKELETON)).CreateJointNamesAttr(["a", "b", "c"])


def odd_joint_names(stage: Usd.Stage) -> None:
    attribute(stage, f"{SKELETON}.joints").Set(["my rig:root", "my rig:root/jaw", "my rig:root/jaw/2 lip"])


def points_over_time(stage: Usd.Stage) -> None:
    points = attribute(stage, f"{HEAD}.points")
    values = floats(points.Get(), 3)
    points.Clear()
    points.Set(to_vec3f(values), 3.0)
    points.Set(to_vec3f(values + 1), 4.0)


def transforms_over_time(stage: Usd.Stage) -> None:
    op = attribute(stage, f"{SKELETON}.xformOp:transform")
    value = op.Get()
    op.Clear()
    op.Set(value, 1.0)
    op.Set(Gf.Matrix4d(1), 2.0)


def left_handed(stage: Usd.Stage) -> None:
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(HEAD))
    faces = ints(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)
    mesh.GetFaceVertexIndicesAttr().Set(to_ints(faces[:, ::-1]))
    mesh.CreateOrientationAttr("leftHanded")


def subdivided(stage: Usd.Stage) -> None:
    UsdGeom.Mesh(stage.GetPrimAtPath(HEAD)).CreateSubdivisionSchemeAttr("catmullClark")


def double_weights(stage: Usd.Stage) -> None:
    weights = attribute(stage, f"{HEAD}.primvars:skel:jointWeights")
    weights.Set(to_floats(floats(weights.Get()) * 2))


def padded_influences(stage: Usd.Stage) -> None:
    """Nine influences a point, most without weight and with an index that is none."""
    binding = UsdSkel.BindingAPI(stage.GetPrimAtPath(HEAD))
    indices = ints(binding.GetJointIndicesAttr().Get()).reshape(-1, 3)
    weights = floats(binding.GetJointWeightsAttr().Get()).reshape(-1, 3)
    wide = np.concatenate([np.zeros((36, 6), np.float32), weights], axis=1)
    binding.CreateJointIndicesPrimvar(False, 9).Set(to_ints(np.pad(indices, ((0, 0), (6, 0)), constant_values=-1)))
    binding.CreateJointWeightsPrimvar(False, 9).Set(to_floats(wide))


def nested_roots(stage: Usd.Stage) -> None:
    """Two SkelRoots below an Xform, one of them with the skeleton of both."""
    layer = stage.GetRootLayer()
    stage.GetPrimAtPath("/Rich").SetTypeName("Xform")
    UsdSkel.Root.Define(stage, "/Rich/One")
    UsdSkel.Root.Define(stage, "/Rich/Two")
    edit = Sdf.BatchNamespaceEdit()
    edit.Add("/Rich/Head", "/Rich/One/Head")
    edit.Add("/Rich/Skeleton", "/Rich/One/Skeleton")
    edit.Add("/Rich/Teeth", "/Rich/Two/Teeth")
    assert layer.Apply(edit)
    for mesh in ("/Rich/One/Head", "/Rich/Two/Teeth"):
        prim = stage.GetPrimAtPath(mesh)
        prim.GetRelationship("skel:skeleton").SetTargets(["/Rich/One/Skeleton"])
        shapes = [child.GetPath() for child in prim.GetChildren() if child.IsA(UsdSkel.BlendShape)]
        prim.GetRelationship("skel:blendShapeTargets").SetTargets(shapes)


SAME: dict[str, tuple[Quirk, str]] = {  # quirk -> what is said about it
    "as it should be": (lambda stage: None, ""),
    "unsorted pointIndices": (unsorted_points, ""),
    "shape without pointIndices": (dense_shape, ""),
    "mesh-level joints": (mesh_joints, ""),
    "children before parents": (late_parents, "reordered"),
    "no rest transforms": (no_rest, "taken from bind"),
    "no bind transforms": (no_bind, "taken from rest"),
    "children before parents, no bind transforms": (late_parents_no_bind, "taken from rest"),
    "too few rest transforms": (short_rest, "1 rest transforms of 3 joints"),
    "no SkelRoot": (no_skel_root, ""),
    "untyped root": (untyped_root, ""),
    "two SkelRoots below an Xform": (nested_roots, ""),
    "no SkelBindingAPI": (no_api, "SkelBindingAPI is not applied"),
    "bound above": (bound_above, ""),
    "bound to nothing": (unbound, "taken as bound to"),
    "jointNames": (joint_names, ""),
    "joint names that are no identifiers": (odd_joint_names, "3 joint paths made identifiers"),
    "points over time": (points_over_time, "samples of points over time are"),
    "transforms over time": (transforms_over_time, "its motion over time is that of the root joints"),
    "left-handed faces": (left_handed, ""),
    "subdivision surface": (subdivided, "kept as its base cage"),
    "weights that sum to 2": (double_weights, "normalised, their sums were 2 to 2"),
    "nine influences": (padded_influences, ""),
}


def poses(face: Face) -> list[tuple[dict[str, float], np.ndarray]]:
    rng = np.random.default_rng(11)
    found = []
    for _ in range(3):
        coefficients = random_coefficients(rng, len(face.skeleton.joints), 0.3)
        weights = {"jawOpen": rng.uniform(-0.5, 1.5), "mouthSmileLeft": rng.uniform(0, 1)}
        found.append((weights, face.skeleton.rest_transforms @ coefficient_matrices(coefficients)))
    return found


@pytest.mark.parametrize("name", list(SAME))
def test_layouts_that_mean_the_same_deform_the_same(name: str, tmp_path: Path) -> None:
    quirk, said = SAME[name]
    stage = foreign_stage(rich_face())
    quirk(stage)
    imported = read(written(stage, tmp_path / "face.usda"))
    face, truth = Face.from_parts(imported.parts), Face.from_parts(rich_face())
    assert len(face.skeleton.joints) == 3
    for weights, local in poses(truth):
        moved = face.evaluate(weights, joint_transforms=local)
        assert difference(truth, moved, bake(truth, weights, local)) < TOLERANCE
    for one, other in zip(imported.parts.meshes, rich_face().meshes, strict=True):
        assert np.array_equal(one.face_vertex_indices, other.face_vertex_indices)
    if said:
        warned(imported, said)
    else:
        assert imported.warnings == ()


@pytest.mark.parametrize("name", list(SAME))
def test_what_was_imported_is_a_valid_face(name: str, tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    SAME[name][0](stage)
    save_parts(read(written(stage, tmp_path / "source.usda")).parts, tmp_path / "face.usda")
    assert validate(tmp_path / "face.usda") == ()


# ---- layouts that UsdSkel judges itself


def no_geom_bind(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath(HEAD).RemoveProperty("primvars:skel:geomBindTransform")


def rigid(stage: Usd.Stage) -> None:
    binding = UsdSkel.BindingAPI(stage.GetPrimAtPath(HEAD))
    binding.CreateJointIndicesPrimvar(True, 2).Set([2, 1])
    binding.CreateJointWeightsPrimvar(True, 2).Set([0.25, 0.75])


def point_twice(stage: Usd.Stage) -> None:
    attribute(stage, f"{HEAD}/jawOpen.pointIndices").Set([1, 9, 9, 4])


def rest_is_not_bind(stage: Usd.Stage) -> None:
    rest = attribute(stage, f"{SKELETON}.restTransforms")
    rest.Set([one * Gf.Matrix4d().SetTranslate(Gf.Vec3d(0.2, 0.1, 0)) for one in rest.Get()])


def moved_above(stage: Usd.Stage) -> None:
    UsdGeom.Xformable(stage.GetPrimAtPath("/Rich")).AddRotateXOp().Set(30.0)
    UsdGeom.Xformable(stage.GetPrimAtPath("/Rich")).AddScaleOp().Set(Gf.Vec3f(2, 2, 2))


def unskinned_child(stage: Usd.Stage) -> None:
    """A mesh with shapes and a joint subset, and one that is bound to nothing but drawn."""
    UsdSkel.BindingAPI(stage.GetPrimAtPath(TEETH)).CreateJointIndicesPrimvar(True, 1).Set([0])
    UsdSkel.BindingAPI(stage.GetPrimAtPath(TEETH)).CreateJointWeightsPrimvar(True, 1).Set([1.0])
    UsdSkel.BindingAPI(stage.GetPrimAtPath(TEETH)).CreateJointsAttr(["root/jaw"])


JUDGED: dict[str, Quirk] = {
    "geomBindTransform not authored": no_geom_bind,
    "rigid mesh": rigid,
    "point named twice in a shape": point_twice,
    "rest that is not bind": rest_is_not_bind,
    "transforms above the face": moved_above,
    "rigid teeth with joints of their own": unskinned_child,
}


@pytest.mark.parametrize("name", list(JUDGED))
def test_the_source_baked_by_usdskel_is_what_the_imported_face_evaluates_to(name: str, tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    JUDGED[name](stage)
    imported = read(written(stage, tmp_path / "face.usda"))
    face = Face.from_parts(imported.parts)
    source = Face(stage, stage.GetDefaultPrim())
    for weights, local in poses(face):
        moved = face.evaluate(weights, joint_transforms=local)
        assert difference(face, moved, bake(source, weights, local)) < TOLERANCE


@pytest.mark.parametrize("arc", ["reference", "instance", "sublayer", "payload", "usdz", "nested instance"])
def test_composed_sources(arc: str, tmp_path: Path) -> None:
    source = written(foreign_stage(rich_face()), tmp_path / "source.usdc")
    target = tmp_path / "scene.usda"
    if arc == "usdz":
        target = tmp_path / "scene.usdz"
        assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(source)), str(target))
    else:
        stage = Usd.Stage.CreateNew(str(target))
        UsdGeom.SetStageMetersPerUnit(stage, 0.01)
        UsdGeom.SetStageUpAxis(stage, "Y")
        if arc == "sublayer":
            stage.GetRootLayer().subLayerPaths.append("./source.usdc")
            stage.SetMetadata("defaultPrim", "Rich")
        else:
            place = stage.DefinePrim("/World/Actor", "Xform")
            stage.SetDefaultPrim(stage.GetPrimAtPath("/World"))
            arcs = place.GetPayloads() if arc == "payload" else place.GetReferences()
            (arcs.AddPayload if arc == "payload" else arcs.AddReference)("./source.usdc")
            place.SetInstanceable("instance" in arc)
            if arc == "nested instance":
                stage.DefinePrim("/Outer", "Xform").GetReferences().AddInternalReference("/World")
                stage.GetPrimAtPath("/Outer").SetInstanceable(True)
                stage.SetDefaultPrim(stage.GetPrimAtPath("/Outer"))
        stage.Save()
    before = {one: one.read_bytes() for one in tmp_path.iterdir()}
    imported = read(target)
    assert imported.warnings == ()
    assert {one: one.read_bytes() for one in tmp_path.iterdir()} == before
    face, truth = Face.from_parts(imported.parts), Face.from_parts(rich_face())
    weights, local = poses(truth)[0]
    assert difference(truth, face.evaluate(weights, joint_transforms=local), bake(truth, weights, local)) < TOLERANCE
    recipe = imported.parts.recipe
    assert recipe is not None
    assert (recipe.verb, len(recipe.digests)) == ("import usd", 1)


def test_blendshapes_without_any_skeleton(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    stage.RemovePrim(SKELETON)
    for path in (HEAD, TEETH):
        prim = stage.GetPrimAtPath(path)
        for name in ("skel:skeleton", *(one for one in prim.GetPropertyNames() if "skel:joint" in one)):
            prim.RemoveProperty(name)
    imported = read(written(stage, tmp_path / "face.usda"))
    warned(imported, "which UsdSkel never shows")
    assert imported.parts.skeleton.joints == ()
    face = Face.from_parts(imported.parts)
    neutral, moved = face.evaluate(), face.evaluate({"jawOpen": 1.0})
    offsets = rich_face().meshes[1].blendshapes[0].offsets @ rich_face().meshes[1].transform[:3, :3].T
    np.testing.assert_allclose((moved - neutral)[36:], offsets, atol=1e-6)
    assert difference(face, moved, bake(face, {"jawOpen": 1.0})) < TOLERANCE


def test_a_mesh_alone_without_any_prim_above(tmp_path: Path) -> None:
    (tmp_path / "cube.usda").write_text(
        '#usda 1.0\n(defaultPrim="Tri"\nmetersPerUnit=1\nupAxis="Z")\ndef Mesh "Tri" {\n'
        "point3f[] points=[(0,0,0),(1,0,0),(0,1,0)]\nint[] faceVertexCounts=[3]\nint[] faceVertexIndices=[0,1,2]\n"
        'uniform token subdivisionScheme="none"\n'
        'uniform token[] skel:blendShapes=["up"]\nrel skel:blendShapeTargets=</Tri/up>\n'
        'def BlendShape "up" { vector3f[] offsets=[(0,0,1)]\nint[] pointIndices=[2] }\n}\n'.replace(
            "{ v", "{\nv"
        ).replace("] }", "]\n}")
    )
    imported = read(tmp_path / "cube.usda")
    assert (imported.parts.up_axis, imported.parts.meters_per_unit, imported.parts.name) == ("Z", 1.0, "Tri")
    moved = Face.from_parts(imported.parts).evaluate({"up": 1.0})
    np.testing.assert_allclose(moved, [[0, 0, 0], [1, 0, 0], [0, 1, 1]])


# ---- what has to be chosen, and what is left out


def with_second_skeleton() -> Usd.Stage:
    stage = foreign_stage(rich_face())
    assert Sdf.CopySpec(stage.GetRootLayer(), SKELETON, stage.GetRootLayer(), "/Rich/Other")
    return stage


def test_two_skeletons_need_a_choice(tmp_path: Path) -> None:
    stage = with_second_skeleton()
    stage.GetRelationshipAtPath(f"{TEETH}.skel:skeleton").SetTargets(["/Rich/Other"])
    path = written(stage, tmp_path / "face.usda")
    with pytest.raises(InputError, match="/Rich/Skeleton, /Rich/Other"):
        read(path)
    imported = read(path, skeleton=SKELETON)
    assert [mesh.name for mesh in imported.parts.meshes] == ["Head"]
    warned(imported, "bound to another Skeleton: left out")
    assert [mesh.name for mesh in read(path, skeleton="/Rich/Other").parts.meshes] == ["Teeth"]
    for wrong in ("/Rich/Head", "/Gone", "Rich", "/", "</>"):
        with pytest.raises(InputError, match="no Skeleton at"):
            read(path, skeleton=wrong)


def test_a_skeleton_that_no_mesh_uses_is_left_out(tmp_path: Path) -> None:
    imported = read(written(with_second_skeleton(), tmp_path / "face.usda"))
    warned(imported, "</Rich/Other>: Skeleton that no mesh is bound to")


def test_prim_option(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    UsdGeom.Mesh.Define(stage, "/Else/Thing").CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    thing = UsdGeom.Mesh(stage.GetPrimAtPath("/Else/Thing"))
    thing.CreateFaceVertexCountsAttr([3])
    thing.CreateFaceVertexIndicesAttr([0, 1, 2])
    thing.CreateSubdivisionSchemeAttr("none")
    path = written(stage, tmp_path / "face.usda")
    assert [mesh.name for mesh in read(path).parts.meshes] == ["Head", "Teeth"]
    assert [mesh.name for mesh in read(path, prim="/Else").parts.meshes] == ["Thing"]
    assert [mesh.name for mesh in read(path, prim=TEETH).parts.meshes] == ["Teeth"]
    stage.ClearDefaultPrim()
    assert len(read(written(stage, tmp_path / "nodefault.usda")).parts.meshes) == 3
    for wrong in ("/Gone", "Rich", "", "/", "/Rich.x"):
        with pytest.raises(InputError, match="no prim at root"):
            read(path, prim=wrong)


def test_what_is_not_a_shown_mesh_is_left_out_and_named(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    for name in ("Hidden", "Guide", "Proxy", "Empty"):
        Sdf.CopySpec(stage.GetRootLayer(), TEETH, stage.GetRootLayer(), f"/Rich/{name}")
        stage.GetRelationshipAtPath(f"/Rich/{name}.skel:blendShapeTargets").SetTargets([f"/Rich/{name}/jawOpen"])
    UsdGeom.Mesh(stage.GetPrimAtPath("/Rich/Hidden")).MakeInvisible()
    UsdGeom.Mesh(stage.GetPrimAtPath("/Rich/Guide")).CreatePurposeAttr("guide")
    UsdGeom.Mesh(stage.GetPrimAtPath("/Rich/Proxy")).CreatePurposeAttr("proxy")
    UsdGeom.Mesh(stage.GetPrimAtPath("/Rich/Empty")).GetPointsAttr().Set([])
    UsdGeom.PointInstancer.Define(stage, "/Rich/Freckles")
    UsdGeom.BasisCurves.Define(stage, "/Rich/Hair")
    UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(TEETH)).CreatePrimvar("wet", Sdf.ValueTypeNames.FloatArray, "vertex").Set(
        [0.0] * 9
    )
    imported = read(written(stage, tmp_path / "face.usda"))
    assert [mesh.name for mesh in imported.parts.meshes] == ["Head", "Teeth"]
    for said in (
        "</Rich/Hidden>: mesh invisible",
        "</Rich/Guide>, </Rich/Proxy>: mesh of purpose guide or proxy",
        "</Rich/Empty>: mesh without faces",
        "</Rich/Freckles>: 1 of type PointInstancer",
        "</Rich/Hair>: 1 of type BasisCurves",
        "</Rich/Teeth>: primvar wet of type float[]",
    ):
        warned(imported, said)


def test_units_that_are_not_authored_are_named(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    stage.GetRootLayer().pseudoRoot.ClearInfo("metersPerUnit")
    stage.GetRootLayer().pseudoRoot.ClearInfo("upAxis")
    imported = read(written(stage, tmp_path / "face.usda"))
    warned(imported, "metersPerUnit not authored: taken as 0.01")
    warned(imported, "upAxis not authored: taken as Y")


def test_primvars_and_normals(tmp_path: Path) -> None:
    """UV sets of every kind come along; those that don't fit are named; uniform normals are no point normals."""
    stage = foreign_stage(rich_face())
    head = stage.GetPrimAtPath(HEAD)
    api = UsdGeom.PrimvarsAPI(head)
    uv = Sdf.ValueTypeNames.TexCoord2fArray
    api.CreatePrimvar("corner", uv, "faceVarying").Set([(i / 100, 0) for i in range(100)])
    api.CreatePrimvar("faces", uv, "uniform").Set([(0, 0)] * 25)
    api.CreatePrimvar("short", uv, "vertex").Set([(0, 0)] * 7)
    normals = api.CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "vertex")
    normals.Set([(0, 1, 0)] * 36)
    UsdGeom.Mesh(stage.GetPrimAtPath(TEETH)).CreateNormalsAttr([(0, 1, 0)] * 4)
    UsdGeom.Mesh(stage.GetPrimAtPath(TEETH)).SetNormalsInterpolation("uniform")
    imported = read(written(stage, tmp_path / "face.usda"))
    mesh, teeth = imported.parts.meshes
    assert [uv_set.name for uv_set in mesh.uv_sets] == ["corner", "st"]
    assert mesh.normals is not None
    assert (mesh.normals == [0, 1, 0]).all()
    assert teeth.normals is None
    warned(imported, "primvar faces of uniform interpolation")
    warned(imported, "primvar short with 7 values, expected 36")
    warned(imported, "normals of uniform interpolation")


def test_left_handed_face_vertices_turn_with_what_belongs_to_them(tmp_path: Path) -> None:
    parts = full_face()
    stage = foreign_stage(replace(parts, name="Rich"))
    left_handed(stage)
    uv = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(HEAD)).GetPrimvar("st")
    uv.SetIndices(to_ints(ints(uv.GetIndices()).reshape(-1, 4)[:, ::-1]))
    mesh = read(written(stage, tmp_path / "face.usda")).parts.meshes[0]
    source = parts.meshes[0]
    assert np.array_equal(mesh.face_vertex_indices, source.face_vertex_indices)
    assert mesh.uv_sets[0].indices is not None
    assert source.uv_sets[0].indices is not None
    assert np.array_equal(mesh.uv_sets[0].indices, source.uv_sets[0].indices)


def test_points_without_weight_follow_the_first_joint(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    weights = attribute(stage, f"{HEAD}.primvars:skel:jointWeights")
    values = floats(weights.Get()).reshape(-1, 3)
    values[5] = 0
    values[6] = (-0.5, 1.0, 0.0)
    weights.Set(to_floats(values))
    imported = read(written(stage, tmp_path / "face.usda"))
    warned(imported, "1 points without weight now follow the first joint")
    warned(imported, "weights below 0 taken as 0")
    skin = imported.parts.meshes[0].skin
    assert skin is not None
    np.testing.assert_allclose(skin.joint_weights.sum(axis=1), 1, atol=1e-6)
    assert skin.joint_weights[5].tolist() == [1, 0, 0]


# ---- animations and materials


def test_animation_with_time_samples_and_without_scales(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    animation = UsdSkel.Animation.Define(stage, "/Rich/Talk")
    animation.CreateJointsAttr(["root/jaw", "root/tail"])
    for time, y in ((0, 0.0), (12, 1.0)):
        animation.CreateTranslationsAttr().Set([(0, y, 0), (9, 9, 9)], time)
        animation.CreateRotationsAttr().Set([Gf.Quatf(1), Gf.Quatf(1)], time)
    animation.CreateBlendShapesAttr(["wink", "jawOpen"])
    animation.CreateBlendShapeWeightsAttr([0.1, 0.7])
    UsdSkel.BindingAPI(stage.GetPrimAtPath(SKELETON)).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    imported = read(written(stage, tmp_path / "face.usda"))
    warned(imported, "moves root/tail, wink (2 in all), which the face lacks")
    warned(imported, "no scales: taken from rest")
    (clip,) = imported.parts.animations
    assert (clip.name, clip.joints, clip.shapes) == ("Talk", ("root/jaw",), ("jawOpen",))
    assert clip.times is not None
    assert clip.times.tolist() == [0.0, 0.5]
    assert clip.translations is not None
    assert clip.translations[:, 0, 1].tolist() == [0.0, 1.0]
    assert clip.shape_weights is not None
    np.testing.assert_allclose(clip.shape_weights, [[0.7], [0.7]])
    save_parts(imported.parts, tmp_path / "out.usda")
    scales = facepipe.open(tmp_path / "out.usda").animations[0].scales
    assert scales is not None
    np.testing.assert_allclose(scales, 1)


def test_a_damaged_animation_is_left_out(tmp_path: Path) -> None:
    stage = foreign_stage(rich_face())
    animation = UsdSkel.Animation.Define(stage, "/Rich/Bad")
    animation.CreateJointsAttr(["root/jaw"])
    animation.CreateTranslationsAttr([(0, 0, 0), (0, 0, 0)])
    imported = read(written(stage, tmp_path / "face.usda"))
    assert imported.parts.animations == ()
    warned(imported, "animation left out")


def test_materials_and_textures_in_every_layout(tmp_path: Path) -> None:
    """Materials outside the face, one image name twice, one image missing, a transform and inputs that are lost."""
    stage = foreign_stage(rich_face())
    for number, folder in enumerate(("a", "b")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "skin.png").write_bytes(PNG + bytes(number))
    for name, file in (("A", "./a/skin.png"), ("B", "./b/skin.png"), ("C", "./gone.png")):
        material = UsdShade.Material.Define(stage, f"/Looks/{name}")
        surface = UsdShade.Shader.Define(stage, f"/Looks/{name}/S")
        surface.CreateIdAttr("UsdPreviewSurface")
        surface.CreateInput("clearcoat", Sdf.ValueTypeNames.Float).Set(0.5)
        surface.CreateInput("displacement", Sdf.ValueTypeNames.Float).Set(0.5)
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.25)
        texture = UsdShade.Shader.Define(stage, f"/Looks/{name}/T")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(file))
        texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(texture.ConnectableAPI(), "rgb")
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    bind = UsdShade.MaterialBindingAPI
    bind.Apply(stage.GetPrimAtPath(HEAD)).Bind(UsdShade.Material(stage.GetPrimAtPath("/Looks/A")))
    subset = bind.Apply(stage.GetPrimAtPath(HEAD)).CreateMaterialBindSubset("lips", [1, 2])
    bind.Apply(subset.GetPrim()).Bind(UsdShade.Material(stage.GetPrimAtPath("/Looks/B")))
    bind.Apply(stage.GetPrimAtPath(TEETH)).Bind(UsdShade.Material(stage.GetPrimAtPath("/Looks/C")))
    imported = read(written(stage, tmp_path / "face.usda"))
    first, second, third = imported.parts.materials
    assert isinstance(first.diffuse_color, p.TextureInput)
    assert isinstance(second.diffuse_color, p.TextureInput)
    assert (first.diffuse_color.texture.name, second.diffuse_color.texture.name) == ("skin.png", "skin_2.png")
    assert third.diffuse_color == (0.18, 0.18, 0.18)
    assert third.roughness == 0.25
    warned(imported, "texture @./gone.png@ can't be found: left out")
    warned(imported, "displacement of the material: left out")
    assert third.clearcoat == 0.5
    head, teeth = imported.parts.meshes
    assert (head.material, teeth.material) == (first.name, third.name)
    assert [(material_face.material, material_face.faces.tolist()) for material_face in head.material_faces] == [
        (second.name, [1, 2])
    ]
    save_parts(imported.parts, tmp_path / "out.usdz")
    assert validate(tmp_path / "out.usdz") == ()


def test_names_that_collide_stay_apart(tmp_path: Path) -> None:
    """A shape called as a region, and meshes called as what our stages have below a face."""
    parts = rich_face()
    head, teeth = parts.meshes
    subset = np.array([3, 5], np.int32)
    head = replace_mesh(head, name="Materials", point_subsets={"jawOpen": subset, "Skin_faces": subset})
    faces = p.MaterialFaces(material="Skin", faces=np.array([1], np.int32))
    teeth = replace_mesh(teeth, name="Skeleton", material_faces=(faces,))
    parts = replace(parts, meshes=(replace(head, material_faces=(faces,)), teeth), materials=(p.Material(name="Skin"),))
    save_parts(parts, tmp_path / "face.usda")
    assert validate(tmp_path / "face.usda") == ()
    again = facepipe.open(tmp_path / "face.usda")
    assert [mesh.name for mesh in again.meshes] == ["Materials", "Skeleton"]
    assert set(again.meshes[0].point_subsets) == {"jawOpen", "Skin_faces"}
    assert again.shapes == ("jawOpen", "mouthSmileLeft")
    difference_ = again.evaluate({"jawOpen": 1.0}) - Face.from_parts(rich_face()).evaluate({"jawOpen": 1.0})
    np.testing.assert_allclose(difference_, 0, atol=1e-6)


# ---- what can't be read


def nan_points(stage: Usd.Stage) -> None:
    values = floats(attribute(stage, f"{HEAD}.points").Get(), 3)
    values[0] = np.nan
    attribute(stage, f"{HEAD}.points").Set(to_vec3f(values))


def nan_weights(stage: Usd.Stage) -> None:
    values = floats(attribute(stage, f"{HEAD}.primvars:skel:jointWeights").Get())
    values[0] = np.inf
    attribute(stage, f"{HEAD}.primvars:skel:jointWeights").Set(to_floats(values))


def no_transforms(stage: Usd.Stage) -> None:
    no_bind(stage)
    no_rest(stage)


def singular_bind(stage: Usd.Stage) -> None:
    values = list(attribute(stage, f"{SKELETON}.bindTransforms").Get())
    attribute(stage, f"{SKELETON}.bindTransforms").Set([Gf.Matrix4d(0), *values[1:]])


def no_meshes(stage: Usd.Stage) -> None:
    stage.RemovePrim(HEAD)
    stage.RemovePrim(TEETH)


def twice_named(stage: Usd.Stage) -> None:
    attribute(stage, f"{HEAD}.skel:blendShapes").Set(["jawOpen", "jawOpen"])


def missing_target(stage: Usd.Stage) -> None:
    stage.RemovePrim(f"{HEAD}/jawOpen")


def wild_index(stage: Usd.Stage) -> None:
    attribute(stage, f"{HEAD}.primvars:skel:jointIndices").Set([7] * 108)


def broken_reference(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath(TEETH).GetReferences().AddReference("./gone.usda")


@pytest.mark.parametrize(
    ("quirk", "kind", "message"),
    [
        (nan_points, SchemaError, "NaN"),
        (nan_weights, FacepipeError, "NaN"),
        (no_transforms, TopologyError, "0 bind and 0 rest transforms, expected 3"),
        (singular_bind, TopologyError, "singular"),
        (no_meshes, InputError, "no mesh to read"),
        (twice_named, SchemaError, "twice"),
        (missing_target, SchemaError, "no BlendShape there"),
        (wild_index, TopologyError, "joint indices outside"),
        (broken_reference, InputError, "gone.usda"),
    ],
)
def test_what_does_not_hold_together_is_one_line(
    quirk: Quirk, kind: type[FacepipeError], message: str, tmp_path: Path
) -> None:
    stage = foreign_stage(rich_face())
    quirk(stage)
    path = written(stage, tmp_path / "face.usda")
    with pytest.raises(kind, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert str(caught.value).count("face.usda:") + str(caught.value).count("face.usda ->") == 1


def test_instances_of_instances_without_end_are_refused(tmp_path: Path) -> None:
    """Each level holds ten instances of the next: 10^7 meshes of a file of a few lines."""
    lines = ['#usda 1.0\n(defaultPrim="L0")']
    for level in range(7):
        children = "\n".join(f'def "c{i}" (instanceable=true\nreferences=</L{level + 1}>) {{}}' for i in range(10))
        lines.append(f'def Xform "L{level}" {{\n{children}\n}}')
    lines.append('def Xform "L7" {\ndef Mesh "M" {}\n}')
    (tmp_path / "bomb.usda").write_text("\n".join(lines))
    for reader in (read, validate):
        with pytest.raises(InputError, match="composes to"):
            reader(tmp_path / "bomb.usda")
    stage = Usd.Stage.Open(str(tmp_path / "bomb.usda"))  # as a host may have it
    with pytest.raises(InputError, match="more than 200000 prims"):
        list(prims_below(stage.GetPseudoRoot(), "bomb"))


# ---- faces of facepipe itself


def own_face() -> p.FaceParts:
    """A face with everything that only facepipe's own stages hold."""
    parts = rich_face()
    lower = -np.arange(27.0).reshape(3, 9) - 1
    slider = p.Slider(
        name="open",
        group="jaw",
        default=0.25,
        minimum=-1.0,
        value=0.5,
        channels=(("root/jaw", "rx", 0.5), ("root/jaw/lip", "ty", -2.0)),
        shapes=(("jawOpen", 0.75),),
    )
    return replace(
        parts,
        sliders=(slider,),
        bone_limits=p.BoneLimits(lower=lower, upper=-2 * lower),
        attach_joint="body/neck",
        attribution="© someone, CC BY 4.0",
    )


@pytest.mark.parametrize("root", [None, HEAD])
def test_what_only_a_face_holds_comes_along(root: str | None, tmp_path: Path) -> None:
    parts = own_face()
    options = {} if root is None else {"prim": root, "skeleton": SKELETON}
    found = read(written(author(parts), tmp_path / "face.usda"), **options).parts
    assert found.sliders == parts.sliders
    assert found.attach_joint == "body/neck"
    assert found.attribution == "© someone, CC BY 4.0"
    assert found.bone_limits is not None
    assert parts.bone_limits is not None
    assert (found.bone_limits.lower == parts.bone_limits.lower).all()
    assert (found.bone_limits.upper == parts.bone_limits.upper).all()


def test_bone_limits_stay_with_their_joints_when_these_are_reordered(tmp_path: Path) -> None:
    parts = own_face()
    stage = author(parts)
    late_parents(stage)
    for name in ("lower", "upper"):
        limits = attribute(stage, f"{SKELETON}.facepipe:boneLimits:{name}")
        limits.Set(to_floats(floats(limits.Get()).reshape(3, 9)[[2, 0, 1]].ravel()))
    found = read(written(stage, tmp_path / "face.usda")).parts
    assert found.skeleton.joints == parts.skeleton.joints
    assert found.bone_limits is not None
    assert parts.bone_limits is not None
    assert (found.bone_limits.lower == parts.bone_limits.lower).all()


def test_sliders_follow_joints_that_are_renamed_and_lose_what_is_not_there(tmp_path: Path) -> None:
    stage = author(own_face())
    attribute(stage, f"{SKELETON}.joints").Set(["root", "root/jaw.1", "root/jaw.1/lip"])
    attribute(stage, "/Rich.facepipe:slider:open:joints").Set(["root/jaw.1", "nose"])
    imported = read(written(stage, tmp_path / "face.usda"))
    (slider,) = imported.parts.sliders
    assert slider.channels == (("root/jaw_1", "rx", 0.5),)
    assert slider.shapes == (("jawOpen", 0.75),)
    warned(imported, "slider open: 1 of its channels and shapes left out")


def test_damaged_sliders_and_limits_are_left_out_and_the_licence_is_not(tmp_path: Path) -> None:
    stage = author(own_face())
    attribute(stage, f"{SKELETON}.facepipe:boneLimits:lower").Set([1.0, 2.0])
    attribute(stage, "/Rich.facepipe:slider:open:channelGains").Set([1.0])
    stage.GetPrimAtPath("/Rich").RemoveAppliedSchema("FacepipeFaceAPI")
    imported = read(written(stage, tmp_path / "face.usda"))
    assert imported.parts.sliders == ()
    assert imported.parts.bone_limits is None
    assert imported.parts.attribution == "© someone, CC BY 4.0"
    warned(imported, "sliders left out")
    warned(imported, "bone limits left out")


def test_a_learned_network_without_its_sliders_is_left_out(tmp_path: Path) -> None:
    stage = author(networked(network()))
    assert read(written(stage, tmp_path / "face.usda")).parts.slider_network is not None
    attribute(stage, "/Tiny.facepipe:slider:jaw:channelGains").Set([1.0])  # of two: no sliders of this face are read
    imported = read(written(stage, tmp_path / "other.usda"))
    assert imported.parts.slider_network is None
    warned(imported, "a learned network of sliders left out: another is kept, or its sliders are missing")


def test_every_licence_on_a_stage_is_kept(tmp_path: Path) -> None:
    stage = author(own_face())
    other = stage.GetPrimAtPath(HEAD).CreateAttribute("facepipe:attribution", Sdf.ValueTypeNames.String)
    other.Set("© another, CC0")
    found = read(written(stage, tmp_path / "face.usda")).parts
    assert found.attribution == "© someone, CC BY 4.0; © another, CC0"
