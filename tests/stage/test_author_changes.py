"""Changes of a face authored over it: the file read again is the changed face, and holds nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faces import replace_mesh, with_head
from full_faces import good_face
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracle import bake, difference
from parts_differences import assert_same
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel

import facepipe
from facepipe import parts as p
from facepipe.checks import validate_stage
from facepipe.core import tokens
from facepipe.core.errors import FacepipeError, InputError
from facepipe.stage import save_parts
from facepipe.stage.author_changes import author_changes, author_levels
from facepipe.stage.values import to_floats, to_ints

Change = Callable[[p.FaceParts], p.FaceParts]

SHAPES = {"skel:blendShapes", "skel:blendShapeTargets"}
WHOLE_SHAPE = {"offsets", "pointIndices"}
WHOLE_INBETWEEN = WHOLE_SHAPE | {"normalOffsets", "inbetweens:half"}
SKIN = {"primvars:skel:jointIndices", "primvars:skel:jointWeights"}
SLIDER = {f"facepipe:slider:open:{one}" for one in ("group", "default", "minimum", "maximum")}
CHANNELS = {f"facepipe:slider:open:{one}" for one in ("joints", "channels", "channelGains")}
LANDMARKS = {f"facepipe:landmarks:corners:{one}" for one in ("indices", "names")}
JOINT_VALUES = {"translations", "rotations", "scales"}
POSE_VALUES = {"facepipe:boneCoefficients", "blendShapeWeights"}
RNG = np.random.default_rng(5)


def head(**changes: object) -> Change:
    return lambda parts: with_head(parts, **changes)


def teeth(**changes: object) -> Change:
    return lambda parts: replace(parts, meshes=(parts.meshes[0], replace_mesh(parts.meshes[1], **changes)))


def shape(**changes: object) -> Change:
    """Change the first shape of the head, which has an inbetween."""
    return lambda parts: head(
        blendshapes=(replace(parts.meshes[0].blendshapes[0], **changes), *parts.meshes[0].blendshapes[1:])
    )(parts)


def inbetween(**changes: object) -> Change:
    return lambda parts: shape(inbetweens=(replace(parts.meshes[0].blendshapes[0].inbetweens[0], **changes),))(parts)


def skin(**changes: object) -> Change:
    return lambda parts: head(skin=replace(parts.meshes[0].skin, **changes))(parts)


def skeleton(**changes: object) -> Change:
    return lambda parts: replace(parts, skeleton=replace(parts.skeleton, **changes))


def clip(**changes: object) -> Change:
    return lambda parts: replace(parts, animations=(replace(parts.animations[0], **changes), *parts.animations[1:]))


def slider(**changes: object) -> Change:
    return lambda parts: replace(parts, sliders=(replace(parts.sliders[0], **changes),))


def face(**changes: object) -> Change:
    return lambda parts: replace(parts, **changes)


FULL = good_face()
HEAD, TEETH = FULL.meshes
JAW, SMILE = HEAD.blendshapes
HALF = JAW.inbetweens[0]
assert HEAD.skin is not None
MOVED = RNG.normal(size=(36, 3)).astype(np.float32)
OFFSETS = RNG.normal(size=(4, 3)).astype(np.float32)
WEIGHTS = RNG.dirichlet(np.ones(4), 36).astype(np.float32)
WIDE = p.Skin(joint_indices=np.tile(np.int32([2, 1, 0, 0]), (36, 1)), joint_weights=WEIGHTS)
RIGID = p.Skin(joint_indices=np.full((9, 1), 1, np.int32), joint_weights=np.ones((9, 1), np.float32))
TURN = np.array([[0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 1, 4], [0, 0, 0, 1.0]])
FINE = replace(SMILE, name="noseSneer", offsets=MOVED, inbetweens=(replace(HALF, offsets=MOVED, name="most"),))
LATER = p.Inbetween(name="late", weight=0.75, offsets=OFFSETS, normal_offsets=OFFSETS)
CLIP, POSE = FULL.animations
LIMITS = FULL.bone_limits
assert LIMITS is not None

CASES: dict[str, tuple[Change, set[str]]] = {
    "nothing": (lambda parts: parts, set()),
    "points": (head(points=MOVED), {"points", "extent"}),
    "points in double precision": (teeth(points=TEETH.points * (1 + 1e-12)), set()),
    "points of a loose mesh": (teeth(points=TEETH.points + 1), {"points", "extent"}),
    "normals": (head(normals=MOVED), {"normals"}),
    "normals by corner": (head(normals=RNG.random((100, 3)).astype(np.float32)), {"normals"}),
    "normals gone": (head(normals=None), {"normals"}),
    "normals new": (teeth(normals=TEETH.points + 1), {"normals"}),
    "offsets": (shape(offsets=OFFSETS), {"offsets"}),
    "normal offsets": (shape(normal_offsets=OFFSETS), {"normalOffsets"}),
    "normal offsets gone": (shape(normal_offsets=None), {"normalOffsets"}),
    "normal offsets new": (
        head(blendshapes=(JAW, replace(SMILE, normal_offsets=MOVED))),
        {"normalOffsets"},
    ),
    "moving set": (shape(point_indices=np.int32([0, 2, 9, 35])), WHOLE_INBETWEEN),
    "smaller moving set": (
        shape(
            point_indices=JAW.point_indices[:2],
            offsets=OFFSETS[:2],
            normal_offsets=None,
            inbetweens=(replace(HALF, offsets=OFFSETS[:2]),),
        ),
        WHOLE_INBETWEEN,
    ),
    "shape that moves nothing": (
        head(blendshapes=(JAW, replace(SMILE, point_indices=np.zeros(0, np.int32), offsets=np.zeros((0, 3))))),
        WHOLE_SHAPE,
    ),
    "inbetween": (inbetween(offsets=OFFSETS), {"inbetweens:half"}),
    "inbetween weight": (inbetween(weight=0.25), {"inbetweens:half"}),
    "inbetween normals": (inbetween(normal_offsets=OFFSETS), {"inbetweens:half", "inbetweens:half:normalOffsets"}),
    "inbetween new": (shape(inbetweens=(HALF, LATER)), {"inbetweens:late", "inbetweens:late:normalOffsets"}),
    "inbetween gone": (shape(inbetweens=()), WHOLE_SHAPE | {"normalOffsets", "skel:blendShapeTargets"} | SHAPES),
    "shape new": (head(blendshapes=(JAW, FINE, SMILE)), WHOLE_SHAPE | SHAPES | {"inbetweens:most"}),
    "shape gone": (head(blendshapes=(SMILE,)), SHAPES),
    "shape of a loose mesh gone": (teeth(blendshapes=()), SHAPES),
    "shapes in another order": (head(blendshapes=(SMILE, JAW)), SHAPES),
    "skin": (skin(joint_weights=WEIGHTS[:, :3] / WEIGHTS[:, :3].sum(axis=1, keepdims=True)), SKIN),
    "skin of more influences": (head(skin=WIDE), SKIN),
    "skin placed": (skin(geom_bind_transform=TURN), {"primvars:skel:geomBindTransform"}),
    "skin new": (teeth(skin=RIGID), SKIN | {"primvars:skel:geomBindTransform"}),
    "bind": (skeleton(bind_transforms=np.stack([TURN] * 3)), {"bindTransforms"}),
    "rest": (skeleton(rest_transforms=np.stack([TURN] * 3)), {"restTransforms"}),
    "clip": (clip(translations=CLIP.translations + 1), {"translations"}),  # type: ignore[operator]
    "clip without shapes": (clip(shapes=(), shape_weights=None), {"blendShapes", "blendShapeWeights"}),
    "clip without coefficients": (clip(coefficients=None), {"facepipe:boneCoefficients"}),
    "clip retimed": (
        clip(times=CLIP.times * 2),  # type: ignore[operator]
        JOINT_VALUES | POSE_VALUES | {"joints", "blendShapes"},
    ),
    "clip becomes pose": (
        face(animations=(replace(POSE, name="clip"), POSE)),
        JOINT_VALUES | POSE_VALUES | {"joints", "blendShapes"},
    ),
    "clip gone": (face(animations=(POSE,)), set()),
    "pose new": (face(animations=(CLIP, POSE, replace(POSE, name="q"))), JOINT_VALUES | {"joints"}),
    "slider": (slider(maximum=2.0, channels=()), SLIDER | CHANNELS | {"facepipe:slider:open:value"}),
    "slider at its default": (slider(value=None), {"facepipe:slider:open:value"}),
    "slider at another value": (slider(value=0.75), {"facepipe:slider:open:value"}),
    "slider gone": (face(sliders=()), SLIDER | CHANNELS | {"facepipe:slider:open:value"}),
    "slider new": (
        face(sliders=(*FULL.sliders, p.Slider(name="open:wide", shapes=(("jawOpen", 1.0),)))),
        {one.replace("open", "open:wide") for one in SLIDER}
        | {"facepipe:slider:open:wide:shapes", "facepipe:slider:open:wide:shapeGains"},
    ),
    "limits": (
        face(bone_limits=replace(LIMITS, upper=LIMITS.upper * 2)),
        {"facepipe:boneLimits:lower", "facepipe:boneLimits:upper"},
    ),
    "limits gone": (face(bone_limits=None), {"facepipe:boneLimits:lower", "facepipe:boneLimits:upper"}),
    "region": (
        head(regions={"mouth": WEIGHTS[:, 0], "neck": 1 - WEIGHTS[:, 0]}),
        {"primvars:facepipe:region:mouth", "primvars:facepipe:region:neck"},
    ),
    "region gone": (
        head(regions={"mouth": np.ones(36, np.float32)}),
        {"primvars:facepipe:region:mouth", "primvars:facepipe:region:neck"},
    ),
    "region new": (
        head(regions={**HEAD.regions, "nose": np.zeros(36, np.float32)}),
        {"primvars:facepipe:region:nose"},
    ),
    "landmarks": (head(landmarks={"corners": p.Landmarks(indices=np.int32([1]))}), LANDMARKS),
    "landmarks gone": (head(landmarks={}), LANDMARKS),
    "anchor": (head(anchor=7), {"facepipe:anchor"}),
    "anchor gone": (head(anchor=None), {"facepipe:anchor"}),
    "texts": (face(attribution="(c) else", attach_joint=None), {"facepipe:attribution", "facepipe:attachJoint"}),
    "recipe gone": (
        face(recipe=None),
        {f"facepipe:recipe:{one}" for one in ("verb", "sources", "digests", "options", "version")},
    ),
}


def specs(file: Path) -> list[Sdf.Path]:
    """Paths of all property specs of one layer."""
    paths: list[Sdf.Path] = []
    layer = Sdf.Layer.OpenAsAnonymous(str(file))
    layer.Traverse("/", lambda path: paths.append(path))
    return [path for path in paths if path.IsPropertyPath()]


def in_order(parts: p.FaceParts) -> p.FaceParts:
    """Regions and sliders by name, as they are read, and animations as they are authored."""
    meshes = (replace_mesh(mesh, regions=dict(sorted(mesh.regions.items()))) for mesh in parts.meshes)
    return replace(parts, meshes=tuple(meshes), sliders=tuple(sorted(parts.sliders, key=lambda one: one.name)))


def read(file: Path) -> p.FaceParts:
    found = [one for one in validate_stage(file) if one.check != "facepipe:Plausible"]  # made-up faces have no size
    assert not found
    return facepipe.open(file).parts()


def same_content(one: p.FaceParts, other: p.FaceParts) -> None:
    """The same parts; animations are read in the order of prims, new ones last."""
    by_name = [
        replace(parts, animations=tuple(sorted(parts.animations, key=lambda one: one.name)))
        for parts in (in_order(one), other)
    ]
    assert_same(*by_name)


def changed(source: Path, out: Path, parts: p.FaceParts, *, flatten: bool = False, **more: object) -> tuple[str, ...]:
    with facepipe.open(source).deriving(out, flatten=flatten) as derived:
        return author_changes(derived, parts, **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("source") / "face.usda"
    save_parts(good_face(), file)
    return file


@pytest.mark.parametrize("name", CASES)
def test_the_layer_is_the_change(source: Path, tmp_path: Path, name: str) -> None:
    change, expected = CASES[name]
    parts, out = change(good_face()), tmp_path / "out.usda"
    lines = changed(source, out, parts)
    same_content(parts, read(out))
    assert {path.name for path in specs(out)} == expected
    assert bool(lines) == (name not in ("nothing", "points in double precision"))
    assert len(set(lines)) == len(lines)


def test_the_line_of_a_shape_names_its_inbetween_that_changed(source: Path, tmp_path: Path) -> None:
    assert changed(source, tmp_path / "out.usda", inbetween(weight=0.25)(good_face())) == (
        "Head: jawOpen: inbetween half",
    )


def test_scales_are_compared_in_half_precision(source: Path, tmp_path: Path) -> None:
    """SkelAnimation holds no more of them."""
    finer = clip(scales=np.asarray(CLIP.scales) + np.float32(1e-5))(good_face())
    assert changed(source, tmp_path / "out.usda", finer) == ()


def everything(parts: p.FaceParts) -> p.FaceParts:
    """A change of all that can change."""
    names = (
        "points", "normals gone", "shape new", "skin of more influences", "bind", "rest", "clip gone", "slider gone",
        "limits gone", "region gone", "landmarks gone", "anchor gone", "texts",
    )  # fmt: skip
    for name in names:
        parts = CASES[name][0](parts)
    dropped = (replace(JAW, inbetweens=(), normal_offsets=None), FINE)
    return head(blendshapes=dropped)(parts)


@pytest.mark.parametrize(("suffix", "flatten"), [(".usdc", False), (".usda", True), (".usdc", True), (".usdz", False)])
def test_every_kind_of_file_holds_the_change(source: Path, tmp_path: Path, suffix: str, flatten: bool) -> None:
    parts, out = everything(good_face()), tmp_path / f"out{suffix}"
    changed(source, out, parts, flatten=flatten)
    same_content(parts, read(out))


def test_options_of_a_recipe_have_no_order(tmp_path: Path) -> None:
    recipe = p.Recipe(verb="x", sources=(), digests=(), options={"a": 1, "b": {"c": 2, "d": 3}}, version="0")
    save_parts(replace(good_face(), recipe=recipe), tmp_path / "face.usda")
    parts = facepipe.open(tmp_path / "face.usda").parts()
    turned = replace(parts, recipe=replace(recipe, options={"b": {"d": 3, "c": 2}, "a": 1}))
    assert changed(tmp_path / "face.usda", tmp_path / "out.usda", turned) == ()


def test_changes_of_changes(source: Path, tmp_path: Path) -> None:
    """Layer over layer, and back again to what the first one was."""
    first, second = tmp_path / "first.usda", tmp_path / "second.usda"
    changed(source, first, everything(good_face()))
    changed(first, second, good_face())
    same_content(good_face(), read(second))


def test_point_values(source: Path, tmp_path: Path) -> None:
    """One array over all meshes; a mesh without values gets no primvar; the same values again author nothing."""
    out, again = tmp_path / "out.usda", tmp_path / "again.usda"
    values = {tokens.SEAM_RESIDUAL: np.concatenate([RNG.random(36), np.full(9, np.nan)])}
    assert changed(source, out, good_face(), primvars=values) == (f"Head: {tokens.SEAM_RESIDUAL}",)
    assert [path.GetPrimPath().name for path in specs(out)] == ["Head"]
    same_content(good_face(), read(out))
    np.testing.assert_array_equal(
        facepipe.open(out).primvar(tokens.SEAM_RESIDUAL), values[tokens.SEAM_RESIDUAL].astype(np.float32)
    )
    assert changed(out, again, good_face(), primvars=values) == ()


def other_topology(parts: p.FaceParts) -> p.FaceParts:
    indices = HEAD.face_vertex_indices.copy()
    indices[:2] = indices[1::-1]
    return head(face_vertex_indices=indices)(parts)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (head(points=np.zeros((35, 3))), "Head: 35 points, expected 36"),
        (other_topology, "Head: other faces"),
        (face(meshes=(HEAD,)), "meshes Head, expected Head, Teeth"),
        (skeleton(joints=("root", "root/jaw", "root/lip")), "Skeleton: other joints"),
        (skeleton(transform=TURN), "Skeleton -> transform: differs"),
        (head(skin=None), "Head -> skin: none"),
        (head(uv_sets=()), "Head -> uv_sets: differs"),
        (face(materials=()), "materials: differs"),
        (face(up_axis="Y"), "up_axis: differs"),
        (head(points=np.full((36, 3), np.nan)), "Head -> points: NaN"),
    ],
)
def test_what_an_override_layer_cannot_say_is_refused(
    source: Path, tmp_path: Path, change: Change, message: str
) -> None:
    with pytest.raises(FacepipeError, match=message):
        changed(source, tmp_path / "out.usda", change(good_face()))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("values", [np.zeros(44), np.r_[np.nan, np.zeros(44)], np.r_[np.inf, np.zeros(44)]])
def test_bad_point_values_are_refused(source: Path, tmp_path: Path, values: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"seamResidual: (NaN|values of shape)"):
        changed(source, tmp_path / "out.usda", good_face(), primvars={tokens.SEAM_RESIDUAL: values})


def edited(edit: Callable[[Usd.Stage], None], file: Path) -> Path:
    """The face as another tool might have written it."""
    save_parts(good_face(), file)
    stage = Usd.Stage.Open(Sdf.Layer.OpenAsAnonymous(str(file)))
    edit(stage)
    stage.GetRootLayer().Export(str(file))
    return file


def left_handed(stage: Usd.Stage) -> None:
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Tiny/Head"))
    mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)


def sampled(stage: Usd.Stage) -> None:
    """Points and normals in motion, over their default values."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Tiny/Head"))
    for time in (1.0, 2.0):
        mesh.GetPointsAttr().Set(mesh.GetPointsAttr().Get(), time)
        mesh.GetExtentAttr().Set(mesh.GetExtentAttr().Get(), time)


