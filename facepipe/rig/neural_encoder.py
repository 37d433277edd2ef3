"""A learned encoder: from points to the controls of a rig that bring them there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facepipe.core.arrays import FloatArray, IntArray, require_finite
from facepipe.core.errors import TopologyError
from facepipe.rig.neural_rig import Control

EPSILON = 1e-5  # added to the variances that tokens are divided by the roots of
_FRAMES_AT_ONCE = 64  # frames


@dataclass(frozen=True, kw_only=True)
class EncoderLayer:
    """One layer of a transformer: ``h += attention(norm(h))``, then ``h += relu(norm(h) widen + ..) narrow + ..``.

    `norm` takes each token less its mean over the root of its variance, without gains: they are within the matrices.
    """

    attend: FloatArray  # (d, 3 d) to queries, keys and values, each of all heads one after another
    attend_bias: FloatArray  # (3 d,)
    join: FloatArray  # (d, d)
    join_bias: FloatArray  # (d,)
    widen: FloatArray  # (d, w)
    widen_bias: FloatArray  # (w,)
    narrow: FloatArray  # (w, d)
    narrow_bias: FloatArray  # (d,)


@dataclass(frozen=True, kw_only=True)
class NeuralEncoder:
    """Points of a face to the controls of its rig, from -1 to 1 over their ranges.

    Of p chosen points, in the order of `chosen`, the offsets from rest over `scale` go through a small network that all
    points share (the place of each at rest is in its `point_bias`). The features of g points in a row make a token of
    d, to which its place in the sequence is added; the transformer's layers follow. All k tokens in a row are the
    global feature, which is reduced to r numbers and brought to controls. What is straight in that is beside it:
    ``tanh(feature reduce + reduce_bias) last + offsets straight + offset``.

    Source: neural-face-rig, claims 2-4 (S201-S203); the straight part is ours.
    """

    controls: tuple[Control, ...]
    topology: str  # digest of the meshes that it was learned on
    point_count: int  # whole points of the face
    chosen: IntArray  # (p,) whole points, in the order of the sequence
    rest: FloatArray  # (p, 3) millimetres, Y up
    scale: float  # millimetres
    heads: int  # of the attention; they share d evenly
    point: FloatArray  # (3, u)
    point_bias: FloatArray  # (p, u)
    feature: FloatArray  # (u, f)
    feature_bias: FloatArray  # (f,)
    token: FloatArray  # (g f, d)
    places: FloatArray  # (k, d), k = p / g
    layers: tuple[EncoderLayer, ...]
    reduce: FloatArray  # (k d, r)
    reduce_bias: FloatArray  # (r,)
    last: FloatArray  # (r, c)
    straight: FloatArray  # (3 p, c) per millimetre
    offset: FloatArray  # (c,)

    def check(self, topology: str, where: object) -> None:
        """:raises TopologyError: meshes with another digest than those that it was learned on"""
        if topology != self.topology:
            what = f"topology {topology[:15]}..., expected {self.topology[:15]}... that the encoder was learned on"
            raise TopologyError(where, what)

    def values(self, points: FloatArray) -> FloatArray:
        """(..., c) values in their own units, within their limits, of whole points (..., n, 3) in millimetres.

        :raises TopologyError: another number of points
        :raises InputError: NaN or infinity
        """
        low, high = (np.array([getattr(control, key) for control in self.controls]) for key in ("minimum", "maximum"))
        return np.asarray(low + (high - low) * (self.inputs(points) + 1.0) / 2.0)

    def inputs(self, points: FloatArray) -> FloatArray:
        """(..., c) from -1 to 1, as `neural_rig.inputs` makes of values; of whole points (..., n, 3) in millimetres.

        :raises TopologyError: another number of points
        :raises InputError: NaN or infinity
        """
        points = np.asarray(points)
        if points.shape[-2:] != (self.point_count, 3):
            raise TopologyError("points", f"shape {points.shape}, expected (..., {self.point_count}, 3)")
        require_finite(points, "points")
        flat = points.reshape(-1, self.point_count, 3)
        found = self.of_offsets(flat[:, self.chosen] - self.rest)
        return found.reshape(*points.shape[:-2], len(self.controls))

    def of_offsets(self, offsets: FloatArray) -> FloatArray:
        """(b, c) from -1 to 1, of millimetres (b, p, 3) by which the chosen points are off their rest."""
        values = np.zeros((len(offsets), len(self.controls)))
        for start in range(0, len(offsets), _FRAMES_AT_ONCE):
            frames = slice(start, start + _FRAMES_AT_ONCE)
            values[frames] = self._evaluated(offsets[frames])
        return values

    def _evaluated(self, offsets: FloatArray) -> FloatArray:
        features = np.tanh(offsets / self.scale @ self.point + self.point_bias) @ self.feature + self.feature_bias
        tokens = features.reshape(len(offsets), len(self.places), -1) @ self.token + self.places
        for layer in self.layers:
            tokens = tokens + _attention(_norm(tokens), layer, self.heads)
            wide = np.maximum(_norm(tokens) @ layer.widen + layer.widen_bias, 0.0)
            tokens = tokens + wide @ layer.narrow + layer.narrow_bias
        reduced = np.tanh(tokens.reshape(len(offsets), -1) @ self.reduce + self.reduce_bias)
        straight = offsets.reshape(len(offsets), -1) @ self.straight
        return np.asarray(np.clip(reduced @ self.last + straight + self.offset, -1.0, 1.0))


def _norm(tokens: FloatArray) -> FloatArray:
    centred = tokens - tokens.mean(axis=-1, keepdims=True)
    return np.asarray(centred / np.sqrt(np.square(centred).mean(axis=-1, keepdims=True) + EPSILON))


def _attention(tokens: FloatArray, layer: EncoderLayer, heads: int) -> FloatArray:
    batch, count, width = tokens.shape
    found = (tokens @ layer.attend + layer.attend_bias).reshape(batch, count, 3, heads, width // heads)
    queries, keys, values = found.transpose(2, 0, 3, 1, 4)  # each (b, heads, k, width / heads)
    scores = queries @ keys.swapaxes(-1, -2) / np.sqrt(width / heads)
    shares = np.exp(scores - scores.max(axis=-1, keepdims=True))
    shares /= shares.sum(axis=-1, keepdims=True)
    joined = (shares @ values).transpose(0, 2, 1, 3).reshape(batch, count, width)
    return np.asarray(joined @ layer.join + layer.join_bias)
