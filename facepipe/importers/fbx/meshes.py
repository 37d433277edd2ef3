"""Meshes of an FBX file: polygons as they are, attributes of their corners, and shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.names import handles, unique_identifiers
from facepipe.geometry.vectors import unit_vectors
from facepipe.importers.fbx.scene import NONE, Rows, Scene
from facepipe.importers.wavefront import compact_uvs
from facepipe.parts import Blendshape, Inbetween, MaterialFaces, Mesh, UvSet, bindings

_FACE = np.dtype([("begin", "<u4"), ("count", "<u4")])
FIRST_UV_SET = "st"  # whatever the file calls it: materials of several meshes read it, and their names differ


@dataclass(frozen=True)
class Corners:
    """The faces of a mesh of `count` points that are kept, and their corners."""

    counts: IntArray
    places: IntArray  # of each corner in the file's lists
    faces: IntArray  # numbers of the kept faces
    points: IntArray  # point of each corner
    count: int

    @cached_property
    def cover(self) -> bool:
        """Whether each point is in a face."""
        return bool(np.bincount(self.points, minlength=self.count).all())

    def of_points(self, values: FloatArray) -> FloatArray | None:
        """Values (count, k) of the points, of those of the corners; None where a point has several or none."""
        found = np.zeros((self.count, values.shape[1]), values.dtype)
        found[self.points] = values
        return found if self.cover and np.array_equal(found[self.points], values) else None


def read_mesh(scene: Scene, name: str, mesh: int, materials: Sequence[str | None]) -> Mesh | None:
    """A mesh in its own space, without skin and shapes; None where it has no polygon.

    :param materials: what each of its slots is bound to
    :raises InputError: values that are not finite, or lists that don't fit
    """
    row = scene.tables["meshes"][mesh]
    points = scene.array(row["points"], "<f8", 3)
    corners = _corners(scene, name, row, len(points))
    if not len(corners.counts):
        return None
    material, material_faces = _bindings(scene, row, corners, materials)
    return Mesh(
        name="mesh",
        points=points.astype(np.float32),
        face_vertex_counts=corners.counts,
        face_vertex_indices=corners.points,
        normals=_normals(scene, row, corners),
        uv_sets=_uv_sets(scene, row, corners),
        colors=_colors(scene, name, row, corners),
        material=material,
        material_faces=material_faces,
    )


def _corners(scene: Scene, name: str, row: Rows, count: int) -> Corners:
    faces, indices = scene.array(row["faces"], _FACE), scene.array(row["indices"], "<u4")
    kept = faces["count"] >= 3
    if not kept.all():
        scene.warn(name, f"{int((~kept).sum())} faces with fewer than three corners are left out")
    holes = scene.array(row["holes"], "u1")
    if len(holes) == len(kept) and holes.any():
        scene.warn(name, f"{int(holes.sum())} faces that are holes are left out")
        kept &= holes == 0
    called, chosen = ascii(name)[1:-1][:80], np.flatnonzero(kept)
    places = scene.places(faces[chosen], len(indices), f"faces of {called}")
    points = indices[places].astype(np.int32)
    if len(places) and indices[places].max() >= count:
        raise scene.error(f"corners of {called} beyond its {count} points")
    return Corners(faces["count"][chosen].astype(np.int32), places, chosen, points, count)


def _at_corners(
    scene: Scene, values: Rows, indices: Rows, width: int, corners: Corners
) -> tuple[npt.NDArray[Any], IntArray] | None:
    """Values (v, width) and the value of each corner kept; None where the mesh has none."""
    listed, which = scene.array(values, "<f8", width), scene.array(indices, "<u4")
    if not len(listed) or not len(which):
        return None
    if len(which) <= int(corners.places.max()) or int(which[corners.places].max()) >= len(listed):
        raise scene.error("attributes of corners beyond their lists")
    return listed, which[corners.places].astype(np.int64)


def _normals(scene: Scene, row: Rows, corners: Corners) -> FloatArray | None:
    found = _at_corners(scene, row["normals"], row["normal_indices"], 3, corners)
    if found is None:
        return None
    at_corners = unit_vectors(found[0][found[1]]).astype(np.float32)
    of_points = corners.of_points(at_corners)
    return at_corners if of_points is None else of_points


def _uv_sets(scene: Scene, row: Rows, corners: Corners) -> tuple[UvSet, ...]:
    sets = []
    rows = scene.uv_sets(row)
    names = unique_identifiers([FIRST_UV_SET, *(scene.text(one["name"]) for one in rows[1:])], FIRST_UV_SET)
    for name, one in zip(names, rows, strict=False):
        found = _at_corners(scene, one["values"], one["indices"], 2, corners)
        if found is None:
            continue
        values, which = found[0].astype(np.float32), found[1]
        of_points = corners.of_points(values[which])
        sets.append(
            UvSet(name=name, values=of_points)
            if of_points is not None
            else replace(compact_uvs(values, which), name=name)
        )
    return tuple(sets)


def _colors(scene: Scene, name: str, row: Rows, corners: Corners) -> FloatArray | None:
    found = _at_corners(scene, row["colors"], row["color_indices"], 4, corners)
    if found is None:
        return None
    if row["color_sets"] > 1:
        scene.warn(name, f"{row['color_sets']} sets of vertex colours: the first is kept")
    at_corners = found[0][found[1]].astype(np.float32)
    colors = np.ones((corners.count, 4), np.float32)
    colors[corners.points[::-1]] = at_corners[::-1]  # the first corner of a point
    if np.abs(colors[corners.points] - at_corners)[:, :3].max() > 1e-3:
        scene.warn(name, "vertex colours differ at seams: one colour of each point is kept")
    if (colors[:, 3] != 1.0).any():
        scene.warn(name, "opacity of vertex colours left out")
    return np.clip(colors[:, :3], 0.0, 1.0)


def _bindings(
    scene: Scene, row: Rows, corners: Corners, materials: Sequence[str | None]
) -> tuple[str | None, tuple[MaterialFaces, ...]]:
    slots = scene.array(row["materials"], "<u4")
    if not len(materials) or len(slots) <= int(corners.faces.max()):
        return materials[0] if len(materials) else None, ()
    return bindings(materials, slots[corners.faces])


def channels_of(scene: Scene, mesh: int) -> dict[int, str]:
    """Each shape channel of a mesh and what it is called: by itself, else by its shape."""
    found = {}
    for channel in scene.ids(scene.tables["meshes"][mesh]["channels"]):
        row = scene.tables["channels"][channel]
        name, keys = scene.text(row["name"]), scene.keys(row)
        if not name and len(keys) and keys["shape"][-1] != NONE:
            name = scene.text(scene.tables["shapes"][int(keys["shape"][-1])]["name"])
        found[channel] = name
    return found


def read_shapes(scene: Scene, name: str, mesh: int, called: Mapping[int, str], count: int) -> tuple[Blendshape, ...]:
    """The shapes of a mesh of `count` points, by channel.

    A channel passes through its target shapes at their full weights, linearly, and on beyond the last; a shape of a
    face is what it has at weight 1, its inbetweens the targets at other weights.

    :param called: what the shape of each channel is called
    :raises InputError: offsets that are not finite, or of points that aren't there
    """
    shapes = []
    channels = channels_of(scene, mesh)
    own = handles([called[channel] for channel in channels], "shape")
    for handle, channel in zip(own, channels, strict=True):
        targets = _targets(scene, name, channel, count)
        if not targets:
            scene.warn(name, f"the shape {called[channel]} has no target: left out")
            continue
        points = np.unique(np.concatenate([_moved(target) for target in targets])).astype(np.int32)
        scene.budget.spend(24 * len(targets) * len(points), scene.error)
        weights = np.array([weight for _, weight, _, _, _ in targets])
        offsets = np.stack([_rows(points, indices, values) for _, _, indices, values, _ in targets])
        turned = [_rows(points, indices, normals) for _, _, indices, _, normals in targets if normals is not None]
        normals = np.stack(turned) if len(turned) == len(targets) else None
        between = [place for place, weight in enumerate(weights) if weight != 1.0 and weight > 0.0]
        if len(between) == len(targets) == 1:
            between = []  # one target that is reached at another weight: the line through it is all there is
        if (weights < 0.0).any():
            scene.warn(name, f"targets of the shape {called[channel]} at weights below 0: left out")
        names = handles([targets[place][0] for place in between], "inbetween")
        shapes.append(
            Blendshape(
                name=handle,
                label=channels[channel] if channels[channel] != handle else None,
                point_indices=points,
                offsets=_at_one(weights, offsets).astype(np.float32),
                normal_offsets=None if normals is None else _at_one(weights, normals).astype(np.float32),
                inbetweens=tuple(
                    Inbetween(
                        name=inbetween,
                        weight=float(weights[place]),
                        offsets=offsets[place].astype(np.float32),
                        normal_offsets=None if normals is None else normals[place].astype(np.float32),
                    )
                    for inbetween, place in zip(names, between, strict=True)
                ),
            )
        )
    return tuple(shapes)


_Target = tuple[str, float, IntArray, FloatArray, FloatArray | None]


def _targets(scene: Scene, name: str, channel: int, count: int) -> list[_Target]:
    """Name, weight, points, offsets and normal offsets of the targets of a channel, by weight."""
    targets: list[_Target] = []
    for key in scene.keys(scene.tables["channels"][channel]):
        weight = float(key["weight"])
        if key["shape"] == NONE or weight == 0.0 or not np.isfinite(weight):
            continue
        row = scene.tables["shapes"][int(key["shape"])]
        indices = scene.array(row["vertices"], "<u4").astype(np.int64)
        offsets, normals = scene.array(row["offsets"], "<f8", 3), scene.array(row["normals"], "<f8", 3)
        if len(offsets) != len(indices):
            raise scene.error(f"{len(offsets)} offsets of {len(indices)} points in {ascii(name)[1:-1][:80]}")
        shares = scene.array(row["weights"], "<f8")
        if len(shares) == len(indices) and len(shares):  # Blender's vertex groups, by which it shows shapes
            offsets, normals = offsets * shares[:, None], normals * shares[: len(normals), None]
        there = indices < count
        if not there.all():
            scene.warn(name, f"{int((~there).sum())} offsets of points that it does not have: left out")
        own = normals[there] if len(normals) == len(indices) and normals.any() else None
        targets.append((scene.text(row["name"]), weight, indices[there], offsets[there], own))
    return sorted({target[1]: target for target in targets}.values(), key=lambda target: target[1])


def _moved(target: _Target) -> IntArray:
    """The points that a target moves or turns: some writers list all."""
    _, _, indices, offsets, normals = target
    return indices[offsets.any(axis=1) if normals is None else offsets.any(axis=1) | normals.any(axis=1)]


def _rows(points: IntArray, indices: IntArray, values: FloatArray) -> FloatArray:
    rows = np.zeros((len(points), 3))
    kept = np.isin(indices, points)
    rows[np.searchsorted(points, indices[kept])] = values[kept]
    return rows


def _at_one(weights: FloatArray, values: FloatArray) -> FloatArray:
    """What a channel has at weight 1: on the line between its neighbours, or on beyond the last."""
    positive = weights > 0.0
    knots = np.concatenate([[0.0], weights[positive]])
    tracks = np.concatenate([np.zeros((1, *values.shape[1:])), values[positive]])
    if len(knots) == 1:
        return np.asarray(values[-1] / weights[-1])
    right = min(max(int(np.searchsorted(knots, 1.0)), 1), len(knots) - 1)
    if knots[right] == 1.0:
        return np.asarray(tracks[right])
    share = (1.0 - knots[right - 1]) / (knots[right] - knots[right - 1])
    return np.asarray(tracks[right - 1] + share * (tracks[right] - tracks[right - 1]))