def normal_primvar(stage: Usd.Stage) -> None:
    """Indexed primvars:normals, which win over the attribute."""
    api = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Tiny/Head"))
    primvar = api.CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, UsdGeom.Tokens.vertex)
    primvar.Set([(0, 1, 0)])
    primvar.SetIndices([0] * 36)


def unsorted(stage: Usd.Stage) -> None:
    """A shape whose indices don't ascend, and one without indices."""
    shape = UsdSkel.BlendShape(stage.GetPrimAtPath("/Tiny/Head/jawOpen"))
    for attribute in (
        shape.GetPointIndicesAttr(), shape.GetOffsetsAttr(), shape.GetNormalOffsetsAttr(),
        shape.GetInbetween("half").GetAttr(),
    ):  # fmt: skip
        attribute.Set(list(attribute.Get())[::-1])
    UsdSkel.BlendShape(stage.GetPrimAtPath("/Tiny/Head/mouthSmileLeft")).GetPointIndicesAttr().Clear()


def own_joints(stage: Usd.Stage) -> None:
    """Joint indices into the mesh's own order of joints; both primvars of the skin indexed, from the last point."""
    binding = UsdSkel.BindingAPI(stage.GetPrimAtPath("/Tiny/Head"))
    binding.CreateJointsAttr(["root/jaw/lip", "root", "root/jaw"])
    for primvar, put in ((binding.GetJointIndicesPrimvar(), to_ints), (binding.GetJointWeightsPrimvar(), to_floats)):
        primvar.Set(put(np.reshape(primvar.Get(), (36, -1))[::-1]))
        primvar.SetIndices(list(range(36))[::-1])


