"""What of a mesh differs from its prim, authored over it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from pxr import Sdf, Usd, UsdGeom, UsdSkel

from facepipe.core import tokens
from facepipe.core.errors import InputError, TopologyError
from facepipe.parts import Mesh
from facepipe.stage.api_schemas import put, put_value, remove_schema
from facepipe.stage.author_blendshapes import author_blendshape_changes
from facepipe.stage.author_mesh import author_landmarks, author_normals, author_skin
from facepipe.stage.author_regions import author_regions
from facepipe.stage.bindings import inherited_skeleton
from facepipe.stage.differences import same
from facepipe.stage.opinions import editable
from facepipe.stage.read_mesh import is_left_handed, turned
from facepipe.stage.values import to_vec3f

_TOPOLOGY = ("face_vertex_counts", "face_vertex_indices")
_FIXED = ("name", "transform", "uv_sets", "colors", "point_subsets", "material", "material_faces", "double_sided")


def check_mesh_change(where: object, old: Mesh, new: Mesh) -> None:
    """Check that only what can be authored over a mesh differs.

    :raises TopologyError: another number of points, or other faces
    :raises InputError: another field that stays as it is, or a skin to take away
    """
    if len(new.points) != len(old.points):
        raise TopologyError(where, f"{len(new.points)} points, expected {len(old.points)}")
    if not all(same(getattr(old, field), getattr(new, field)) for field in _TOPOLOGY):
        raise TopologyError(where, "other faces, expected those of the face")
    for field in _FIXED:
        if not same(getattr(old, field), getattr(new, field)):
            raise InputError(f"{where} -> {field}", "differs, expected as on the face")
    if old.skin is not None and new.skin is None:
        raise InputError(f"{where} -> skin", "none, expected one as the face has it")


def author_mesh_changes(
    prim: Usd.Prim, old: Mesh, new: Mesh, skeleton: Usd.Prim, joints: tuple[str, ...], shared: Collection[Sdf.Path]
) -> tuple[str, ...]:
    """Author what differs between a mesh as read from its prim and `new`; one line per thing.

    :param skeleton: the Skeleton prim, which the mesh is bound to where it wasn't
    :param shared: paths of BlendShape prims that are the target of more than one shape
    """
    if same(old, new):
        return ()
    prim = editable(prim)
    mesh, lines = UsdGeom.Mesh(prim), []
    if not same(old.points, new.points):
        put(mesh.CreatePointsAttr(), to_vec3f(new.points))
        put(mesh.CreateExtentAttr(), UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()) or [])
        lines.append("points")
    if not same(old.normals, new.normals):
        _author_normals(mesh, turned(new) if is_left_handed(mesh) else new)
        lines.append("normals")
    if new.blendshapes or (new.skin and joints):
        _bind(prim, skeleton)
    if new.skin is not None and joints and not same(old.skin, new.skin):
        author_skin(prim, new.skin, joints, old.skin)
        lines.append("skin")
    if not same(old.regions, new.regions):
        author_regions(prim, new)
        lines.append("regions")
    lines += _author_landmarks(prim, old, new)
    lines += author_blendshape_changes(prim, old.blendshapes, new.blendshapes, shared)
    return tuple(f"{new.name}: {line}" for line in lines)


def _author_normals(mesh: UsdGeom.Mesh, new: Mesh) -> None:
    """Normals in the one attribute that holds them; primvars:normals would win over it."""
    put(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals").GetAttr(), None)
    if new.normals is None:
        put(mesh.GetNormalsAttr(), None)
    else:
        mesh.GetNormalsAttr().Clear()
        author_normals(mesh, new.normals)


def _bind(prim: Usd.Prim, skeleton: Usd.Prim) -> None:
    if not prim.HasAPI(UsdSkel.BindingAPI):
        UsdSkel.BindingAPI.Apply(prim)
    if inherited_skeleton(prim) != skeleton.GetPath():
        UsdSkel.BindingAPI(prim).CreateSkeletonRel().SetTargets([skeleton.GetPath()])


def _author_landmarks(prim: Usd.Prim, old: Mesh, new: Mesh) -> list[str]:
    changed = {name: one for name, one in new.landmarks.items() if not same(one, old.landmarks.get(name))}
    removed = [name for name in old.landmarks if name not in new.landmarks]
    anchor = new.anchor if new.anchor != old.anchor else None
    author_landmarks(prim, replace(new, landmarks=changed, anchor=anchor))
    for name in removed:
        for field in ("indices", "names"):
            put_value(prim, f"{tokens.LANDMARKS_PREFIX}{name}:{field}", None)
        remove_schema(prim, tokens.LANDMARKS_API, name)
    if new.anchor is None and old.anchor is not None:
        put_value(prim, tokens.ANCHOR, None)
        remove_schema(prim, tokens.ANCHOR_API)
    lines = [f"landmarks {name}" for name in (*changed, *removed)]
    return lines if new.anchor == old.anchor else [*lines, "anchor"]
