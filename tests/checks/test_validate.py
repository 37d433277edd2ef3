"""Every defect that a stage can have is found under its name; good faces are clean."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import facepipe_gltf
import numpy as np
import pytest
import small_head as sample
from faces import tiny_face
from full_faces import good_face
from import_data import shared
from layers import attribute
from neural_faces import neural_rig
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel

import facepipe
from facepipe import parts as p
from facepipe.checks import CHECKS, validate, validate_stage
from facepipe.checks.checks import available, register
from facepipe.core.errors import InputError
from facepipe.core.reading import digest
from facepipe.importers import load
from facepipe.neural import save_neural_rig
from facepipe.stage import Face, save_parts
from facepipe.stage.recipes import author_neural_rig_link
from facepipe.stage.sliders import author_slider_network

NAN = float("nan")
RIGS = tempfile.TemporaryDirectory()  # of neural rigs that stages link


def changed(path: str, change: Callable[[list], list]) -> Callable[[Usd.Stage], None]:
    """A seed that replaces the array at `path` by a changed one."""

    def seed(stage: Usd.Stage) -> None:
        found = attribute(stage, path)
        assert found.Set(change(list(found.Get())))

    return seed


def value(path: str, new: object) -> Callable[[Usd.Stage], None]:
    """A seed that sets `path`."""

    def seed(stage: Usd.Stage) -> None:
        assert attribute(stage, path).Set(new)

    return seed


def first(new: object) -> Callable[[list], list]:
    return lambda old: [new, *old[1:]]


def upside_down(stage: Usd.Stage) -> None:
    """Seeds landmarks whose eyes lie below the chin: the rows of the grid go up."""
    head = stage.GetPrimAtPath("/Tiny/Head")
    assert head.ApplyAPI("FacepipeLandmarksAPI", "multipie68")
    marks = [0] * 68
    marks[8], marks[27], marks[36], marks[45] = 32, 2, 0, 5
    assert head.GetAttribute("facepipe:landmarks:multipie68:indices").Set(marks)


def shorter(old: list) -> list:
    return old[:-1]


def scaled(factor: float) -> Callable[[list], list]:
    return lambda old: [one * factor for one in old]


def interleaved(old: list) -> list:
    return old[::-1]


def remove_api(path: str) -> Callable[[Usd.Stage], None]:
    def seed(stage: Usd.Stage) -> None:
        assert stage.GetPrimAtPath(path).RemoveAPI(UsdSkel.BindingAPI)

    return seed


def remove(path: str) -> Callable[[Usd.Stage], None]:
    def seed(stage: Usd.Stage) -> None:
        assert stage.GetPrimAtPath(Sdf.Path(path).GetPrimPath()).RemoveProperty(path.rpartition(".")[2])

    return seed


def no_skel_root(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/Tiny").SetTypeName("Xform")


def no_face(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/Tiny").RemoveAppliedSchema("FacepipeFaceAPI")


def no_default(stage: Usd.Stage) -> None:
    stage.ClearDefaultPrim()


def no_units(stage: Usd.Stage) -> None:
    stage.GetRootLayer().pseudoRoot.ClearInfo("metersPerUnit")


def no_up_axis(stage: Usd.Stage) -> None:
    stage.GetRootLayer().pseudoRoot.ClearInfo("upAxis")


def no_mesh(stage: Usd.Stage) -> None:
    for prim in [one for one in stage.Traverse() if one.IsA(UsdGeom.Mesh)]:
        stage.RemovePrim(prim.GetPath())


def x_up(stage: Usd.Stage) -> None:
    stage.GetRootLayer().pseudoRoot.SetInfo("upAxis", "X")


def no_image(stage: Usd.Stage) -> None:
    shaders = [prim for prim in stage.Traverse() if prim.GetAttribute("inputs:file")]
    shaders[0].GetAttribute("inputs:file").Set(Sdf.AssetPath(__file__))


def variant_of_nothing(stage: Usd.Stage) -> None:
    """The head's material is gone in one of two variants."""
    spec = stage.GetRootLayer().GetPrimAtPath("/Tiny/Head")
    target = spec.relationships["material:binding"].targetPathList.explicitItems[0]
    del spec.properties["material:binding"]
    chosen = stage.GetPrimAtPath("/Tiny").GetVariantSets().AddVariantSet("shadingVariant")
    for name, shown in (("dark", "/Tiny/Materials/gone"), ("default", target)):
        chosen.AddVariant(name)
        chosen.SetVariantSelection(name)
        with chosen.GetVariantEditContext():
            stage.GetPrimAtPath("/Tiny/Head").CreateRelationship("material:binding", False).SetTargets([shown])