def shared(stage: Usd.Stage) -> None:
    """One BlendShape prim that two meshes use."""
    shape = UsdSkel.BlendShape(stage.GetPrimAtPath("/Tiny/Teeth/jawOpen"))
    shape.GetOffsetsAttr().Set(shape.GetOffsetsAttr().Get())
    other = UsdSkel.BindingAPI(stage.GetPrimAtPath("/Tiny/Head"))
    other.CreateBlendShapesAttr(["jawOpen", "mouthSmileLeft", "chew"])
    other.GetBlendShapeTargetsRel().AddTarget("/Tiny/Teeth/jawOpen")


def instanced(stage: Usd.Stage) -> None:
    """The meshes in an instance."""
    layer = stage.GetRootLayer()
    stage.DefinePrim("/Library")
    for name in ("Head", "Teeth"):
        Sdf.CopySpec(layer, f"/Tiny/{name}", layer, f"/Library/{name}")
        stage.RemovePrim(f"/Tiny/{name}")
        binding = UsdSkel.BindingAPI(stage.GetPrimAtPath(f"/Library/{name}"))
        binding.GetSkeletonRel().ClearTargets(True)
        UsdShade.MaterialBindingAPI(binding.GetPrim()).UnbindAllBindings()
    group = stage.DefinePrim("/Tiny/Group", "Xform")
    UsdSkel.BindingAPI.Apply(group).CreateSkeletonRel().SetTargets(["/Tiny/Skeleton"])
    group.GetReferences().AddInternalReference("/Library")
    group.SetInstanceable(True)


