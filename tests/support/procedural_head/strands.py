"""Brows and lashes as loose strips."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.geometry.polygons import point_normals, point_triangles
from procedural_head import eyes, layout, topology
from procedural_head.attach import Attachment, frontal
from procedural_head.identity import Identity
from procedural_head.solids import Solid, joined, strip

_ACROSS = 15
_ALONG = 4


@dataclass(frozen=True)
class Brows:
    """The brows and the head triangles that carry them."""

    solid: Solid
    attachment: Attachment


def brows(head: FloatArray, who: Identity) -> Brows:
    """Both brows, a little above the skin."""
    t = np.linspace(0, 1, _ACROSS)[None, :]
    s = np.linspace(-1, 1, _ALONG)[:, None]
    shift = 0.11 * who.eye_spacing
    x = 1.15 + shift + 3.75 * t + 0 * s
    middle = 1.72 + 0.14 * who.brow_height + 0.62 * np.sin(np.pi * np.clip(t * 0.80, 0, 1)) ** 1.2 - 0.25 * t**3
    middle = middle + 0.12 * who.brow_tilt * (t - 0.4)
    thick = (0.29 + 0.05 * who.brow_thickness) * np.interp(t, [0, 0.08, 0.45, 0.8, 1.0], [0.55, 0.95, 1.0, 0.6, 0.1])
    y = middle + s * thick
    labels = layout.build()
    near = np.nonzero((np.abs(labels.column) < 26) & (labels.row > 1) & (labels.row < 21) & (labels.column != 0))[0]
    left = np.stack([x.ravel(), y.ravel()], axis=1)
    attached = frontal(head, left, near[head[near, 0] > 0.3])
    mirrored = Attachment(topology.build().mirror[attached.corners], attached.shares)
    top = topology.build()
    normals = point_normals(head, point_triangles(top.face_vertex_counts, top.face_vertex_indices))
    raised = (0.02 + 0.07 * (1 - s**2) + 0 * t).ravel()[:, None]
    points = (attached.carry(head) + raised * attached.carry(normals)).reshape(_ALONG, _ACROSS, 3)
    left_strip = strip(points, (0.52, 0.0, 1.0, 1.0))
    # Mirrored columns run the other way round, so that both strips face outwards.
    order = np.arange(_ALONG * _ACROSS).reshape(_ALONG, _ACROSS)[:, ::-1].ravel()
    right_strip = strip((points * (-1, 1, 1))[:, ::-1], (0.0, 0.0, 0.48, 1.0))
    corners = np.concatenate([attached.corners, mirrored.corners[order]])
    shares = np.concatenate([attached.shares, mirrored.shares[order]])
    return Brows(joined(left_strip, right_strip), Attachment(corners, shares))


@dataclass(frozen=True)
class Lashes:
    """Lash strips at the upper lids: roots on the rim, two rows further out."""

    solid: Solid
    rim: IntArray  # (n,) head point that each lash point moves with
    spoke: IntArray  # (n,) spoke of the eye patch, numbered as on the left eye
    side: FloatArray  # (n,) +1 left, -1 right


def lashes(head: FloatArray, who: Identity) -> Lashes:
    """The lashes of both eyes."""
    rings = topology.build().rings["eyeLeft"]
    half = rings.shape[1] // 2
    spokes = np.arange(half - 2, 1, -1)  # inner to outer corner
    eye = eyes.eye(who)
    rim = rings[eyes.RIM, spokes]
    out = head[rim] - eye.center
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    t = np.linspace(0, 1, len(spokes))
    length = 0.28 * np.sin(np.pi * (0.12 + 0.83 * t)) ** 0.6 * np.where(np.arange(len(spokes)) % 2, 1.0, 0.66)
    fan = np.stack([0.75 * (t - 0.35), np.full_like(t, 0.25), np.full_like(t, 0.75)], axis=1)
    tip = np.stack([0.9 * (t - 0.35), np.full_like(t, 0.75), np.full_like(t, 0.6)], axis=1)
    root = head[rim] - 0.03 * out
    rows = np.stack(
        [root, root + 0.55 * length[:, None] * (fan + 0.3 * out), root + length[:, None] * (tip + 0.4 * out)]
    )
    left = strip(rows, (0.52, 0.0, 1.0, 1.0))
    right = strip((rows * (-1, 1, 1))[:, ::-1], (0.0, 0.0, 0.48, 1.0))
    mirror = topology.build().mirror
    count = left.points.shape[0]
    return Lashes(
        solid=joined(left, right),
        rim=np.concatenate([np.tile(rim, 3), np.tile(mirror[rim][::-1], 3)]),
        spoke=np.concatenate([np.tile(spokes, 3), np.tile(spokes[::-1], 3)]),
        side=np.repeat([1.0, -1.0], count),
    )


def brow_colors(who: Identity) -> FloatArray:
    """(n, 3) colours of both brows: hair that thins out into the skin along the edges and at the inner ends."""
    t = np.linspace(0, 1, _ACROSS)[None, :]
    s = np.linspace(-1, 1, _ALONG)[:, None]
    share = (1 - 0.62 * s**4) * np.interp(t, [0, 0.12, 0.8, 1], [0.35, 0.95, 0.9, 0.7])
    share = np.concatenate([share.ravel(), share[:, ::-1].ravel()])[:, None]
    skin, hair = np.array(who.skin) * 0.8, np.array(who.hair) * 1.1
    return np.asarray(skin + 0.92 * share * (hair - skin))
