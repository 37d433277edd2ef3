"""What a blend is solved on: edges, loose parts, anchor and regions of the base's topology, and shares over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.gradient_system import Bridges, cotangent_weights, joint_bridges, part_bridges
from facepipe.geometry.polygons import back_of_border, components, edges, point_triangles
from facepipe.geometry.region_map import normalise_masks, smooth_masks
from facepipe.parts import FaceParts, all_regions
from facepipe.verbs.blend.options import EdgeWeights
from facepipe.verbs.blend.sources import Sources

_OFF = 1e-3  # sums further from 1 than this get a note
RESERVED = "default"  # what weights call points in no region


@dataclass(frozen=True, kw_only=True)
class Graph:
    """Everything about a blend that no weight changes; n points, e edges, b bridges."""

    edges: IntArray  # (e, 2) mesh edges; with cotangent weights also the diagonals of the triangulation
    edge_weights: FloatArray  # (e,)
    triangles: IntArray  # (t, 3)
    component: IntArray  # (n,) number of the connected component
    main: BoolArray  # (n,) points of the component that holds the anchor
    anchor: int
    bridges: Bridges  # loose points -> points of the main component
    joint_bridges: Bridges  # joints -> points
    regions: tuple[str, ...]
    masks: FloatArray  # (regions + 1, n), summing to 1; the last row: in no region
    notes: tuple[str, ...] = ()

    def point_shares(self, table: FloatArray) -> FloatArray:
        """(n, K) shares of every point, of (regions + 1, K) shares of the regions."""
        return np.asarray(self.masks.T @ table)


def build_graph(sources: Sources, edge_weights: EdgeWeights, smoothing_mm: float, anchor: int | None) -> Graph:
    """The graph of the sources' common topology.

    :param smoothing_mm: width of the harmonic transition between regions; 0 keeps the masks as they are
    :param anchor: point held in place, counted over all meshes; None: the base's authored one, or one of its border
    :raises InputError: no such point, one of a loose part, or no anchor and no open border to take one from
    """
    mean = sources.points.mean(axis=0)
    placed = [
        (mesh.face_vertex_counts, mesh.face_vertex_indices, start)
        for mesh, start in zip(sources.base.meshes, sources.mesh_offsets[:-1], strict=True)
    ]
    triangles = np.concatenate([point_triangles(counts, indices) + start for counts, indices, start in placed])
    mesh_edges = np.concatenate([edges(counts, indices)[0] + start for counts, indices, start in placed])
    mesh_edges = mesh_edges[mesh_edges[:, 0] != mesh_edges[:, 1]]
    component = components(len(mean), mesh_edges)
    held, guessed = find_anchor(sources, anchor, component)
    main = component == component[held]
    bridges = part_bridges(mean, component, int(component[held]))
    names, masks, notes = region_masks(sources, mesh_edges, bridges, smoothing_mm / sources.mm_per_unit)
    uniform = (mesh_edges, np.ones(len(mesh_edges)))
    # cotangents of the mean, not of the blend: M^T W M is then factored once for all weights
    pairs, weights = cotangent_weights(mean, triangles) if edge_weights == "cotangent" else uniform
    return Graph(
        edges=pairs,
        edge_weights=weights,
        triangles=triangles,
        component=component,
        main=main,
        anchor=held,
        bridges=bridges,
        joint_bridges=joint_bridges(mean, np.asarray(joint_worlds(sources)[:, :, :3, 3].mean(axis=0))),
        regions=names,
        masks=masks,
        notes=(*guessed, *notes),
    )


def joint_worlds(sources: Sources) -> FloatArray:
    """(K, j, 4, 4) bind transforms in the base's bind space."""
    binds = [parts.skeleton.bind_transforms for parts in sources.parts]
    stacked = np.array(binds, dtype=np.float64).reshape(len(binds), -1, 4, 4)
    return np.asarray(np.einsum("kab,kjbc->kjac", sources.to_base, stacked))


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Shares of the K sources over n points and e edges, and the neutral solved with them, in the base's bind space."""

    shares: FloatArray  # (n, K) of every point
    edge_shares: FloatArray  # (e, K) of every edge: the mean of its ends'
    points: FloatArray  # (n, 3)

    def between(self, first: IntArray, second: IntArray) -> FloatArray:
        """(b, K) shares of edges between points: the mean of their ends'."""
        return mean_of_ends(self.shares, first, second)


