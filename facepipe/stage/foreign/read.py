"""A foreign stage as parts: the table of contents."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pxr import Usd, UsdGeom, UsdSkel

from facepipe.core.errors import FacepipeError, InputError, SchemaError, TopologyError
from facepipe.core.names import identifier
from facepipe.parts import Animation, FaceParts, Mesh, Skeleton
from facepipe.stage.display_names import told_apart
from facepipe.stage.files import quiet_diagnostics
from facepipe.stage.foreign import face
from facepipe.stage.foreign.materials import bound_materials
from facepipe.stage.foreign.meshes import bindings, choose_meshes, mend_meshes, note_custom
from facepipe.stage.foreign.scene import Scene
from facepipe.stage.foreign.skeletons import bind_to, choose_skeleton, mend_skeleton
from facepipe.stage.foreign.twin_shapes import alike_in, joined_animation, joined_meshes, twin_shapes
from facepipe.stage.guard import USD_ERRORS, reason
from facepipe.stage.read_mesh import Binding, read_mesh
from facepipe.stage.read_skeleton import read_animation, read_skeleton


@dataclass(frozen=True, kw_only=True)
class Foreign:
    """A face read from a stage of another tool."""

    parts: FaceParts
    files: tuple[Path, ...]  # layers that were read
    warnings: tuple[str, ...]


def read_foreign(
    path: Path,
    *,
    root: str | None = None,
    skeleton: str | None = None,
    variants: Mapping[str, str] | None = None,
) -> Foreign:
    """The face of a UsdSkel stage, mended as far as it says what it means.

    :param root: path of the prim to read below; default the default prim, or the whole stage
    :param skeleton: path of the Skeleton, needed where meshes are bound to several
    :param variants: which to read, by variant set; of other sets those that the file selects
    :raises InputError: no readable stage, no meshes, no such variant, or a choice that has to be made
    :raises SchemaError, TopologyError: data that doesn't hold together
    """
    with quiet_diagnostics(), _trail(path):
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
        return Foreign(
            parts=parts,
            files=tuple(sorted(Path(one.realPath) for one in scene.stage.GetUsedLayers() if one.realPath)),
            warnings=tuple(scene.warnings),
        )


@contextlib.contextmanager
def _trail(path: Path) -> Iterator[None]:
    """Errors name the file first."""
    try:
        yield
    except USD_ERRORS as error:
        raise InputError(path, f"can't be read as USD: {reason(error)}") from None
    except (SchemaError, TopologyError) as error:
        raise error.under(path) from None
    except InputError as error:
        raise error if error.where.startswith(str(path)) else error.under(path) from None


def _parts(scene: Scene, meshes: list[Usd.Prim], prim: Usd.Prim | None) -> FaceParts:
    skeleton = Skeleton() if prim is None else read_skeleton(prim)
    names = told_apart(meshes, [str(one.GetName()) for one in meshes])
    material_names, materials = bound_materials(scene, meshes)
    queries = bindings(scene)
    read = tuple(
        _mesh(scene, one, name, queries.get(str(one.GetPath())), skeleton, material_names)
        for one, name in zip(meshes, names, strict=True)
    )
    twins = twin_shapes(meshes)
    sliders = face.sliders(scene)
    source = None if prim is None else UsdSkel.BindingAPI(prim).GetInheritedAnimationSource() or None
    animations = _animations(scene, source, skeleton, read)
    twins = alike_in(twins, animations.values())
    if twins:
        old, new = next(iter(twins.items()))
        scene.warn(f"{len(twins)} shapes joined with those of other meshes, by their prims' names: {old} is {new}")
    read = joined_meshes(read, twins)
    animations = {prim: joined_animation(one, twins) for prim, one in animations.items()}
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
        slider_network=face.slider_network(scene, sliders),
        bone_limits=None if prim is None else face.limits(scene, prim, len(skeleton.joints)),
        materials=materials,
        attach_joint=face.attach_joint(scene),
        attribution=face.attribution(scene),
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
    found: dict[Usd.Prim, Animation] = {}
    every = dict.fromkeys([*scene.prims, *([] if source is None else [source])])
    prims = [prim for prim in every if prim.IsA(UsdSkel.Animation)]
    names = told_apart(prims, [str(one.GetName()) for one in prims])
    for prim, name in zip(prims, names, strict=True):
        try:
            animation = read_animation(prim, name)
        except FacepipeError as error:
            scene.warn(f"{error}: animation left out")
            continue
        unknown = sorted({*animation.joints} - {*skeleton.joints}) + sorted({*animation.shapes} - shapes)
        if unknown:
            scene.warn(f"moves {', '.join(unknown[:3])} ({len(unknown)} in all), which the face lacks", [prim])
        missing = [name for name in ("translations", "rotations", "scales") if getattr(animation, name) is None]
        if missing and animation.joints:
            scene.warn(f"no {' and '.join(missing)}: taken from rest", [prim])
        found[prim] = animation
    return found


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
