"""The network that a blend is solved on: edges, loose parts, anchor and regions of the base's topology."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from facepipe.errors import InputError, TopologyError
from facepipe.geometry.borders import back_of_border
from facepipe.geometry.bridges import Bridges, joint_bridges, part_bridges
from facepipe.geometry.differences import cotangent_weights
from facepipe.geometry.polygons import components, edges, point_triangles
from facepipe.geometry.region_masks import normalise_masks, smooth_masks
from facepipe.parts import FaceParts
from facepipe.processors.blend.sources import Sources

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

EdgeWeights = Literal["uniform", "cotangent"]


@dataclass(frozen=True, kw_only=True)
class Network:
    """Everything about a blend that no weight changes; n points, e edges, b bridges."""

    edges: IntArray  # (e, 2) mesh edges; with cotangent weights also the diagonals of the triangulation
    edge_weights: FloatArray  # (e,)
    triangles: IntArray  # (t, 3)
    component: IntArray  # (n,) number of the connected component
    main: npt.NDArray[np.bool_]  # (n,) points of the component that holds the anchor
    anchor: int
    bridges: Bridges  # loose points -> points of the main component
    joint_bridges: Bridges  # joints -> points
    regions: tuple[str, ...]
    masks: FloatArray  # (regions + 1, n), summing to 1; the last row: in no region

    def point_shares(self, table: FloatArray) -> FloatArray:
        """(n, K) shares of every point, of (regions + 1, K) shares of the regions."""
        return np.asarray(self.masks.T @ table)


def network(sources: Sources, edge_weights: EdgeWeights, smoothing_mm: float, anchor: int | None) -> Network:
    """The network of the sources' common topology.

    :param smoothing_mm: width of the harmonic transition between regions; 0 keeps the masks as they are
    :param anchor: point held in place, counted over all meshes; None: the base's authored one, or one of its border
    :raises InputError: no such point, one of a loose part, or no anchor and no open border to take one from
    """
    mean = sources.points.mean(axis=0)
    mesh_edges, triangles = _topology(sources)
    component = components(len(mean), mesh_edges)
    held = _anchor(sources, anchor, component)
    main = component == component[held]
    bridges = part_bridges(mean, component, int(component[held]))
    names, masks = _masks(sources.base, bridges)
    if smoothing_mm > 0 and len(names) > 1:
        masks = smooth_masks(masks, mean, mesh_edges, smoothing_mm / sources.mm_per_unit)
    uniform = (mesh_edges, np.ones(len(mesh_edges)))
    pairs, weights = cotangent_weights(mean, triangles) if edge_weights == "cotangent" else uniform
    return Network(
        edges=pairs,
        edge_weights=weights,
        triangles=triangles,
        component=component,
        main=main,
        anchor=held,
        bridges=bridges,
        joint_bridges=joint_bridges(mean, _joint_places(sources)),
        regions=names,
        masks=masks,
    )


def joint_worlds(sources: Sources) -> FloatArray:
    """(K, j, 4, 4) bind transforms in the base's bind space, joints in the base's order.

    :raises TopologyError: a source that lacks a joint of the base
    """
    joints = sources.base.skeleton.joints
    binds = []
    for name, parts in zip(sources.names, sources.parts, strict=True):
        own = {joint: number for number, joint in enumerate(parts.skeleton.joints)}
        lost = next((joint for joint in joints if joint not in own), None)
        if lost is not None:
            what = f"no joint '{lost}', expected the {len(joints)} joints of {sources.names[0]}"
            raise TopologyError(f"{name} -> {parts.skeleton.name}", what)
        binds.append(parts.skeleton.bind_transforms[[own[joint] for joint in joints]])
    stacked = np.array(binds, dtype=np.float64).reshape(len(binds), len(joints), 4, 4)
    return np.asarray(np.einsum("kab,kjbc->kjac", sources.to_base, stacked))


def _joint_places(sources: Sources) -> FloatArray:
    return np.asarray(joint_worlds(sources)[:, :, :3, 3].mean(axis=0))


def _topology(sources: Sources) -> tuple[IntArray, IntArray]:
    meshes, starts = sources.base.meshes, sources.mesh_offsets[:-1]
    pairs = [edges(m.face_vertex_counts, m.face_vertex_indices)[0] + at for m, at in zip(meshes, starts, strict=True)]
    corners = [
        point_triangles(m.face_vertex_counts, m.face_vertex_indices) + at for m, at in zip(meshes, starts, strict=True)
    ]
    found = np.concatenate(pairs)
    return found[found[:, 0] != found[:, 1]], np.concatenate(corners)


def _anchor(sources: Sources, given: int | None, component: IntArray) -> int:
    """The point that is held: all that is joined to it is the main component, which loose parts follow."""
    own, count = _own_anchor(sources), sources.points.shape[1]
    if given is None:
        if own is not None:
            return own
        where = f"{sources.names[0]} -> {sources.base.meshes[_largest(sources.base)].name}"
        raise InputError(where, "no anchor and no open border to take one from, expected an anchor point (--anchor)")
    if not 0 <= given < count:
        raise InputError("anchor", f"point {given}, expected 0 to {count - 1}")
    if own is not None and component[given] != component[own]:
        raise InputError("anchor", f"point {given} lies on a loose part, expected one joined to the face's own, {own}")
    return given


def _own_anchor(sources: Sources) -> int | None:
    """The base's authored anchor, or one of the border of its largest mesh."""
    starts = sources.mesh_offsets[:-1]
    for mesh, start in zip(sources.base.meshes, starts, strict=True):
        if mesh.anchor is not None:
            return int(start + mesh.anchor)
    largest = _largest(sources.base)
    mesh, start = sources.base.meshes[largest], int(starts[largest])
    own = sources.points[0, start : start + len(mesh.points)]
    upright = own if sources.base.up_axis == "Y" else own[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
    place = back_of_border(upright, mesh.face_vertex_counts, mesh.face_vertex_indices)
    return None if place is None else start + place


def _largest(base: FaceParts) -> int:
    return int(np.argmax([len(mesh.points) for mesh in base.meshes]))


def _masks(base: FaceParts, bridges: Bridges) -> tuple[tuple[str, ...], FloatArray]:
    """Regions over all meshes; a loose mesh that has none takes those of the nearest points of the main component."""
    names = tuple(sorted({name for mesh in base.meshes for name in mesh.regions}))
    stacked = [
        np.stack([np.asarray(mesh.regions.get(name, np.zeros(len(mesh.points))), dtype=np.float64) for name in names])
        if names
        else np.zeros((0, len(mesh.points)))
        for mesh in base.meshes
    ]
    masks = np.concatenate(stacked, axis=1)
    bare = np.concatenate([np.full(len(mesh.points), not mesh.regions) for mesh in base.meshes])
    following = bare[bridges.followers]
    masks[:, bridges.followers[following]] = masks[:, bridges.leaders[following]]
    normalised, rest = normalise_masks(masks)
    return names, np.concatenate([normalised, rest[None]])