@pytest.mark.parametrize("flatten", [False, True])
@pytest.mark.parametrize(
    "edit",
    [left_handed, sampled, normal_primvar, unsorted, own_joints, shared, instanced],
    ids=lambda one: one.__name__,
)
def test_stages_of_other_tools(source: Path, tmp_path: Path, edit: Callable[[Usd.Stage], None], flatten: bool) -> None:
    """Whatever the weaker layer looks like, the result is read as what was asked for."""
    other, out, none = edited(edit, tmp_path / "other.usda"), tmp_path / "out.usda", tmp_path / "none.usda"
    parts = facepipe.open(other).parts()
    assert changed(other, none, parts) == ()
    assert specs(none) == []
    own = parts.meshes[0]
    assert own.skin is not None
    corner = RNG.random((100, 3)).astype(np.float32)
    weights = WEIGHTS[:, :3] / WEIGHTS[:, :3].sum(axis=1, keepdims=True)
    shapes = [replace(blendshape, offsets=blendshape.offsets + 1) for blendshape in own.blendshapes]
    parts = head(
        points=own.points + MOVED, normals=corner, blendshapes=tuple(shapes),
        skin=replace(own.skin, joint_weights=weights),
    )(parts)  # fmt: skip
    changed(other, out, parts, flatten=flatten)
    again = facepipe.open(out)
    same_content(parts, again.parts())
    mesh = UsdGeom.Mesh(again.mesh_prim("Head"))
    np.testing.assert_array_equal(mesh.GetPointsAttr().Get(1.5), parts.meshes[0].points.astype(np.float32))
    assert changed(out, tmp_path / "third.usda", parts) == ()


