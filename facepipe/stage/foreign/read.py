"""A foreign stage as parts, with facepipe's own attributes where it is or holds a face."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from pxr import Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.errors import FacepipeError
from facepipe.core.names import identifier
from facepipe.parts import Animation, FaceParts, Mesh, Skeleton, Slider, SliderNetwork
from facepipe.rig.sliders import with_mutual_mirrors
from facepipe.stage.files import quiet_diagnostics
from facepipe.stage.foreign.meshes import bindings, bound_materials, choose_meshes, mend_meshes, note_custom
from facepipe.stage.foreign.scene import Scene, ancestors
from facepipe.stage.foreign.skeletons import bind_to, choose_skeleton, mend_skeleton
from facepipe.stage.foreign.twin_shapes import alike_in, joined_animation, joined_meshes, twin_shapes
from facepipe.stage.guard import errors_below
from facepipe.stage.prims import distinct_names
from facepipe.stage.read_mesh import Binding, read_mesh
from facepipe.stage.skeleton import read_animation, read_limits, read_skeleton
from facepipe.stage.slider_network import read_slider_network
from facepipe.stage.sliders import read_sliders

Read = TypeVar("Read")


def read_foreign(
    path: Path,
    *,
    root: str | None = None,
    skeleton: str | None = None,
    variants: Mapping[str, str] | None = None,
) -> tuple[FaceParts, list[Path], list[str]]:
    """The face of a UsdSkel stage, repaired as far as its meaning is clear; the layers that were read, and warnings.

    :param root: path of the prim to read below; default the default prim, or the whole stage
    :param skeleton: path of the Skeleton, needed where meshes are bound to several
    :param variants: which to read, by variant set; of other sets those that the file selects
    :raises InputError: no readable stage, no meshes, no such variant, or a choice that has to be made
    :raises SchemaError, TopologyError: data that doesn't hold together
    """
    with quiet_diagnostics(), errors_below(str(path)):
        scene = Scene(path, root, variants or {})
        meshes = choose_meshes(scene)
        prim = choose_skeleton(scene, meshes, skeleton)
        if prim is not None:
            meshes = bind_to(scene, prim, meshes)
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
    material_names, materials = bound_materials(scene, meshes)
    queries = bindings(scene)
    read = tuple(
        _mesh(scene, mesh, name, queries.get(str(mesh.GetPath())), skeleton, material_names)
        for mesh, name in zip(meshes, names, strict=True)
    )
    twins = twin_shapes(meshes)
    sliders = _sliders(scene)
    source = None if prim is None else UsdSkel.BindingAPI(prim).GetInheritedAnimationSource() or None
    animations = _animations(scene, source, skeleton, read)
    twins = alike_in(twins, animations.values())
    if twins:
        old, new = next(iter(twins.items()))
        scene.warn(f"{len(twins)} shapes joined with those of other meshes, by their prims' names: {old} is {new}")
    read = joined_meshes(read, twins)
    animations = {prim: joined_animation(animation, twins) for prim, animation in animations.items()}
    return FaceParts(
        name=identifier(str(scene.roots[0].GetName()) if len(scene.roots) == 1 else scene.path.stem, "Face"),
        meters_per_unit=_meters_per_unit(scene),
        up_axis="Z" if _up_axis(scene) == "Z" else "Y",
        meshes=read,
        skeleton=skeleton,
        animations=tuple(animations.values()),
        played=None if source is None or source not in animations else animations[source].name,
        frames_per_second=float(scene.stage.GetTimeCodesPerSecond()) or 24.0,
        sliders=sliders,
        slider_network=_slider_network(scene, sliders),
        bone_limits=None if prim is None else _sound(scene, "bone limits", read_limits, prim, len(skeleton.joints)),
        materials=materials,
        attach_joint=_attach_joint(scene),
        attribution="; ".join(_texts(scene, tokens.ATTRIBUTION)),
    )


def _mesh(
    scene: Scene,
    prim: Usd.Prim,
    name: str,
    query: UsdSkel.SkinningQuery | None,
    skeleton: Skeleton,
    materials: dict[str, str],
) -> Mesh:
    binding = Binding(query, skeleton.joints) if query is not None else None
    mesh = read_mesh(prim, name, binding, materials, unbound_shapes=True)
    if mesh.blendshapes and (query is None or not query.HasBlendShapes()):
        scene.warn("blendshapes of a mesh without Skeleton, which UsdSkel never shows: read all the same", [prim])
    return mesh


def _animations(
    scene: Scene, source: Usd.Prim | None, skeleton: Skeleton, meshes: tuple[Mesh, ...]
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
        unknown = sorted({*animation.joints} - {*skeleton.joints}) + sorted({*animation.shapes} - shapes)
        if unknown:
            scene.warn(f"moves {', '.join(unknown[:3])} ({len(unknown)} in all), which the face lacks", [prim])
        missing = [name for name in ("translations", "rotations", "scales") if getattr(animation, name) is None]
        if missing and animation.joints:
            scene.warn(f"no {' and '.join(missing)}: taken from rest", [prim])
        animations[prim] = animation
    return animations


def _meters_per_unit(scene: Scene) -> float:
    unit = float(UsdGeom.GetStageMetersPerUnit(scene.stage))
    if not UsdGeom.StageHasAuthoredMetersPerUnit(scene.stage):
        scene.warn(f"metersPerUnit not authored: taken as {unit:g}")
    if not 0 < unit < float("inf"):
        raise scene.error(f"metersPerUnit {unit:g}, expected a finite number above 0")
    return unit


def _up_axis(scene: Scene) -> str:
    axis = str(UsdGeom.GetStageUpAxis(scene.stage))
    if not scene.stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis):
        scene.warn(f"upAxis not authored: taken as {axis}")
    return axis


def _attach_joint(scene: Scene) -> str | None:
    """The body joint that the root joints hang under; the first where the stage names several."""
    joints = _texts(scene, tokens.ATTACH_JOINT)
    if len(joints) > 1:
        scene.warn(f"{len(joints)} attach joints: '{joints[0]}' is kept")
    return joints[0] if joints else None


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


def _slider_network(scene: Scene, sliders: Sequence[Slider]) -> SliderNetwork | None:
    """The first learned network that takes none but the given sliders; others are left out."""
    names, chosen = {slider.name for slider in sliders}, None
    for prim in _prims(scene):
        network = _sound(scene, "network", read_slider_network, prim)
        if network is not None and (chosen is not None or not names.issuperset(network.sliders)):
            scene.warn("a learned network of sliders left out: another is kept, or its sliders are missing", [prim])
        elif network is not None:
            chosen = network
    return chosen


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
