"""Faces of other tools' UsdSkel stages, with facepipe's own attributes where they are or hold a face.

What such a stage leaves out or does differently is repaired in its session layer, which is never saved; then the
readers of facepipe's own stages read it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.errors import FacepipeError, TopologyError
from facepipe.core.names import identifier
from facepipe.parts import Animation, FaceParts, Mesh, Skeleton, Slider
from facepipe.rig.sliders import with_mutual_mirrors
from facepipe.stage.files import quiet_diagnostics
from facepipe.stage.foreign_motion import with_motion
from facepipe.stage.foreign_scene import (
    Scene,
    ancestors,
    bindings,
    bound_materials,
    choose_meshes,
    mend_meshes,
    note_custom,
)
from facepipe.stage.material_variants import Variants, read_variants
from facepipe.stage.prims import distinct_names, inherited_attribute, inherited_skeleton, is_applied
from facepipe.stage.read_mesh import Binding, read_mesh
from facepipe.stage.skeleton import read_animation, read_limits, read_skeleton, read_vrm, vrm_text
from facepipe.stage.sliders import read_slider_network, read_sliders
from facepipe.stage.uv_transforms import with_baked_uvs
from facepipe.stage.values import errors_below, floats, matrices, reads_prim, to_floats, to_matrices

_TWIN_NUMBER = re.compile(r"[._]?[0-9]+")
_SAME_WEIGHT = 1e-6  # weights nearer than this are one
Read = TypeVar("Read")


def choose_skeleton(scene: Scene, meshes: list[Usd.Prim], wanted: str | None) -> Usd.Prim | None:
    """The Skeleton of the face; None where the stage has none.

    :raises InputError: several Skeletons and no choice, or a choice that is no Skeleton
    """
    if wanted is not None:
        prim = scene.stage.GetPrimAtPath(wanted) if wanted.startswith("/") and wanted != "/" else None
        if not prim or not prim.IsA(UsdSkel.Skeleton):
            raise scene.error(f"no Skeleton at '{wanted}', expected the path of one")
        return prim
    named = dict.fromkeys(inherited_skeleton(mesh) for mesh in meshes)
    bound = [scene.stage.GetPrimAtPath(path) for path in named if path is not None and path.IsPrimPath()]
    there = [prim for prim in bound if prim and prim.IsA(UsdSkel.Skeleton)]
    # what no mesh is bound to may be left from a rig: it counts only where nothing is bound
    candidates = there or [prim for prim in scene.prims if prim.IsA(UsdSkel.Skeleton)]
    if len(candidates) > 1:
        listed = ", ".join(str(prim.GetPath()) for prim in candidates)
        raise scene.error(f"{len(candidates)} Skeletons ({listed}), expected one; the option skeleton chooses")
    chosen = candidates[0] if candidates else None
    others = [prim for prim in scene.prims if prim.IsA(UsdSkel.Skeleton) and prim != chosen]
    if others:
        scene.warn("Skeleton that no mesh is bound to: left out", others)
    return chosen


@reads_prim
def mend_skeleton(prim: Usd.Prim, scene: Scene, meshes: list[Usd.Prim]) -> None:
    """Joints parent first, and both kinds of transforms for each.

    :raises TopologyError: neither bind nor rest transforms that fit the joints
    """
    skeleton = UsdSkel.Skeleton(prim)
    joints = [str(joint) for joint in skeleton.GetJointsAttr().Get() or []]
    order, count = parents_first(joints), len(joints)
    bind = matrices(skeleton.GetBindTransformsAttr().Get())
    rest = matrices(skeleton.GetRestTransformsAttr().Get())
    parents = Skeleton(joints=tuple(joints)).parents.tolist()
    if len(bind) != count and len(rest) != count:
        found = f"{len(bind)} bind and {len(rest)} rest transforms"
        raise TopologyError(str(prim.GetPath()), f"{found}, expected {count} of one of them")
    # rest_j = inverse(bind_parent) bind_j; binds are in the world, so above a root is the place of the prim
    world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T
    if len(rest) != count:
        scene.warn(f"{len(rest)} rest transforms of {count} joints: taken from bind transforms", [prim])
        rest = np.full((count, 4, 4), np.nan)
        for i, parent in enumerate(parents):
            with contextlib.suppress(np.linalg.LinAlgError):  # the reader refuses what stays NaN
                rest[i] = np.linalg.solve(bind[parent] if parent >= 0 else world, bind[i])
    if len(bind) != count:
        scene.warn(f"{len(bind)} bind transforms of {count} joints: taken from rest transforms", [prim])
        bind = np.empty((count, 4, 4))
        for i in order:
            bind[i] = (bind[parents[i]] if parents[i] >= 0 else world) @ rest[i]
    if order != list(range(len(joints))):
        scene.warn("joints stand before their parents: reordered", [prim])
        for mesh in meshes:
            if not inherited_attribute(mesh, "skel:joints"):  # its indices count the old order
                UsdSkel.BindingAPI.Apply(mesh).CreateJointsAttr(joints)
    skeleton.CreateJointsAttr([joints[i] for i in order])
    names = [str(name) for name in skeleton.GetJointNamesAttr().Get() or []]
    if names and len(names) != len(order):
        scene.warn(f"{len(names)} names of {len(order)} joints: left out", [skeleton.GetPrim()])
        skeleton.GetJointNamesAttr().Block()
    elif names:
        skeleton.CreateJointNamesAttr([names[i] for i in order])
    skeleton.CreateBindTransformsAttr(to_matrices(bind[order]))
    skeleton.CreateRestTransformsAttr(to_matrices(rest[order]))
    for name in (tokens.LIMITS_LOWER, tokens.LIMITS_UPPER):
        limits = prim.GetAttribute(name)
        values = floats(limits.Get())
        if len(values) == 9 * len(joints) > 0:
            limits.Set(to_floats(values.reshape(-1, 9)[order].ravel()))


def parents_first(joints: list[str]) -> list[int]:
    """Indices of joint paths, each after its ancestors, otherwise in the order given."""
    place = {joint: i for i, joint in reversed(list(enumerate(joints)))}
    order: dict[int, None] = {}
    for i, joint in enumerate(joints):
        parts = joint.split("/")
        above = [place.get("/".join(parts[:depth])) for depth in range(1, len(parts))]
        order.update(dict.fromkeys([ancestor for ancestor in above if ancestor is not None]))
        order[i] = None
    return list(order)


def join_twins(
    scene: Scene, prims: Sequence[Usd.Prim], meshes: Sequence[Mesh], animations: Mapping[Usd.Prim, Animation]
) -> tuple[tuple[Mesh, ...], dict[Usd.Prim, Animation]]:
    """The meshes and animations with shapes that are the shape of another mesh called as that one.

    Such a twin is called as its prim is, with a number behind; another mesh has a shape of the prim's name, and no mesh
    has both.

    :param prims: those of the meshes
    """
    every: list[dict[str, str]] = []
    for prim in prims:
        api = UsdSkel.BindingAPI(prim)
        tokens_of = [str(token) for token in api.GetBlendShapesAttr().Get() or []]
        targets = [str(target.name) for target in api.GetBlendShapeTargetsRel().GetTargets()]
        every.append(dict(zip(tokens_of, targets, strict=False)))
    plain = {target: token for own in every for token, target in own.items() if _identifier(token) == target}
    twins: dict[str, str] = {}
    for own in every:
        for token, target in own.items():
            name, base = _identifier(token), plain.get(target)
            numbered = name.startswith(target) and _TWIN_NUMBER.fullmatch(name.removeprefix(target))
            if numbered and base is not None and base not in own:
                twins[token] = base
    twins = {token: base for token, base in twins.items() if token not in plain.values()}
    # one that an animation moves otherwise than the shape that it is stays by itself
    for animation in animations.values():
        weights = animation.shape_weights
        if weights is not None:
            column = {name: weights[:, i] for i, name in enumerate(animation.shapes)}
            pairs = {twin: [column.get(name, np.zeros(len(weights))) for name in (twin, twins[twin])] for twin in twins}
            apart = {twin for twin, (one, other) in pairs.items() if np.abs(one - other).max(initial=0) > _SAME_WEIGHT}
            twins = {twin: base for twin, base in twins.items() if twin not in apart}
    if not twins:
        return tuple(meshes), dict(animations)
    old, new = next(iter(twins.items()))
    scene.warn(f"{len(twins)} shapes joined with those of other meshes, by their prims' names: {old} is {new}")
    joined = []
    for mesh in meshes:
        shapes = (replace(shape, name=twins.get(shape.name, shape.name)) for shape in mesh.blendshapes)
        joined.append(replace(mesh, blendshapes=tuple(shapes)))
    played = {}
    for prim, animation in animations.items():
        kept = [i for i, shape in enumerate(animation.shapes) if shape not in twins]
        if len(kept) < len(animation.shapes) and animation.shape_weights is not None:
            names, weights = tuple(animation.shapes[i] for i in kept), animation.shape_weights[:, kept]
            animation = replace(animation, shapes=names, shape_weights=weights)
        played[prim] = animation
    return tuple(joined), played


def _identifier(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]", "_", name)


def read_foreign(
    path: Path,
    *,
    root: str | None = None,
    skeleton: str | None = None,
    variants: Mapping[str, str] | None = None,
    strict: bool = False,
) -> tuple[FaceParts, list[Path], list[str]]:
    """The face of a UsdSkel stage, repaired as far as its meaning is clear; the layers that were read, and warnings.

    :param root: path of the prim to read below; default the default prim, or the whole stage
    :param skeleton: path of the Skeleton, needed where meshes are bound to several
    :param variants: which to read, by variant set; of other sets those that the file selects
    :param strict: a texture that can't be read is an error, in place of left out
    :raises InputError: no readable stage, no meshes, no such variant, or a choice that has to be made
    :raises SchemaError, TopologyError: data that doesn't hold together
    """
    with quiet_diagnostics(), errors_below(str(path)):
        scene = Scene(path, root, variants or {}, strict=strict)
        meshes = choose_meshes(scene)
        # the skeleton first: which meshes are the face's depends on it
        prim = choose_skeleton(scene, meshes, skeleton)
        if prim is not None:
            # the meshes that are the skeleton's; those bound to nothing are bound to it
            bound, loose, others = [], [], []
            for mesh in meshes:
                place = inherited_skeleton(mesh)
                target = scene.stage.GetPrimAtPath(place) if place is not None and place.IsPrimPath() else None
                if target and target.IsA(UsdSkel.Skeleton) and target != prim:
                    others.append(mesh)
                    continue
                bound.append(mesh)
                if target != prim and inherited_attribute(mesh, "primvars:skel:jointIndices"):
                    loose.append(mesh)
                    UsdSkel.BindingAPI.Apply(mesh).CreateSkeletonRel().SetTargets([prim.GetPath()])
            if loose:
                scene.warn(f"influences, but no Skeleton: taken as bound to <{prim.GetPath()}>", loose)
            if others:
                scene.warn("bound to another Skeleton: left out", others)
            meshes = bound
            mend_skeleton(prim, scene, meshes)
        if not meshes:
            raise scene.error("no mesh to read, expected a face")
        mend_meshes(scene, meshes)
        note_custom(scene)
        parts = _parts(scene, meshes, prim)
        files = sorted(Path(layer.realPath) for layer in scene.stage.GetUsedLayers() if layer.realPath)
        return parts, files, scene.warnings


def _parts(scene: Scene, meshes: list[Usd.Prim], prim: Usd.Prim | None) -> FaceParts:
    skeleton = Skeleton() if prim is None else read_skeleton(prim)
    names = distinct_names(meshes, [str(mesh.GetName()) for mesh in meshes])
    # of faces of ours: what others call so may change more than materials
    faces = [one for one in _prims(scene) if is_applied(one, tokens.FACE_API)]
    variants = _sound(scene, "variants of materials", read_variants, faces[0], scene.path.name) if faces else None
    material_names, materials = bound_materials(scene, meshes, variants or Variants())
    queries = bindings(scene)
    read = []
    for mesh, name in zip(meshes, names, strict=True):
        query = queries.get(str(mesh.GetPath()))
        binding = Binding(query, skeleton.joints) if query is not None else None
        read.append(read_mesh(mesh, name, binding, material_names, unbound_shapes=True))
        if read[-1].blendshapes and (query is None or not query.HasBlendShapes()):
            scene.warn("blendshapes of a mesh without Skeleton, which UsdSkel never shows: read all the same", [mesh])
    sliders = _sliders(scene)
    source = None if prim is None else UsdSkel.BindingAPI(prim).GetInheritedAnimationSource() or None
    joined, animations = join_twins(scene, meshes, read, _animations(scene, source, skeleton, read))
    stage, face_name = scene.stage, str(scene.roots[0].GetName()) if len(scene.roots) == 1 else scene.path.stem
    unit, axis = float(UsdGeom.GetStageMetersPerUnit(stage)), str(UsdGeom.GetStageUpAxis(stage))
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        scene.warn(f"metersPerUnit not authored: taken as {unit:g}")
    if not 0 < unit < float("inf"):
        raise scene.error(f"metersPerUnit {unit:g}, expected a finite number above 0")
    if not stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis):
        scene.warn(f"upAxis not authored: taken as {axis}")
    # the first learned network that takes none but these sliders
    slider_names, chosen = {slider.name for slider in sliders}, None
    for one in _prims(scene):
        network = _sound(scene, "network", read_slider_network, one)
        if network is not None and (chosen is not None or not slider_names.issuperset(network.sliders)):
            scene.warn("a learned network of sliders left out: another is kept, or its sliders are missing", [one])
        elif network is not None:
            chosen = network
    limits = None if prim is None else _sound(scene, "bone limits", read_limits, prim, len(skeleton.joints))
    hung = _texts(scene, tokens.ATTACH_JOINT)
    if len(hung) > 1:
        scene.warn(f"{len(hung)} attach joints: '{hung[0]}' is kept")
    parts = FaceParts(
        name=identifier(face_name, "Face"),
        meters_per_unit=unit,
        up_axis="Z" if axis == "Z" else "Y",
        meshes=joined,
        skeleton=skeleton,
        animations=tuple(animations.values()),
        played=None if source is None or source not in animations else animations[source].name,
        frames_per_second=float(stage.GetTimeCodesPerSecond()) or 24.0,
        sliders=sliders,
        slider_network=chosen,
        bone_limits=limits,
        materials=materials,
        attach_joint=hung[0] if hung else None,
        attribution="; ".join(_texts(scene, tokens.ATTRIBUTION)),
        vrm=_avatar(scene),
    )
    whole, named = with_motion(with_baked_uvs(parts), scene.moving, meshes, prim)
    for line in named:
        scene.warn(line)
    return whole


def _avatar(scene: Scene) -> dict[str, object]:
    """What VRM says of the first avatar that is read; empty where there is none."""
    prims = list(_prims(scene))
    found = [_sound(scene, "what VRM says of the avatar", read_vrm, prim) for prim in prims]
    avatars = {vrm_text(one): prim for one, prim in zip(found, prims, strict=True) if one}
    if len(avatars) > 1:
        scene.warn("what VRM says of an avatar left out: that of another is kept", list(avatars.values())[1:])
    return next((one for one in found if one), {})


def _animations(
    scene: Scene, source: Usd.Prim | None, skeleton: Skeleton, meshes: Sequence[Mesh]
) -> dict[Usd.Prim, Animation]:
    """The animations of the face, that which its skeleton plays wherever it stands; names unique."""
    shapes = {shape.name for mesh in meshes for shape in mesh.blendshapes}
    animations: dict[Usd.Prim, Animation] = {}
    every = dict.fromkeys([*scene.prims, *([] if source is None else [source])])
    prims = [prim for prim in every if prim.IsA(UsdSkel.Animation)]
    names = distinct_names(prims, [str(animation.GetName()) for animation in prims])
    for prim, name in zip(prims, names, strict=True):
        animation = _sound(scene, "animation", read_animation, prim, name)
        if animation is None:
            continue
        # importers leave out what the face lacks; here it is only named
        unknown = sorted({*animation.joints} - {*skeleton.joints}) + sorted({*animation.shapes} - shapes)
        if unknown:
            scene.warn(f"moves {', '.join(unknown[:3])} ({len(unknown)} in all), which the face lacks", [prim])
        missing = [name for name in ("translations", "rotations", "scales") if getattr(animation, name) is None]
        if missing and animation.joints:
            scene.warn(f"no {' and '.join(missing)}: taken from rest", [prim])
        animations[prim] = animation
    return animations


def _sliders(scene: Scene) -> tuple[Slider, ...]:
    """The sliders of all faces, the first of each name; those of a prim where they don't fit are left out."""
    sliders: dict[str, Slider] = {}
    for prim in _prims(scene):
        of_prim = _sound(scene, "sliders", read_sliders, prim) or ()
        twice = sorted({slider.name for slider in of_prim} & {*sliders})
        if twice:
            scene.warn(f"sliders {', '.join(twice[:3])} ({len(twice)} in all) once more: left out", [prim])
        sliders = {slider.name: slider for slider in of_prim} | sliders
    return with_mutual_mirrors([sliders[name] for name in sorted(sliders)])


def _sound(scene: Scene, what: str, read: Callable[..., Read], *given: object) -> Read | None:
    """What `read` finds; None, with a warning, where that is damaged."""
    try:
        return read(*given)
    except FacepipeError as error:
        scene.warn(f"{error}: {what} left out")
        return None


def _texts(scene: Scene, name: str) -> list[str]:
    """Texts of an attribute of every face that is read or that holds what is read, each once."""
    values = [prim.GetAttribute(name).Get() for prim in _prims(scene)]
    return list(dict.fromkeys(text for value in values if value and (text := str(value).strip())))


def _prims(scene: Scene) -> Iterator[Usd.Prim]:
    """The default prim, what stands above the roots, and all that is read, each once."""
    default = scene.stage.GetDefaultPrim()
    above = [prim for root in scene.roots for prim in ancestors(root)]
    yield from dict.fromkeys([*([default] if default else []), *above, *scene.prims])
