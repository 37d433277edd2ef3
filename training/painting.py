"""The colours and the labels of a head's pixels, painted in the common frame of `head_sources`."""

from __future__ import annotations

import head_sources as heads
import numpy as np
import numpy.typing as npt
from styles import Style, hair_height, is_neck

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

LABELS = ("background", "face", "hair", "leftBrow", "rightBrow", "leftEye", "rightEye")
LABELS += ("nose", "upperLip", "teeth", "lowerLip")  # of photo-to-face-sliders [0157]; left is the person's left
BACKGROUND, FACE, HAIR, LEFT_BROW, RIGHT_BROW, LEFT_EYE, RIGHT_EYE, NOSE, UPPER_LIP, INNER_MOUTH, LOWER_LIP = range(11)


class Painter:
    """Colours and labels of pixels of one topology's heads."""

    def __init__(self, topology: heads.Topology) -> None:
        points = topology.canonical[topology.landmarks].astype(np.float32)
        self.brows = points[17:22], points[22:27]
        self.eyes = points[36:42, :2], points[42:48, :2]
        self.outer_lips, self.inner_lips = points[48:60, :2], points[60:68, :2]
        self.mouth = points[48:68].mean(axis=0)
        self.nose = np.array(
            [
                *((-0.75, 4.3), (0.75, 4.3), (0.95, 2.0), (1.75, 0.4), (2.0, -0.6), (1.3, -1.35), (0, -1.6)),
                *((-1.3, -1.35), (-2.0, -0.6), (-1.75, 0.4), (-0.95, 2.0)),
            ],
            dtype=np.float32,
        )
        self.nostrils = points[[31, 32, 34, 35], :2]

    def __call__(self, style: Style, places: FloatArray, kinds: IntArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """Linear colours (p, 3), labels (p,) and shininess (p,) of pixels at places (p, 3) of the common frame."""
        colors = np.tile(style.skin.astype(np.float32), (len(places), 1))
        labels = np.full(len(places), FACE)
        shine = np.full(len(places), 0.12, np.float32)
        self._skin(style, places, kinds, colors, labels)
        for kind, color, label in (
            (heads.TEETH, np.array([0.85, 0.80, 0.70]), INNER_MOUTH),
            (heads.MOUTH, np.array([0.28, 0.06, 0.05]), INNER_MOUTH),
            (heads.SOCKET, style.skin * (0.6, 0.4, 0.4), FACE),
            (heads.CLOTH, style.cloth, BACKGROUND),
            (heads.STRANDS, style.brow, FACE),
        ):
            chosen = kinds == kind
            colors[chosen], labels[chosen] = color, label
        cavity = (kinds == heads.MOUTH) | (kinds == heads.TEETH)
        colors[cavity] *= np.clip((places[cavity, 2:] - 4.5) / 5.5, 0.05, 1)
        cloth = kinds == heads.CLOTH
        colors[cloth] *= 0.5 + style.noises[2](places[cloth, 0] * 0.8, places[cloth, 1] * 0.8)[:, None]
        self._eyes(style, places, kinds, colors, labels, shine)
        own_brows = kinds == heads.BROW
        colors[own_brows] = style.brow
        labels[own_brows] = np.where(places[own_brows, 0] > 0, LEFT_BROW, RIGHT_BROW)
        return colors, labels, shine

    def _skin(self, style: Style, places: FloatArray, kinds: IntArray, colors: FloatArray, labels: IntArray) -> None:
        skin = np.flatnonzero(kinds == heads.SKIN)
        at = places[skin]
        x, y, z = at.T
        angle = np.arctan2(x, z)
        color = colors[skin]
        large, small = style.noises[2](angle * 6, y * 0.7), style.noises[3](angle * 70, y * 7)
        color *= (1 + 0.22 * (large - 0.5) + 0.14 * (small - 0.5))[:, None]
        front = z > 4
        red = np.exp(-((np.abs(x) - 4.2) ** 2 + (y - 0.2) ** 2) / 4) + 0.8 * np.exp(-(x**2 + (y - 0.2) ** 2) / 1.5)
        color *= np.stack([1 + 0.06 * red, 1 - 0.14 * red, 1 - 0.12 * red], axis=1)
        under = np.exp(-((np.abs(x) - 3.0) ** 2 / 2.5 + (y - 2.3) ** 2 / 0.4)) * style.wrinkles
        color *= (1 - 0.25 * under)[:, None]
        fold = np.exp(-((np.abs(x) - np.interp(y, [-4, 0.5], [3.6, 2.2])) ** 2) / 0.06) * (y < 0.5) * (y > -4)
        lines = 0.5 + 0.5 * np.sin(y * 5 + 2 * large)
        forehead = (y > 7.3) & (np.abs(x) < 4) & front
        color *= (1 - style.wrinkles * (0.25 * fold * front + 0.12 * forehead * (lines > 0.8)))[:, None]
        color *= 1 - 0.5 * style.freckles * ((small > 0.78) & (np.abs(y - 1.5) < 3) & front)[:, None]
        chin = _smooth((-2.4 - y + 0.35 * np.abs(x) * (np.abs(x) > 3.2)) / 0.6) * _smooth((y + 9.5) / 0.5) * (z > 2.5)
        tache = np.exp(-((y + 2.0) ** 2) / 0.5) * (np.abs(x) < 3.0) * front
        area = np.maximum(chin, tache) * (0.4 + 0.6 * (small > 0.45))
        amount = np.clip(area * np.maximum(style.beard, style.stubble * 0.6), 0, 0.95)[:, None]
        color = color * (1 - amount) + np.asarray(style.hair) * 0.8 * amount
        self._lips(style, at, front, color, labels, skin)
        labels[skin[_inside(self.nose, x, y) & (z > 7)]] = NOSE
        tip = np.flatnonzero((np.abs(x) < 2.2) & (np.abs(y + 1) < 1.2) & (z > 9))
        offset = at[tip, None, :2] - (self.nostrils * (0.75, 1) + (0, 0.05)).astype(np.float32)
        holes = np.exp(-(offset**2 / np.float32((0.12, 0.03))).sum(-1)).max(axis=1, initial=0)
        color[tip] *= (1 - 0.75 * holes)[:, None]
        self._lids(style, at, front, color)
        self._brows(style, at, front, color, labels, skin)
        neck = is_neck(at) & (labels[skin] == FACE)
        labels[skin[neck]] = BACKGROUND
        grown = hair_height(style, at) > 0.3
        color[grown] = (style.cloth if style.cap else style.hair) * 0.7
        labels[skin[grown]] = BACKGROUND if style.cap else HAIR
        colors[skin] = color

    def _lips(
        self, style: Style, at: FloatArray, front: IntArray, color: FloatArray, labels: IntArray, skin: IntArray
    ) -> None:
        edge = self.outer_lips + (self.outer_lips - self.outer_lips.mean(axis=0)) * 0.03
        lips = _inside(edge, at[:, 0], at[:, 1]) & front
        middle = np.interp(at[:, 0], *_ascending(np.vstack([edge[0], self.inner_lips[[1, 2, 3]], edge[6]])))
        color[lips] *= style.lips * (0.9 + 0.2 * style.noises[2](at[lips, 0] * 6, at[lips, 1]))[:, None]
        crease = np.exp(-((at[:, 1] - middle) ** 2) / 0.006) * lips
        color *= (1 - 0.55 * crease)[:, None]
        labels[skin[lips]] = np.where(at[lips, 1] > middle[lips], UPPER_LIP, LOWER_LIP)

    def _lids(self, style: Style, at: FloatArray, front: IntArray, color: FloatArray) -> None:
        for eye in self.eyes:
            near = front & (np.abs(at[:, :2] - eye.mean(axis=0)) < (2.6, 1.9)).all(axis=1)
            spot = at[near, :2]
            upper = _distance(spot, eye[:4])
            lower = _distance(spot, np.vstack([eye[3:], eye[:1]]))
            lash = (0.35 + 0.55 * style.makeup) * np.exp(-((upper / (0.13 + 0.1 * style.makeup)) ** 2))
            lash = np.maximum(lash, (0.2 + 0.3 * style.makeup) * np.exp(-((lower / 0.09) ** 2)))
            crease = 0.25 * np.exp(-(((upper - 0.5) / 0.12) ** 2)) * (spot[:, 1] > eye[:, 1].mean())
            shadow = 0.35 * style.makeup * np.exp(-((upper / 0.7) ** 2)) * (spot[:, 1] > eye[:, 1].mean())
            color[near] *= ((1 - lash) * (1 - crease))[:, None] * (1 - shadow[:, None] * (0.7, 1.0, 0.6))

    def _brows(
        self, style: Style, at: FloatArray, front: IntArray, color: FloatArray, labels: IntArray, skin: IntArray
    ) -> None:
        strength, thickness, rise, tail = style.brow_shape
        for line, label, inner in ((self.brows[1], LEFT_BROW, 0), (self.brows[0], RIGHT_BROW, 4)):
            near = front & (np.abs(at[:, :2] - line[:, :2].mean(axis=0)) < (3.6, 2.0)).all(axis=1)
            curve = line[:, :2] + (0, rise)
            spot = at[near, :2]
            along = np.abs(spot[:, 0] - curve[inner, 0]) / np.ptp(curve[:, 0])
            width = thickness * np.interp(along, [0, 0.15, 0.6, 1.1], [0.9, 1.0, 0.85, 0.35])
            away = _distance(spot, curve) - 0.3 * tail * 0.1
            hairs = style.noises[3](spot[:, 0] * 9 + spot[:, 1] * 4 * np.sign(curve[inner, 0]), spot[:, 1] * 2.5)
            body = np.exp(-((away / width) ** 4)) * (0.55 + 0.6 * hairs)
            amount = np.clip(body * strength, 0, 0.95)[:, None]
            color[near] = color[near] * (1 - amount) + style.brow * amount
            labels[skin[np.flatnonzero(near)[np.exp(-((away / width) ** 4)) > 0.4]]] = label

    def _eyes(
        self,
        style: Style,
        places: FloatArray,
        kinds: IntArray,
        colors: FloatArray,
        labels: IntArray,
        shine: FloatArray,
    ) -> None:
        eyes = np.flatnonzero(kinds == heads.EYE)
        for side, center_x in ((1, 3.19), (-1, -3.19)):
            own = eyes[places[eyes, 0] * side > 0]
            offset = places[own, :2] - (center_x, 3.62)
            radius = np.hypot(*offset.T)
            turn = np.arctan2(offset[:, 1], offset[:, 0])
            white = np.array([0.72, 0.66, 0.63]) * (1 - 0.25 * np.clip((radius - 0.7) / 1.0, 0, 1))[:, None]
            iris = style.iris * (0.6 + 0.9 * style.noises[1](turn * 6, radius * 3))[:, None]
            rim = np.clip((radius - 0.52) / 0.12, 0, 1)[:, None]
            iris = iris * (1 - 0.6 * rim)
            blend = _smooth((radius - 0.64) / 0.06)[:, None]
            pupil = _smooth((radius - 0.25) / 0.05)[:, None]
            colors[own] = white * blend + (iris * pupil + 0.004 * (1 - pupil)) * (1 - blend)
            labels[own] = LEFT_EYE if side > 0 else RIGHT_EYE
            shine[own] = 1.0


def _smooth(value: FloatArray) -> FloatArray:
    clipped = np.clip(value * 0.5 + 0.5, 0, 1)
    return np.asarray(clipped * clipped * (3 - 2 * clipped))


def _ascending(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    order = np.argsort(points[:, 0])
    return points[order, 0], points[order, 1]


def _inside(polygon: FloatArray, x: FloatArray, y: FloatArray) -> npt.NDArray[np.bool_]:
    """(n,) whether points lie in a polygon: crossings of a ray to the right, even or odd."""
    inside = np.zeros(len(x), bool)
    box = (x > polygon[:, 0].min()) & (x < polygon[:, 0].max()) & (y > polygon[:, 1].min()) & (y < polygon[:, 1].max())
    px, py = x[box], y[box]
    found = np.zeros(len(px), bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            found ^= ((y0 > py) != (y1 > py)) & (px < (x1 - x0) * (py - y0) / (y1 - y0) + x0)
    inside[box] = found
    return inside


def _distance(points: FloatArray, line: FloatArray) -> FloatArray:
    """(n,) distance of points (n, 2) from a polyline (m, 2)."""
    line = line.astype(np.float32)
    start, way = line[:-1], np.diff(line, axis=0)
    offset = points[:, None] - start
    share = np.clip((offset * way).sum(-1) / (way * way).sum(-1), 0, 1)
    return np.asarray(np.linalg.norm(offset - share[..., None] * way, axis=-1).min(axis=1))