def mean_of_ends(shares: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """(b, K) means of the shares (n, K) of two points each."""
    return np.asarray(0.5 * (shares[first] + shares[second]))


def mix(shares: FloatArray, values: FloatArray) -> FloatArray:
    """(r, c) sums of (K, r, c) values under (r, K) shares."""
    return np.asarray(np.einsum("rk,krc->rc", shares, values))


def anchor_named(sources: Sources, text: str | None) -> int | None:
    """The point ``MESH:POINT``, counted over all meshes; None for None.

    :raises InputError: not of that form, or no such point
    """
    if text is None:
        return None
    name, _, point = text.rpartition(":")
    for mesh, start in zip(sources.base.meshes, sources.mesh_offsets[:-1], strict=True):
        if mesh.name == name and point.isascii() and point.isdecimal() and int(point) < len(mesh.points):
            return int(start) + int(point)
    names = ", ".join(f"{mesh.name}:0..{len(mesh.points) - 1}" for mesh in sources.base.meshes[:3])
    raise InputError(f"option anchor -> {text}", f"no such point, expected MESH:POINT like {names}")


def find_anchor(sources: Sources, given: int | None, component: IntArray) -> tuple[int, tuple[str, ...]]:
    """The point that is held, and a note where it had to be guessed.

    All that is joined to it is the main component, which loose parts follow. So an anchor that is given must lie on
    the same component as the face's own.

    :param given: a point counted over all meshes; None: the authored one, or the back of the face mesh's open border
    :param component: (n,) number of the connected component
    :raises InputError: one of a loose part, or none given or authored and no open border to take one from
    """
    starts = zip(sources.base.meshes, sources.mesh_offsets[:-1], strict=True)
    anchor = next((int(start + mesh.anchor) for mesh, start in starts if mesh.anchor is not None), None)
    notes = tuple[str, ...]()
    if anchor is None:
        # even where a point is given: by this one alone can be told that the given one lies on a loose part
        number = _face_mesh(sources.base)
        mesh, start = sources.base.meshes[number], int(sources.mesh_offsets[number])
        placed = sources.points[0, start : start + len(mesh.points)] @ sources.base.skeleton.transform[:3, :3].T
        upright = placed if sources.base.up_axis == "Y" else placed[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
        place = back_of_border(upright, mesh.face_vertex_counts, mesh.face_vertex_indices)
        anchor = None if place is None else start + place
        if anchor is not None:
            notes = (f"no anchor authored, taken from the open border: {point_name(sources, anchor)}",)
    if given is not None:
        if anchor is not None and component[given] != component[anchor]:
            what = f"lies on a loose part, expected one joined to the face's own, {point_name(sources, anchor)}"
            raise InputError(f"option anchor -> {point_name(sources, given)}", what)
        return given, ()
    if anchor is None:
        where = f"{sources.names[0]} -> {sources.base.meshes[_face_mesh(sources.base)].name}"
        raise InputError(where, "no anchor and no open border to take one from, expected an anchor point (--anchor)")
    return anchor, notes


def _face_mesh(base: FaceParts) -> int:
    """The mesh that is the face itself: one with landmarks, else with regions, else the one with most points."""
    ranks = [(bool(mesh.landmarks), bool(mesh.regions), len(mesh.points)) for mesh in base.meshes]
    return max(range(len(ranks)), key=ranks.__getitem__)


def point_name(sources: Sources, point: int) -> str:
    """A point that is counted over all meshes as MESH:POINT."""
    number = int(np.searchsorted(sources.mesh_offsets, point, side="right")) - 1
    return f"{sources.base.meshes[number].name}:{point - int(sources.mesh_offsets[number])}"


def region_masks(
    sources: Sources, edges: IntArray, bridges: Bridges, smoothing: float
) -> tuple[tuple[str, ...], FloatArray, tuple[str, ...]]:
    """Names, masks (regions + 1, n) that sum to 1, the last row for points in no region, and notes.

    A loose mesh without regions takes those of the nearest points of the main component.

    :param edges: (e, 2) of the meshes
    :param smoothing: width of the harmonic transition between regions in units of bind space; 0: as they are
    :raises InputError: a negative mask, or a region whose name is taken
    """
    names = tuple(sorted({name for mesh in sources.base.meshes for name in mesh.regions}))
    if RESERVED in names:
        raise InputError(f"{sources.names[0]} -> {RESERVED}", "a region of that name, which stands for all others")
    authored = list(all_regions(sources.base.meshes).values()) if names else []
    masks = np.stack(authored).astype(np.float64) if names else np.zeros((0, sources.points.shape[1]))
    for row, point in np.argwhere(masks < 0)[:1]:
        where = f"{sources.names[0]} -> region {names[row]} -> {point_name(sources, int(point))}"
        raise InputError(where, f"mask {masks[row, point]:g}, expected 0 or more")
    bare = np.concatenate([np.full(len(mesh.points), not mesh.regions) for mesh in sources.base.meshes])
    total, notes = masks[:, ~bare].sum(axis=0), []
    for some, what in (
        (total > 1 + _OFF, "the regions of {:,} points sum to more than 1, normalised to 1"),
        ((total < 1 - _OFF) & (total > 0), "the regions of {:,} points sum to less than 1, the rest is default"),
        (total <= 0, "{:,} points are in no region, they take the default weights"),
    ):
        if names and some.any():
            notes.append(f"{sources.names[0]}: {what.format(int(some.sum()))}")
    normalised, rest = normalise_masks(masks)[:2]
    full = np.concatenate([normalised, rest[None]])
    if smoothing > 0 and names:
        full = smooth_masks(full, sources.points.mean(axis=0), edges, smoothing)
    # after the smoothing, so that followers have the masks that their leaders end with
    following = bare[bridges.followers]
    full[:, bridges.followers[following]] = full[:, bridges.leaders[following]]
    return names, full, tuple(notes)
