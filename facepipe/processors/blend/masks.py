"""The regions of a blend: soft masks over all points of the first source."""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.geometry.bridges import Bridges
from facepipe.geometry.region_masks import normalise_masks, smooth_masks
from facepipe.parts import all_regions
from facepipe.processors.blend.sources import Sources

_OFF = 1e-3  # sums further from 1 than this are said
RESERVED = "default"  # what weights call points in no region


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
    masks = _stacked(sources, names)
    bare = np.concatenate([np.full(len(mesh.points), not mesh.regions) for mesh in sources.base.meshes])
    notes = _notes(sources, masks[:, ~bare]) if names else ()
    full = _with_rest(masks)
    if smoothing > 0 and names:
        full = smooth_masks(full, sources.points.mean(axis=0), edges, smoothing)
    following = bare[bridges.followers]
    full[:, bridges.followers[following]] = full[:, bridges.leaders[following]]
    return names, full, notes


def _stacked(sources: Sources, names: tuple[str, ...]) -> FloatArray:
    """(regions, n) masks as authored."""
    if not names:
        return np.zeros((0, sources.points.shape[1]))
    masks = np.stack(list(all_regions(sources.base.meshes).values())).astype(np.float64)
    for row, point in np.argwhere(masks < 0)[:1]:
        number = int(np.searchsorted(sources.mesh_offsets, point, side="right")) - 1
        place = f"{sources.base.meshes[number].name}:{point - sources.mesh_offsets[number]}"
        where = f"{sources.names[0]} -> region {names[row]} -> {place}"
        raise InputError(where, f"mask {masks[row, point]:g}, expected 0 or more")
    return masks


def _with_rest(masks: FloatArray) -> FloatArray:
    normalised, rest = normalise_masks(masks)[:2]
    return np.concatenate([normalised, rest[None]])


def _notes(sources: Sources, masks: FloatArray) -> tuple[str, ...]:
    total = masks.sum(axis=0)
    over, under = int((total > 1 + _OFF).sum()), int(((total < 1 - _OFF) & (total > 0)).sum())
    none = int((total <= 0).sum())
    lines = []
    if over:
        lines.append(f"{sources.names[0]}: the regions of {over:,} points sum to more than 1, normalised to 1")
    if under:
        lines.append(f"{sources.names[0]}: the regions of {under:,} points sum to less than 1, the rest is default")
    if none:
        lines.append(f"{sources.names[0]}: {none:,} points are in no region, they take the default weights")
    return tuple(lines)
