"""What a scan's surface shows beyond the mesh, as tangent-space normal maps: pores, lines and folds.

A normal map's texel is the slope of the true surface against the mesh's smooth one, along both directions of its
texture coordinates. Slopes of the scan and of the map that the template has add up; where the scan is so fine that it
shows pores, the template's own fade.
"""

from __future__ import annotations

import numpy as np

from facepipe.core.arrays import Float32Array, FloatArray, IntArray
from facepipe.core.images import open_image
from facepipe.geometry.texels import Texels
from facepipe.geometry.texture_fill import spread
from facepipe.parts import TextureInput
from facepipe.scanning.texture.scan_colors import SkinOnScan
from facepipe.scanning.texture.scan_samples import unit
from facepipe.textures.evened import inner
from facepipe.textures.seen_skin import step

_ALIKE = (0.80, 0.95)  # cosine between both normals: below, the scan is another fold's; from the second, fully trusted
_FINER = 0.7  # of the mesh's edges: scans with longer ones show nothing beyond it
_PORES_MM = 0.5  # edges of scans that show pores


def baked_relief(on_scan: SkinOnScan, number: int, own: TextureInput, edge: float) -> Float32Array:
    """(size, size, 3) a normal map with the scan's detail, -1..1, for one of the skin's textures.

    :param own: the map that the skin has, of the same texture coordinates
    :param edge: millimetres, of the scan's triangles
    :raises InputError: a map that can't be read
    """
    skin, texels = on_scan.skin, on_scan.skin.textures[number].texels
    result = _normals(own, texels.size)
    shown = on_scan.shown(number)
    part = texels.taken(shown.place)
    across, up = (part.carried(direction) for direction in _directions(texels, skin.points))
    normal = unit(part.carried(on_scan.normals))
    across = unit(across - (across * normal).sum(axis=1, keepdims=True) * normal)
    binormal = np.cross(normal, across)
    # Mirrored texture coordinates turn the frame's hand.
    binormal *= np.where((binormal * up).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    there = on_scan.outward * on_scan.samples.normals[shown.sample]
    facing = (there * normal).sum(axis=1)
    slopes = np.column_stack([(there * across).sum(axis=1), (there * binormal).sum(axis=1)])
    trust = (shown.trust * step(facing, *_ALIKE))[:, None]
    # Slopes (x / z, y / z) of two reliefs add up, unit normals don't; 0.1 bounds those seen edge-on.
    slopes = slopes / np.maximum(facing, 0.1)[:, None]
    flat = result.reshape(-1, 3)
    before = flat[part.at]
    kept = 1 - trust if edge <= _PORES_MM else 1.0
    both = kept * before[:, :2] / np.maximum(before[:, 2:], 0.1) + trust * slopes
    flat[part.at] = unit(np.column_stack([both, np.ones(len(both))]))
    return result


def is_finer(on_scan: SkinOnScan, edge: float) -> bool:
    """Whether a scan with triangles of that edge shows more than the mesh."""
    skin = on_scan.skin
    face = skin.outside & (inner(skin) > 0.5)  # elsewhere meshes are coarse
    return edge < _FINER * median_edge(skin.points, skin.triangles[face[skin.triangles].all(axis=1)])


def median_edge(points: FloatArray, triangles: IntArray) -> float:
    """Of the edges of triangles (t, 3) between points (n, 3)."""
    lengths = np.linalg.norm(points[triangles] - points[np.roll(triangles, 1, axis=1)], axis=2)
    return float(np.median(lengths)) if lengths.size else 0.0


def _normals(own: TextureInput, size: int) -> Float32Array:
    from PIL import Image

    picture = open_image(own.texture.image(), f"texture {own.texture.name}").convert("RGB")
    values = np.asarray(picture.resize((size, size), Image.Resampling.BICUBIC), np.float32) / 255
    normals = (values * np.array(own.scale[:3]) + np.array(own.bias[:3])).reshape(-1, 3)
    return np.asarray(unit(normals), np.float32).reshape(size, size, 3)


def _directions(texels: Texels, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3) unit directions at points in which u and v grow, means of those of the texels around."""
    places = spread(texels, texels.carried(points))
    across, down = (np.gradient(places, axis=axis).reshape(-1, 3)[texels.at] for axis in (1, 0))
    return (unit(texels.summed(unit(across), len(points))), unit(texels.summed(unit(-down), len(points))))
