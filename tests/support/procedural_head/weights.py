"""Smooth skin weights that respect the slits of lips and lids."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import edges
from facepipe.parts import Skin
from procedural_head import eyes, layout, topology
from procedural_head.fields import Fields
from procedural_head.layout import smoothstep
from procedural_head.rig import HEAD, JAW, Rig

INFLUENCES = 4
# Reach (cm along the surface) and greatest share of the joints that sit on the skin, by the start of their name.
_REACH = {
    "forehead": (2.9, 0.75),
    "browInner": (2.4, 0.85),
    "browMid": (2.3, 0.85),
    "browOuter": (2.4, 0.85),
    "noseBridge": (2.6, 0.8),
    "noseTip": (2.8, 0.9),
    "nostril": (1.5, 0.8),
    "cheekUpper": (2.7, 0.85),
    "cheekLower": (2.7, 0.75),
    "jowl": (3.0, 0.7),
    "chin": (2.4, 0.7),
    "lipUpper": (1.7, 0.9),
    "lipLower": (1.7, 0.9),
    "lipCorner": (1.7, 0.75),
}
_LID_SHARE = np.array([0.0, 0.08, 0.28, 0.58, 0.84, 0.97, 1.0, 1.0, 0.85, 0.4, 0.0])  # by ring of the eye patch


def rigid(count: int, joint: int) -> Skin:
    """All points on one joint."""
    indices = np.zeros((count, INFLUENCES), dtype=np.int32)
    indices[:, 0] = joint
    weights = np.zeros((count, INFLUENCES))
    weights[:, 0] = 1.0
    return Skin(joint_indices=indices, joint_weights=weights)


def tongue(points: FloatArray, rig: Rig) -> Skin:
    """The tongue, from its root to its tip."""
    z = points[:, 2]
    share = smoothstep(0.15, 0.85, (z - z.min()) / (z.max() - z.min()))
    dense = np.zeros((len(points), len(rig.skeleton.joints)))
    dense[:, rig.index("tongue")], dense[:, rig.index("tongueTip")] = 1 - share, share
    return strongest(dense)


def head(masks: Fields, rig: Rig) -> FloatArray:
    """(n, joints) weights of the head's points."""
    base = _base(masks, rig)
    local = _local(masks, rig)
    total = local.sum(axis=1, keepdims=True)
    local = local / np.maximum(total, 1.0)
    return np.asarray(local + (1 - local.sum(axis=1, keepdims=True)) * base)


def strongest(dense: FloatArray) -> Skin:
    """The strongest influences of (n, joints) weights, summing to 1; a joint without weight has index 0."""
    order = np.argsort(-dense, axis=1, kind="stable")[:, :INFLUENCES]
    weights = np.take_along_axis(dense, order, axis=1)
    weights[weights < 1e-4] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    indices = np.where(weights > 0, order, 0).astype(np.int32)
    return Skin(joint_indices=indices, joint_weights=weights)


def _base(masks: Fields, rig: Rig) -> FloatArray:
    """Root, neck, head and jaw."""
    y, z = masks.points[:, 1], masks.points[:, 2]
    # The border between head and neck runs from under the chin up to the nape.
    above = smoothstep(-14.2, -9.4, y + 0.3 * z)
    low = smoothstep(-11.8, -16.4, y)
    dense = np.zeros((len(y), len(rig.skeleton.joints)))
    dense[:, rig.index("root")] = (1 - above) * low
    dense[:, rig.index("neck")] = (1 - above) * (1 - low)
    dense[:, rig.index(HEAD)] = above * (1 - masks.jaw)
    dense[:, rig.index(JAW)] = above * masks.jaw
    return dense


def _local(masks: Fields, rig: Rig) -> FloatArray:
    labels = layout.build()
    dense = np.zeros((len(masks.points), len(rig.skeleton.joints)))
    reach = {path: _reach(path) for path in rig.seats}
    far = max(distance for distance, _ in reach.values())
    paths = list(rig.seats)
    distances = _surface_distances(masks.points, np.array([rig.seats[path] for path in paths]), far)
    for path, distance in zip(paths, distances, strict=True):
        radius, greatest = reach[path]
        dense[:, rig.index(path)] = greatest * smoothstep(radius, 0.12 * radius, distance)
    for path in paths:
        name = path.rpartition("/")[2]
        if name.startswith("lipUpper"):
            dense[:, rig.index(path)] *= masks.upper
        elif name.startswith(("lipLower", "chin", "jowl")):
            dense[:, rig.index(path)] *= 1 - masks.upper
        elif name.startswith(("cheek", "nose", "nostril")):
            dense[:, rig.index(path)] *= _outside_lips(masks)
    for side in ("Left", "Right"):
        _lids(dense, rig, labels, side)
        ear = labels.ring["ear" + side]
        dense[:, rig.index("ear" + side)] = np.interp(ear, [0, 1, 2, 3], [0.05, 0.4, 0.8, 1.0]) * (ear >= 0)
    return dense


def _outside_lips(masks: Fields) -> FloatArray:
    """Joints of the skin don't reach through the lips into the mouth."""
    return np.asarray(1 - masks.lip)


def _reach(path: str) -> tuple[float, float]:
    name = path.rpartition("/")[2]
    return next(value for start, value in _REACH.items() if name.startswith(start))


def _lids(dense: FloatArray, rig: Rig, labels: layout.Layout, side: str) -> None:
    ring, across = labels.ring["eye" + side], np.nan_to_num(labels.across["eye" + side])
    patch = ring >= 0
    share = np.where(patch, _LID_SHARE[np.clip(ring, 0, eyes.RINGS)] * np.sin(np.pi * across) ** 0.6, 0.0)
    upper = np.nan_to_num(labels.upper["eye" + side])
    dense *= (1 - share)[:, None]
    dense[:, rig.index("lidUpper" + side)] = share * upper
    dense[:, rig.index("lidLower" + side)] = share * (1 - upper) * patch


def _surface_distances(points: FloatArray, sources: IntArray, limit: float) -> FloatArray:
    """(sources, n) distances along edges and face diagonals; paths can't cross the slits of lips and lids."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    top = topology.build()
    pairs = edges(top.face_vertex_counts, top.face_vertex_indices)[0]
    starts = np.concatenate([[0], np.cumsum(top.face_vertex_counts)[:-1]])[top.face_vertex_counts == 4]
    corners = top.face_vertex_indices[starts[:, None] + np.arange(4)]
    pairs = np.concatenate([pairs, corners[:, [0, 2]], corners[:, [1, 3]]])
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    pairs = pairs.astype(np.int32)  # older scipy takes no 64-bit indices here
    graph = coo_array((length, (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points))).tocsr()
    return np.asarray(dijkstra(graph, directed=False, indices=sources, limit=limit))