def test_levels_of_meshes_in_an_instance(source: Path, tmp_path: Path) -> None:
    face, out = facepipe.open(edited(instanced, tmp_path / "other.usda")), tmp_path / "out.usda"
    names = [mesh.name for mesh in face.meshes]
    with face.deriving(out) as derived:
        author_levels(derived, [face.parts().meshes])
    again = facepipe.open(out)
    assert [mesh.name for mesh in again.meshes] == names
    assert again.levels == ("lod0", "lod1")
    assert [mesh.name for mesh in again.at_level(1).meshes] == names


def test_bounds_above_a_changed_mesh_are_computed_again(tmp_path: Path) -> None:
    def bound(stage: Usd.Stage) -> None:
        UsdGeom.Boundable(stage.GetDefaultPrim()).CreateExtentAttr([(0, 0, 0), (1, 1, 1)])

    other = edited(bound, tmp_path / "other.usda")
    parts = head(points=MOVED * 50)(facepipe.open(other).parts())
    boxes = []
    for name, wanted in (("none", facepipe.open(other).parts()), ("moved", parts)):
        changed(other, tmp_path / f"{name}.usda", wanted)
        stage = facepipe.open(tmp_path / f"{name}.usda").stage
        cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"])
        boxes.append(cache.ComputeWorldBound(stage.GetDefaultPrim()).ComputeAlignedRange().GetSize()[0])
    assert boxes[0] == 1
    assert boxes[1] > 100