def second_skeleton(stage: Usd.Stage) -> None:
    UsdSkel.BindingAPI.Apply(UsdSkel.Skeleton.Define(stage, "/Tiny/Other").GetPrim())


def unbound(stage: Usd.Stage) -> None:
    relationship = stage.GetRelationshipAtPath("/Tiny/Head.skel:skeleton")
    relationship.SetTargets(["/Tiny/Nowhere"])


def broken_reference(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/Tiny/Teeth").GetReferences().AddReference("./gone.usda")


def element_size(stage: Usd.Stage) -> None:
    UsdGeom.Primvar(attribute(stage, HEAD + "primvars:skel:jointIndices")).SetElementSize(2)


def constant_region(stage: Usd.Stage) -> None:
    UsdGeom.Primvar(attribute(stage, HEAD + "primvars:facepipe:region:neck")).SetInterpolation("constant")


def dangling(stage: Usd.Stage) -> None:
    relationship = stage.GetRelationshipAtPath("/Tiny/Head.skel:blendShapeTargets")
    relationship.SetTargets([relationship.GetTargets()[0], "/Tiny/Head/gone"])


def target_is_a_mesh(stage: Usd.Stage) -> None:
    relationship = stage.GetRelationshipAtPath("/Tiny/Head.skel:blendShapeTargets")
    relationship.SetTargets([relationship.GetTargets()[0], "/Tiny/Head"])


def one_target(stage: Usd.Stage) -> None:
    relationship = stage.GetRelationshipAtPath("/Tiny/Head.skel:blendShapeTargets")
    relationship.SetTargets(relationship.GetTargets()[:1])


def empty_network(stage: Usd.Stage) -> None:
    assert stage.GetDefaultPrim().ApplyAPI("FacepipeSliderNetworkAPI")


def network_of_an_unknown_slider(stage: Usd.Stage) -> None:
    own = p.SliderNetwork(sliders=("gone",), shapes=("jawOpen",), weights=(np.ones((1, 1)),), biases=(np.zeros(1),))
    author_slider_network(stage.GetDefaultPrim(), own)


def neural(name: str = "head.fpnr", digest_of: str = "head.fpnr", topology: str = "") -> Callable[[Usd.Stage], None]:
    """A seed that links a neural rig: of a name, with the digest of another, or one that was learned elsewhere."""

    def seed(stage: Usd.Stage) -> None:
        folder, face = Path(RIGS.name), Face(stage)
        rig = neural_rig(face.parts(), bones=False)
        rig = replace(rig, topology=topology or rig.topology)
        save_neural_rig(rig, folder / "head.fpnr", {})
        save_neural_rig(replace(rig, linear=2.0 * rig.linear), folder / "other.fpnr", {})
        author_neural_rig_link(face.prim, f"{RIGS.name}/{name}", digest([folder / digest_of]), rig.topology)

    return seed


def late_parent(stage: Usd.Stage) -> None:
    """All that is parallel to the joints moves along: only their order is wrong."""
    for name in ("joints", "bindTransforms", "restTransforms"):
        found = attribute(stage, SKELETON + name)
        old = list(found.Get())
        found.Set([old[1], old[0], old[2]])


def inbetween_twice(stage: Usd.Stage) -> None:
    shape = UsdSkel.BlendShape(stage.GetPrimAtPath("/Tiny/Head/jawOpen"))
    other = shape.CreateInbetween("again")
    other.SetWeight(0.5)
    other.SetOffsets(shape.GetInbetween("half").GetOffsets())


def inbetween_at_one(stage: Usd.Stage) -> None:
    UsdSkel.BlendShape(stage.GetPrimAtPath("/Tiny/Head/jawOpen")).GetInbetween("half").SetWeight(1.0)


def clip_sample(name: str, new: object) -> Callable[[Usd.Stage], None]:
    def seed(stage: Usd.Stage) -> None:
        assert attribute(stage, f"/Tiny/Animations/clip.{name}").Set(new, 6.0)

    return seed


def unordered_points(stage: Usd.Stage) -> None:
    """pointIndices and all that follows them, reversed."""
    for name in ("pointIndices", "offsets", "normalOffsets", "inbetweens:half"):
        found = attribute(stage, SHAPE + name)
        found.Set(list(found.Get())[::-1])


def wrong_type(stage: Usd.Stage) -> None:
    spec = stage.GetRootLayer().GetPrimAtPath("/Tiny/Head")
    del spec.properties["doubleSided"]
    Sdf.AttributeSpec(spec, "doubleSided", Sdf.ValueTypeNames.String).default = "yes"


HEAD, SHAPE, SKELETON = "/Tiny/Head.", "/Tiny/Head/jawOpen.", "/Tiny/Skeleton."
POSE, SLIDER = "/Tiny/Animations/pose.", "/Tiny.facepipe:slider:open:"
PHOTO = "/Tiny/Photos/portrait."
WEIGHTS, INDICES = HEAD + "primvars:skel:jointWeights", HEAD + "primvars:skel:jointIndices"
SINGULAR = Gf.Matrix4d().SetScale(Gf.Vec3d(1, 0, 1))
PROJECTIVE = Gf.Matrix4d(1)
PROJECTIVE.SetColumn(3, Gf.Vec4d(0, 0, 1, 1))
SUBSETS = "usdGeomValidators:SubsetFamilies.InvalidSubsetFamily"
MIRRORED = Gf.Matrix4d().SetScale(Gf.Vec3d(-1, 1, 1))
UNTYPED = "usdValidation:AttributeTypeMismatch.AttributeTypeMismatch"

DEFECTS: dict[str, tuple[Callable[[Usd.Stage], None], set[str]]] = {
    "weights that don't sum to 1": (changed(WEIGHTS, scaled(0.9)), {"SkinWeightsSum"}),
    "weights of one point": (changed(WEIGHTS, first(0.0)), {"SkinWeightsSum"}),
    "negative weight": (changed(WEIGHTS, lambda old: [-0.5, old[0] + old[1] + 0.5, *old[2:]]), {"SkinWeightsNegative"}),
    "joint index out of range": (changed(INDICES, first(3)), {"SkinJointIndices"}),
    "joint index below 0": (changed(INDICES, first(-1)), {"SkinJointIndices"}),
    "influence indices too short": (changed(INDICES, shorter), {"SkinInfluenceCount"}),
    "influence weights too short": (changed(WEIGHTS, lambda old: old[:-3]), {"SkinInfluenceCount"}),
    "unequal elementSize": (element_size, {"SkinElementSize", "SkinInfluenceCount"}),
    "no weights": (remove(WEIGHTS), {"SkinElementSize"}),
    "geomBindTransform not authored": (remove(HEAD + "primvars:skel:geomBindTransform"), {"GeomBindTransformAuthored"}),
    "singular geomBindTransform": (
        value(HEAD + "primvars:skel:geomBindTransform", SINGULAR),
        {"GeomBindTransformSingular"},
    ),
    "pointIndices out of range": (
        changed(SHAPE + "pointIndices", lambda old: [*old[:-1], 36]),
        {"BlendshapePointIndices"},
    ),
    "huge point index": (
        changed(SHAPE + "pointIndices", lambda old: [*old[:-1], 2**31 - 1]),
        {"BlendshapePointIndices"},
    ),
    "pointIndices duplicated": (
        changed(SHAPE + "pointIndices", lambda old: [old[0], *old[:-1]]),
        {"BlendshapePointTwice"},
    ),
    "pointIndices unsorted": (unordered_points, {"BlendshapePointsUnsorted"}),
    "offsets too short": (changed(SHAPE + "offsets", shorter), {"BlendshapeOffsetCount"}),
    "normal offsets too short": (changed(SHAPE + "normalOffsets", shorter), {"BlendshapeOffsetCount"}),
    "inbetween offsets too short": (changed(SHAPE + "inbetweens:half", shorter), {"BlendshapeOffsetCount"}),
    "pointIndices too short": (changed(SHAPE + "pointIndices", shorter), {"BlendshapeOffsetCount"}),
    "fewer targets than shapes": (one_target, {"BlendshapeTargetCount"}),
    "fewer shapes than targets": (
        changed(HEAD + "skel:blendShapes", shorter),
        {"BlendshapeTargetCount"},
    ),
    "dangling target": (dangling, {"BlendshapeTargetDangling"}),
    "target of another type": (target_is_a_mesh, {"BlendshapeTargetDangling"}),
    "shape name twice": (changed(HEAD + "skel:blendShapes", lambda old: [old[0], old[0]]), {"BlendshapeNames"}),
    "inbetween at 1": (inbetween_at_one, {"InbetweenWeight"}),
    "two inbetweens at one weight": (inbetween_twice, {"InbetweenWeight"}),
    "bind transforms too short": (changed(SKELETON + "bindTransforms", shorter), {"JointTransformCount"}),
    "rest transforms too short": (changed(SKELETON + "restTransforms", shorter), {"JointTransformCount"}),
    "child joint before parent": (late_parent, {"JointOrder"}),
    "joint twice": (
        changed(SKELETON + "joints", lambda old: [*old[:-1], old[0]]),
        {"JointNames"},
    ),
    "joint name that is no path": (changed(SKELETON + "joints", lambda old: [*old[:-1], "a b//"]), {"JointNames"}),
    "singular bind matrix": (changed(SKELETON + "bindTransforms", first(SINGULAR)), {"BindTransformSingular"}),
    "projective rest matrix": (
        changed(SKELETON + "restTransforms", first(PROJECTIVE)),
        {"JointTransformAffine"},
    ),
    "negative joint scale at rest": (changed(SKELETON + "restTransforms", first(MIRRORED)), {"JointScaleNegative"}),
    "negative joint scale at bind": (changed(SKELETON + "bindTransforms", first(MIRRORED)), {"JointScaleNegative"}),
    "negative joint scale in a pose": (value(POSE + "scales", [Gf.Vec3h(1, -1, 1)]), {"JointScaleNegative"}),
    "negative joint scale in a clip": (clip_sample("scales", [Gf.Vec3h(-1, 1, 1)]), {"JointScaleNegative"}),
    "bone limits too short": (changed(SKELETON + "facepipe:boneLimits:upper", shorter), {"BoneLimits"}),
    "bone limits crossed": (changed(SKELETON + "facepipe:boneLimits:lower", first(9.0)), {"BoneLimits"}),
    "animation translations too many": (
        changed(POSE + "translations", lambda old: [*old, old[0]]),
        {"AnimationCount"},
    ),
    "animation rotations of one sample": (
        clip_sample("rotations", [Gf.Quatf(1), Gf.Quatf(1)]),
        {"AnimationCount"},
    ),
    "animation weights of one sample": (clip_sample("blendShapeWeights", [0.5, 0.5]), {"AnimationCount"}),
    "bone coefficients too short": (
        clip_sample("facepipe:boneCoefficients", [0.0] * 8),
        {"AnimationCount"},
    ),
    "animation scales not authored": (remove(POSE + "scales"), {"AnimationTransforms"}),
    "animation of unknown joint": (value(POSE + "joints", ["root/nose"]), {"AnimationNames"}),
    "animation of unknown shape": (value("/Tiny/Animations/clip.blendShapes", ["smirk"]), {"AnimationNames"}),
    "rotation of length 2": (value(POSE + "rotations", [Gf.Quatf(2)]), {"AnimationRotations"}),
    "SkelBindingAPI missing on a mesh": (remove_api("/Tiny/Head"), {"SkelBindingAPI"}),
    "SkelBindingAPI missing on the skeleton": (remove_api("/Tiny/Skeleton"), {"SkelBindingAPI"}),
    "SkelRoot missing": (
        no_skel_root,
        {"SkelRoot", "usdSkelValidators:SkelBindingApiValidator.InvalidSkelBindingAPIApply"},
    ),
    "no face": (no_face, {"FacePrim"}),
    "no default prim": (no_default, {"DefaultPrim", "usdValidation:StageMetadataChecker.MissingDefaultPrim"}),
    "no mesh": (no_mesh, {"HasMesh", "AnimationNames"}),  # clips name shapes that are gone with the meshes
    "up axis X": (x_up, {"StageUnits"}),
    "texture that is no image": (no_image, {"Textures"}),
    "variant of a material that is gone": (variant_of_nothing, {"MaterialVariants"}),
    "metersPerUnit not authored": (no_units, {"StageUnits"}),
    "upAxis not authored": (no_up_axis, {"StageUnits"}),
    "two skeletons": (second_skeleton, {"SkeletonCount"}),
    "bound to nothing": (unbound, {"SkeletonBound"}),
    "reference to nothing": (
        broken_reference,
        {"Composition", "usdUtilsValidators:MissingReferenceValidator.UnresolvableDependency"},
    ),
    "value of another type": (wrong_type, {UNTYPED}),
    "NaN in points": (changed(HEAD + "points", first(Gf.Vec3f(NAN, 0, 0))), {"Finite"}),
    "NaN in offsets": (changed(SHAPE + "offsets", first(Gf.Vec3f(0, NAN, 0))), {"Finite"}),
    "infinity in weights": (changed(WEIGHTS, first(float("inf"))), {"Finite"}),
    "NaN in a bind transform": (changed(SKELETON + "bindTransforms", first(Gf.Matrix4d(NAN))), {"Finite"}),
    "NaN in a clip": (clip_sample("translations", [Gf.Vec3f(NAN)]), {"Finite"}),
    "NaN in a slider": (value(SLIDER + "maximum", NAN), {"Finite"}),
    "face counts too few": (changed(HEAD + "faceVertexCounts", first(3)), {"MeshTopology"}),
    "face index out of range": (changed(HEAD + "faceVertexIndices", first(99)), {"MeshTopology"}),
    "UV indices out of range": (changed(HEAD + "primvars:st:indices", first(7)), {"PrimvarCount"}),
    "UV indices too short": (changed(HEAD + "primvars:st:indices", shorter), {"PrimvarCount"}),
    "normals too short": (changed(HEAD + "normals", shorter), {"NormalCount"}),
    "GeomSubset of points out of range": (value("/Tiny/Head/lips.indices", [3, 36]), {"SubsetIndices", SUBSETS}),
    "GeomSubset of faces out of range": (value("/Tiny/Head/Lips_faces.indices", [25]), {"SubsetIndices", SUBSETS}),
    "regions not summing to 1": (changed(HEAD + "primvars:facepipe:region:neck", scaled(0.5)), {"RegionSum"}),
    "region too short": (changed(HEAD + "primvars:facepipe:region:neck", shorter), {"RegionCount"}),
    "region of constant interpolation": (constant_region, {"RegionCount"}),
    "region above 1": (
        lambda stage: [
            changed(HEAD + "primvars:facepipe:region:neck", first(1.5))(stage),
            changed(HEAD + "primvars:facepipe:region:mouth", first(-0.5))(stage),
        ][0],
        {"RegionRange"},
    ),
    "landmarks out of range": (changed(HEAD + "facepipe:landmarks:corners:indices", first(36)), {"LandmarkIndices"}),
    "landmark names too few": (changed(HEAD + "facepipe:landmarks:corners:names", shorter), {"LandmarkNames"}),
    "landmarks of a face upside down": (upside_down, {"Plausible"}),
    "anchor out of range": (value(HEAD + "facepipe:anchor", 36), {"AnchorIndex"}),
    "person of no pose": (value("/Tiny.facepipe:person", "nobody"), {"PersonPose"}),
    "slider lists not parallel": (value(SLIDER + "channelGains", [0.5, 0.5]), {"SliderLists"}),
    "slider default out of range": (value(SLIDER + "default", 2.0), {"SliderRange"}),
    "slider value out of range": (value(SLIDER + "value", -1.0), {"SliderValue"}),
    "slider of unknown joint": (value(SLIDER + "joints", ["root/nose"]), {"SliderTargets"}),
    "slider of unknown channel": (value(SLIDER + "channels", ["qx"]), {"SliderTargets"}),
    "curve of a slider with one amount": (
        lambda stage: [
            value(SLIDER + "channelKnots", [2])(stage),
            value(SLIDER + "knotValues", [0.0, 1.0])(stage),
            value(SLIDER + "knotAmounts", [0.0])(stage),
        ][0],
        {"SliderCurves"},
    ),
    "knots of a slider's curve that descend": (
        lambda stage: [
            value(SLIDER + "channelKnots", [2])(stage),
            value(SLIDER + "knotValues", [1.0, 0.0])(stage),
            value(SLIDER + "knotAmounts", [0.0, 1.0])(stage),
        ][0],
        {"SliderCurves"},
    ),
    "curves of fewer channels than a slider has": (value(SLIDER + "channelKnots", [0, 0]), {"SliderCurves"}),
    "slider whose mirror is unknown": (value(SLIDER + "mirror", "shut"), {"SliderMirrors"}),
    "slider that is its own mirror": (value(SLIDER + "mirror", "open"), {"SliderMirrors"}),
    "network of no layers": (empty_network, {"SliderNetwork"}),
    "network of an unknown slider": (network_of_an_unknown_slider, {"SliderNetwork"}),
    "neural rig that is lost": (
        neural("gone.fpnr"),
        {"NeuralRigFile", "usdUtilsValidators:MissingReferenceValidator.UnresolvableDependency"},
    ),
    "neural rig that has changed": (neural(digest_of="other.fpnr"), {"NeuralRigDigest"}),
    "neural rig of other meshes": (neural(topology="other"), {"NeuralRigTopology"}),
    "photo without size": (value(PHOTO + "facepipe:photo:size", Gf.Vec2i(0, 960)), {"PhotoCameras"}),
    "photo of an orthographic camera": (value(PHOTO + "projection", "orthographic"), {"PhotoCameras"}),
    "photo of a camera without lens": (value(PHOTO + "focalLength", 0.0), {"PhotoCameras"}),
    "photo clipped away": (value(PHOTO + "clippingRange", Gf.Vec2f(4, 4)), {"PhotoCameras"}),
    "photo of oblong pixels": (value(PHOTO + "verticalAperture", 1.0), {"PhotoCameras"}),
    "photo with little light": (changed(PHOTO + "facepipe:photo:light", shorter), {"PhotoLight"}),
    "photo without a tint": (value(PHOTO + "facepipe:photo:tints", []), {"PhotoLight"}),
    "photo with a negative tint": (changed(PHOTO + "facepipe:photo:tints", scaled(-1)), {"PhotoLight"}),
    "key light from nowhere": (value(PHOTO + "facepipe:photo:key:direction", Gf.Vec3f(0)), {"PhotoKeyLight"}),
    "key light that darkens": (value(PHOTO + "facepipe:photo:key:color", Gf.Vec3f(1, -1, 1)), {"PhotoKeyLight"}),
    "key light with a negative shine": (value(PHOTO + "facepipe:photo:key:shine", -1.0), {"PhotoKeyLight"}),
    "key light without exponent": (value(PHOTO + "facepipe:photo:key:exponent", 0.0), {"PhotoKeyLight"}),
    "photo of an unknown pose": (value(PHOTO + "facepipe:photo:animation", "gone"), {"PhotoPoses"}),
    "recipe that is no JSON": (value("/Tiny.facepipe:recipe:options", "{"), {"RecipeOptions"}),
    "recipe without digest": (value("/Tiny.facepipe:recipe:digests", []), {"RecipeDigests"}),
}


@pytest.fixture(scope="module")
def good_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "face.usda"
    save_parts(good_face(), path)
    return path


def seeded(good: Path, folder: Path, seed: Callable[[Usd.Stage], None]) -> Path:
    """The good face with one defect, as a file."""
    stage = Usd.Stage.Open(str(good))
    target = folder / "face.usda"
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.TransferContent(stage.Flatten())
    broken = Usd.Stage.Open(layer)
    seed(broken)
    assert layer.Export(str(target))
    return target


@pytest.mark.parametrize("name", list(DEFECTS))
def test_a_defect_is_found_under_its_name_and_no_other(
    name: str, good_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FACEPIPE_ROOTS", RIGS.name)  # which files that a face links may lie in
    seed, expected = DEFECTS[name]
    if not available():  # older USD runs none of its own validators from Python
        expected = {one for one in expected if not one.startswith("usd")}
    found = validate(seeded(good_file, tmp_path, seed))
    assert {one.check.removeprefix("facepipe:") for one in found} == expected
    for one in found:
        assert one.where.startswith("face.usda -> </")
        assert "\n" not in one.message


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_good_faces_are_clean(suffix: str, tmp_path: Path) -> None:
    for name, parts in (("full", good_face()), ("tiny", tiny_face())):
        save_parts(parts, tmp_path / f"{name}{suffix}")
        assert validate(tmp_path / f"{name}{suffix}") == ()


@pytest.mark.parametrize(
    "make",
    [
        lambda: sample.make(0),
        pytest.param(lambda: load("ict", shared("ict_facekit/ict_facekit.npz")).parts, marks=pytest.mark.slow),
        lambda: load("makehuman", shared("makehuman/makehuman_head.npz")).parts,
    ],
    ids=["sample", "ict", "makehuman"],
)
def test_whole_faces_are_clean(make: Callable[[], p.FaceParts], tmp_path: Path) -> None:
    save_parts(make(), tmp_path / "face.usdc")
    assert validate(tmp_path / "face.usdc") == ()
    facepipe_gltf.export(facepipe.open(tmp_path / "face.usdc"), tmp_path / "face.glb")
    assert facepipe_gltf.validate(tmp_path / "face.glb", khronos=False) == ()


def test_every_defect_of_a_stage_is_found_each_with_its_prim(good_file: Path, tmp_path: Path) -> None:
    def seed(stage: Usd.Stage) -> None:
        changed(WEIGHTS, scaled(0.9))(stage)
        changed(SHAPE + "offsets", shorter)(stage)
        changed("/Tiny/Teeth/jawOpen.offsets", shorter)(stage)
        changed(SKELETON + "bindTransforms", first(SINGULAR))(stage)

    found = {(one.check, one.where.partition(" -> ")[2]) for one in validate(seeded(good_file, tmp_path, seed))}
    assert found == {
        ("facepipe:SkinWeightsSum", "</Tiny/Head.primvars:skel:jointWeights>"),
        ("facepipe:BlendshapeOffsetCount", "</Tiny/Head/jawOpen.offsets>"),
        ("facepipe:BlendshapeOffsetCount", "</Tiny/Teeth/jawOpen.offsets>"),
        ("facepipe:BindTransformSingular", "</Tiny/Skeleton.bindTransforms>"),
    }


def test_every_check_has_a_seeded_defect() -> None:
    seeded_names = {name for _, names in DEFECTS.values() for name in names}
    assert {check.name for check in CHECKS} - seeded_names == {"ReadableValues", "SkinMeshJoints"}


def test_mesh_joints_must_be_joints_of_the_skeleton(good_file: Path, tmp_path: Path) -> None:
    def seed(stage: Usd.Stage) -> None:
        UsdSkel.BindingAPI(stage.GetPrimAtPath("/Tiny/Head")).CreateJointsAttr(["root", "root/jaw", "root/nose"])

    found = validate(seeded(good_file, tmp_path, seed))
    assert [one.check for one in found] == ["facepipe:SkinMeshJoints"]


@pytest.mark.skipif(not available(), reason="this USD takes no checks written in Python (before 26.05)")
def test_checks_run_inside_usd(good_file: Path, tmp_path: Path) -> None:
    from pxr import UsdValidation

    assert register()
    assert register(), "registering again is harmless"
    registry = UsdValidation.ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(check.full_name) for check in CHECKS]
    assert all(validators)
    context = UsdValidation.ValidationContext(validators)
    assert context.Validate(Usd.Stage.Open(str(good_file))) == []
    broken = Usd.Stage.Open(str(seeded(good_file, tmp_path, changed(INDICES, first(3)))))
    (error,) = context.Validate(broken)
    assert error.GetIdentifier() == "facepipe:SkinJointIndices.SkinJointIndices"
    assert error.GetType() == UsdValidation.ValidationErrorType.Error
    assert "index 3 out of range" in error.GetMessage()


def test_a_foreign_stage_is_checked_too(tmp_path: Path) -> None:
    (tmp_path / "other.usda").write_text(
        '#usda 1.0\n(metersPerUnit=1\nupAxis="Y"\ndefaultPrim="A")\ndef Xform "A" {\n'
        'def Skeleton "S" (prepend apiSchemas=["SkelBindingAPI"]) {\nuniform token[] joints=["a"]\n}\n}\n'
    )
    found = {(one.check, one.where.rpartition(" -> ")[2]) for one in validate_stage(tmp_path / "other.usda")}
    assert {one for one in found if one[0].startswith("facepipe:")} == {
        ("facepipe:FacePrim", "</>"),
        ("facepipe:SkelRoot", "</A/S>"),
        ("facepipe:JointTransformCount", "</A/S.bindTransforms>"),
        ("facepipe:JointTransformCount", "</A/S.restTransforms>"),
    }


@pytest.mark.parametrize(("name", "content"), [("a.usda", b"nonsense"), ("a.txt", b"")])
def test_what_cannot_be_opened_is_an_input_error(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        validate(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        validate(tmp_path / f"gone{Path(name).suffix}")


def test_finding_of_numbers_names_the_worst(good_file: Path, tmp_path: Path) -> None:
    def seed(stage: Usd.Stage) -> None:
        weights = np.array(attribute(stage, WEIGHTS).Get()).reshape(-1, 3)
        weights[7] *= 0.25
        weights[3] *= 0.5
        attribute(stage, WEIGHTS).Set(weights.ravel().tolist())

    (found,) = validate(seeded(good_file, tmp_path, seed))
    assert "2 of 36 points" in found.message
    assert "point 7: 0.25" in found.message


@pytest.mark.skipif(not available(), reason="this USD takes no checks written in Python")
def test_importing_the_package_registers_every_check() -> None:
    program = (
        "import facepipe.checks\nfrom pxr import UsdValidation\n"
        "registry = UsdValidation.ValidationRegistry()\n"
        "assert all(registry.HasValidator(check.full_name) for check in facepipe.checks.CHECKS)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
