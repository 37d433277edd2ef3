"""The network that a blend is solved on: edges, loose parts, anchor and regions of the base's topology."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.bridges import Bridges, joint_bridges, part_bridges
from facepipe.geometry.differences import cotangent_weights
from facepipe.geometry.polygons import components, edges, point_triangles
from facepipe.processors.blend.anchors import find_anchor
from facepipe.processors.blend.masks import region_masks
from facepipe.processors.blend.options import EdgeWeights
from facepipe.processors.blend.sources import Sources


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
    notes: tuple[str, ...] = ()

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
    held, guessed = find_anchor(sources, anchor, component)
    main = component == component[held]
    bridges = part_bridges(mean, component, int(component[held]))
    names, masks, notes = region_masks(sources, mesh_edges, bridges, smoothing_mm / sources.mm_per_unit)
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
        notes=(*guessed, *notes),
    )


def joint_worlds(sources: Sources) -> FloatArray:
    """(K, j, 4, 4) bind transforms in the base's bind space, joints in the base's order."""
    own = [
        parts.skeleton.bind_transforms[np.argsort(place)]
        for parts, place in zip(sources.parts, sources.joint_maps, strict=True)
    ]
    stacked = np.array(own, dtype=np.float64).reshape(len(own), -1, 4, 4)
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