GROUPS = (
    ("points",),
    ("normals", "normals by corner", "normals gone"),
    tuple(name for name in CASES if name.startswith(("offsets", "normal offsets", "moving", "inbetween", "shape"))),
    ("skin", "skin of more influences", "skin placed"),
    ("bind", "rest"),
    tuple(name for name in CASES if name.startswith(("clip", "pose"))),
    tuple(name for name in CASES if name.startswith("slider")),
    ("limits", "limits gone"),
    tuple(name for name in CASES if name.startswith("region")),
    ("landmarks", "landmarks gone"),
    ("anchor", "anchor gone"),
    ("texts", "recipe gone"),
)
CHOICES = st.tuples(*(st.sampled_from(("nothing", *group)) for group in GROUPS))


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(CHOICES, CHOICES)
def test_any_changes_over_any_changes(
    source: Path, tmp_path: Path, first: tuple[str, ...], second: tuple[str, ...]
) -> None:
    """Two layers, each with a change of every kind or none; the second knows nothing of the first."""
    below = source
    for number, names in enumerate((first, second)):
        parts, out = good_face(), tmp_path / f"out{number}.usda"
        for name in names:
            parts = CASES[name][0](parts)
        changed(below, out, parts)
        same_content(parts, read(out))
        below = out


def test_usdskel_deforms_the_layer_as_the_rig_does(source: Path, tmp_path: Path) -> None:
    """The oracle sees nothing of hidden shapes and inbetweens either."""
    out = tmp_path / "out.usda"
    changed(source, out, replace(everything(good_face()), skeleton=good_face().skeleton))
    face = facepipe.open(out)
    for shape in face.shapes:
        for weight in (0.3, 1.0):
            expected = bake(face, {shape: weight})
            assert difference(face, face.evaluate({shape: weight}), expected) < 1e-5
