"""A learned rig: controls to bone coefficients and to points as sums of learned shapes; derivatives, the encoder."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse
from scipy.special import expit

from facepipe.core.arrays import FloatArray, IntArray, require_finite
from facepipe.core.errors import InputError, TopologyError
from facepipe.core.names import unknown
from facepipe.geometry.shape_basis import motion_basis
from facepipe.rig.bone_coefficients import coefficient_derivatives, coefficient_matrices, rest_coefficients
from facepipe.rig.rig import Rig, SkinWeights

_ORTHONORMAL_ERROR = 1e-5  # what float32 files may take from it
_RANDOM_PROBES = 512  # random values of all controls, and as many corners
EPSILON = 1e-5  # added to the variances that tokens are divided by the roots of
_FRAMES_AT_ONCE = 64  # frames


@dataclass(frozen=True, kw_only=True)
class Control:
    """One rig parameter, in its own unit."""

    name: str
    minimum: float = 0.0
    maximum: float = 1.0
    default: float = 0.0


@dataclass(frozen=True, kw_only=True)
class NeuralRig:
    """``outputs = x linear + last silu(hidden x + hidden_bias) + last_bias`` of the c controls: first r activations of
    shapes, then m bone coefficients, as far as they are from rest. x is how far controls, clamped to their limits, are
    from their defaults, in shares of their ranges.

    ``points = skin(rest + sum_r a_r shape_r)``, where the bones skin; without them the sum is the points. The straight
    part of a rig is in `linear`; the layer of h units adds what is not straight. Shapes are orthonormal.
    """

    controls: tuple[Control, ...]
    rest: FloatArray  # (n, 3) millimetres: with bones in skeleton space at bind time, otherwise in the world, Y up
    shapes: FloatArray  # (r, n, 3)
    linear: FloatArray  # (c, r + m) millimetres, radians, scales
    hidden: FloatArray  # (h, c)
    hidden_bias: FloatArray  # (h,)
    last: FloatArray  # (r + m, h)
    last_bias: FloatArray  # (r + m,)
    topology: str  # digest of the meshes that it was learned on
    bones: Rig | None = None  # in millimetres, without shapes
    channels: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))  # (m, 2) joint, coefficient 0..8

    def values(self, settings: Mapping[str, float]) -> FloatArray:
        """(c,) values by name; controls that are not named keep their defaults.

        :raises InputError: a name of no control, or a value that is not finite
        """
        values = {control.name: control.default for control in self.controls}
        for name, value in settings.items():
            if name not in values:
                raise InputError("neural rig", unknown(name, values, "control"))
            if not np.isfinite(value):
                raise InputError(f"neural rig -> {name}", f"value {value}, expected a finite number")
            values[name] = value
        return np.array(list(values.values()))

    def outputs(self, values: FloatArray) -> FloatArray:
        """(..., r + m) of (..., c) values: activations in millimetres, then bone coefficients from rest."""
        x = from_default(self.controls, values)
        units = x @ self.hidden.T + self.hidden_bias
        return np.asarray(x @ self.linear + (units * expit(units)) @ self.last.T + self.last_bias)

    def activations(self, values: FloatArray) -> FloatArray:
        """(..., r) millimetres of (..., c) values."""
        return self.outputs(values)[..., : len(self.shapes)]

    def coefficients(self, outputs: FloatArray) -> FloatArray:
        """(..., j, 9) bone coefficients of (..., r + m) outputs; translations in millimetres."""
        joints = 0 if self.bones is None else len(self.bones.joints)
        found = np.tile(rest_coefficients(joints), (*outputs.shape[:-1], 1, 1))
        found[..., self.channels[:, 0], self.channels[:, 1]] += outputs[..., len(self.shapes) :]
        return np.asarray(found)

    def morphed(self, outputs: FloatArray) -> FloatArray:
        """(..., n, 3) points before the bones move them, of (..., r + m) outputs."""
        return np.asarray(self.rest + np.tensordot(outputs[..., : len(self.shapes)], self.shapes, axes=1))

    def deformed(self, outputs: FloatArray) -> FloatArray:
        """(..., n, 3) millimetres, Y up, of (..., r + m) outputs."""
        flat, bones = outputs.reshape(-1, outputs.shape[-1]), self.bones
        frames = self.morphed(flat)
        if bones is not None:
            local = map(bones.local_transforms, self.coefficients(flat))
            for points, transforms in zip(frames, local, strict=True):
                points[:] = bones.skin(points, bones.skinning_matrices(transforms))
        return frames.reshape(*outputs.shape[:-1], *self.rest.shape)

    def points(self, values: FloatArray) -> FloatArray:
        """(..., n, 3) millimetres of (..., c) values."""
        return self.deformed(self.outputs(np.asarray(values, dtype=np.float64)))


def from_default(controls: tuple[Control, ...], values: FloatArray) -> FloatArray:
    """(..., c) shares of their ranges that values (..., c), clamped to them, are from their controls' defaults."""
    low, high, rest = _ranges(controls)
    return np.asarray((np.clip(values, low, high) - rest) / (high - low))


def inputs(controls: tuple[Control, ...], values: FloatArray) -> FloatArray:
    """(..., c) from -1 to 1: values (..., c) over their controls' ranges, clamped to them."""
    low, high, _ = _ranges(controls)
    return np.asarray(2.0 * (np.clip(values, low, high) - low) / (high - low) - 1.0)


def share_limits(controls: Sequence[Control]) -> tuple[FloatArray, FloatArray]:
    """(c,) lowest shares, 0 or less, and (c,) highest, 0 or more."""
    low, high, rest = _ranges(controls)
    return (low - rest) / (high - low), (high - rest) / (high - low)


def values_of(controls: Sequence[Control], x: FloatArray) -> FloatArray:
    """(..., c) values, within limits, of (..., c) shares: the inverse of `from_default`."""
    low, high, rest = _ranges(controls)
    return np.asarray(np.clip(rest + x * (high - low), low, high))


def _ranges(controls: Sequence[Control]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(c,) minima, maxima and defaults."""
    rows = np.array(
        [(control.minimum, control.maximum, control.default) for control in controls], dtype=np.float64
    ).reshape(-1, 3)
    return rows[:, 0], rows[:, 1], rows[:, 2]


def with_orthonormal_shapes(rig: NeuralRig) -> NeuralRig:
    """The same rig by shapes whose activations are as far apart as the points that they make."""
    flat = rig.shapes.reshape(len(rig.shapes), -1)
    if np.allclose(flat @ flat.T, np.eye(len(flat)), atol=_ORTHONORMAL_ERROR):
        return rig
    return with_basis(rig, rig.shapes, np.zeros((len(rig.controls), *rig.rest.shape)), 0.0, len(rig.shapes))


def with_basis(rig: NeuralRig, shapes: FloatArray, by_control: FloatArray, tolerance: float, most: int) -> NeuralRig:
    """The rig with other shapes for its activations, and shapes that its controls bring, over an orthonormal basis.

    :param shapes: (r, n, 3) in place of the rig's own
    :param by_control: (c, n, 3) of a control its whole range from its default
    :param tolerance: millimetres that the basis may leave of any of these at its largest, RMS
    :param most: shapes of the basis
    """
    count = len(shapes)
    sizes = np.concatenate([output_reach(rig)[:count], np.ones(len(by_control))])
    rows = np.concatenate([shapes, by_control])
    # each row as large as it gets: of rows as they are, the basis would hold shapes best that hardly come on
    basis, amounts = motion_basis(rows * sizes[:, None, None], tolerance, most)
    amounts = amounts / sizes[:, None]
    to_new, to_controls = amounts[:count], amounts[count:]
    return replace(
        rig,
        shapes=basis,
        linear=np.concatenate([rig.linear[:, :count] @ to_new + to_controls, rig.linear[:, count:]], axis=1),
        last=np.concatenate([to_new.T @ rig.last[:count], rig.last[count:]]),
        last_bias=np.concatenate([rig.last_bias[:count] @ to_new, rig.last_bias[count:]]),
    )


def output_reach(rig: NeuralRig) -> FloatArray:
    """(r + m,) how far each output goes: each control at its limits alone, all at random, all at random limits."""
    low, high, rest = _ranges(rig.controls)
    shares = np.random.default_rng(0).random((2 * _RANDOM_PROBES, len(rest)))
    shares[_RANDOM_PROBES:] = shares[_RANDOM_PROBES:] < 0.5
    alone = np.repeat(rest[None], 2 * len(rest), axis=0)
    each = np.arange(len(rest))
    alone[each, each], alone[len(rest) + each, each] = low, high
    found = np.abs(rig.outputs(np.concatenate([alone, low + shares * (high - low)]))).max(axis=0)
    return np.asarray(np.maximum(found, np.finfo(np.float32).eps))


def bones_in(rig: Rig, to: FloatArray) -> Rig:
    """The rig without its shapes, in another unit and world: points and joints scaled, skeleton space turned.

    :param to: (4, 4) from the rig's world to the other one, without shear
    :raises InputError: points skinned by dual quaternions
    """
    rig.require_linear("a neural rig")
    scale = float(np.cbrt(abs(np.linalg.det(to[:3, :3]))))
    larger, smaller = np.diag([scale] * 3 + [1.0]), np.diag([1.0 / scale] * 3 + [1.0])
    return replace(
        rig,
        points=rig.points * scale,
        shapes=(),
        targets=(),
        rest=larger @ rig.rest @ smaller,
        inverse_bind=larger @ rig.inverse_bind @ smaller,
        parent_world=to @ rig.parent_world @ smaller,
    )


def most_influences(rig: Rig) -> int:
    """The number of joints that move the point that most move."""
    return int(np.diff(rig.influences.indptr).max(initial=0))


def with_influences(rig: Rig, most: int) -> Rig:
    """The rig with the largest `most` weights of every point, renormalised."""
    if most_influences(rig) <= most:
        return rig
    kept = rig.influences.copy()
    for start, end in itertools.pairwise(kept.indptr.tolist()):
        if end - start > most:
            weights = kept.data[start:end]
            weights[np.argsort(-weights, kind="stable")[most:]] = 0.0
            weights /= weights.sum()
    kept.eliminate_zeros()
    return replace(rig, skinning=SkinWeights.from_sparse(kept))


def coefficients_in(coefficients: FloatArray, scale: float) -> FloatArray:
    """(..., 9) bone coefficients with their translations in a unit `scale` times as small."""
    return np.asarray(coefficients * np.array([scale] * 3 + [1.0] * 6))


def output_derivatives(rig: NeuralRig, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(f, r + m) outputs of (f, c) shares of ranges from defaults, within limits, and their derivatives
    (f, r + m, c): ``linear^T + last diag(silu'(u)) hidden``, where ``silu'(u) = s (1 + u (1 - s))`` with s the
    sigmoid."""
    units = x @ rig.hidden.T + rig.hidden_bias
    share = expit(units)
    outputs = x @ rig.linear + (units * share) @ rig.last.T + rig.last_bias
    slopes = share * (1.0 + units * (1.0 - share))
    return outputs, rig.linear.T + (rig.last * slopes[:, None, :]) @ rig.hidden


def with_points(rig: NeuralRig, chosen: IntArray) -> NeuralRig:
    """The same rig of some of its points; its shapes are no longer orthonormal, nor its bones' meshes whole."""
    bones = rig.bones
    if bones is not None:
        skinning = SkinWeights.from_sparse(bones.influences[chosen])
        bones = dataclasses.replace(bones, points=bones.points[chosen], skinning=skinning)
    return dataclasses.replace(rig, rest=rig.rest[chosen], shapes=rig.shapes[:, chosen], bones=bones)


class SkinnedPoints:
    """Points of a rig with bones, and how they answer to its outputs: shapes as skinned, and turns of joints.

    A joint above a point moves it through what is below: ``d world_d / d c_ja = G_ja world_d`` for each joint d at or
    below j, with ``G_ja = world_parent(j) rest_j (d M_j / d c_ja) inverse(world_j)``.
    """

    def __init__(self, rig: NeuralRig, bones: Rig) -> None:
        self.rig, self.bones = rig, bones
        self._shapes = np.ascontiguousarray(np.swapaxes(rig.shapes, 1, 2))  # (r, 3, n)
        below = np.eye(len(bones.joints))
        for joint in range(len(bones.joints) - 1, -1, -1):
            if bones.parents[joint] >= 0:
                below[bones.parents[joint]] += below[joint]
        self._joints, self._of = np.unique(rig.channels[:, 0], return_inverse=True)
        self._below = below[self._joints]  # (k, j)
        self._weights = sparse.csr_array(bones.influences[:, : len(bones.joints)])
        self._point = np.repeat(np.arange(len(rig.rest)), np.diff(self._weights.indptr))

    def points(self, outputs: FloatArray) -> FloatArray:
        """(n, 3) millimetres of (r + m,) outputs."""
        return self.rig.deformed(outputs)

    def derivatives(self, outputs: FloatArray) -> FloatArray:
        """(r + m, 3, n) of the points by (r + m,) outputs.

        :raises numpy.linalg.LinAlgError: a joint of scale 0
        """
        morphed = self.rig.morphed(outputs)
        skinning, generators = self._moved(outputs)
        blended = (self.bones.influences @ skinning[:, :3, :3].reshape(-1, 9)).T.reshape(3, 3, -1)
        derivatives = np.empty((len(outputs), 3, len(morphed)))
        shapes = self._shapes
        for axis in range(3):
            row = blended[axis]
            derivatives[: len(shapes), axis] = row[0] * shapes[:, 0] + row[1] * shapes[:, 1] + row[2] * shapes[:, 2]
        # (k, 4, n) weighted sums of what joints at or below one of the k make of points, and of the weights
        weights, point = self._weights, self._point
        matrices = skinning[weights.indices, :3]
        moved = np.einsum("eij,ej->ie", matrices[:, :, :3], morphed[point]) + matrices[:, :, 3].T
        rows = (*(weights.data * axis for axis in moved), weights.data)
        sums = [
            sparse.csr_array((data, weights.indices, weights.indptr), shape=weights.shape) @ self._below.T
            for data in rows
        ]
        derivatives[len(shapes) :] = generators[:, :3] @ np.stack([total.T for total in sums], axis=1)[self._of]
        return derivatives

    def gradient(self, outputs: FloatArray, by_point: FloatArray) -> FloatArray:
        """(r + m,) derivatives by (r + m,) outputs of what has (n, 3) by the points.

        :raises numpy.linalg.LinAlgError: a joint of scale 0
        """
        morphed = self.rig.morphed(outputs)
        skinning, generators = self._moved(outputs)
        blended = (self.bones.influences @ skinning[:, :3, :3].reshape(-1, 9)).reshape(-1, 3, 3)
        by_shape = self._shapes.reshape(len(self._shapes), -1) @ np.einsum("nij,ni->jn", blended, by_point).ravel()
        places = np.concatenate([morphed, np.ones((len(morphed), 1))], axis=1)
        by_matrix = self._weights.T @ (by_point[:, :, None] * places[:, None, :]).reshape(-1, 12)
        moved = by_matrix.reshape(-1, 3, 4) @ np.swapaxes(skinning[:-1], 1, 2)
        summed = np.tensordot(self._below, moved, axes=1)[self._of]
        return np.concatenate([by_shape, np.einsum("kij,kij->k", generators[:, :3], summed)])

    def _moved(self, outputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(j + 1, 4, 4) skinning matrices of outputs, and (m, 4, 4) what a channel does to all below its joint."""
        bones, channels = self.bones, self.rig.channels
        coefficients = self.rig.coefficients(outputs)
        worlds = bones.joint_worlds(bones.rest @ coefficient_matrices(coefficients))
        above = np.concatenate([worlds, bones.parent_world[None]])[bones.parents]  # -1: what roots hang under
        derivatives = coefficient_derivatives(coefficients[self._joints])[self._of, channels[:, 1]]
        change = (above @ bones.rest)[channels[:, 0]] @ derivatives
        skinning = np.concatenate([worlds @ bones.inverse_bind, bones.parent_world[None]])
        return skinning, change @ np.linalg.inv(worlds[self._joints])[self._of]


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
            normed = _norm(tokens)
            batch, count, width = normed.shape
            found = (normed @ layer.attend + layer.attend_bias).reshape(
                batch, count, 3, self.heads, width // self.heads
            )
            queries, keys, values = found.transpose(2, 0, 3, 1, 4)  # each (b, heads, k, width / heads)
            scores = queries @ keys.swapaxes(-1, -2) / np.sqrt(width / self.heads)
            shares = np.exp(scores - scores.max(axis=-1, keepdims=True))
            shares /= shares.sum(axis=-1, keepdims=True)
            joined = (shares @ values).transpose(0, 2, 1, 3).reshape(batch, count, width)
            tokens = tokens + np.asarray(joined @ layer.join + layer.join_bias)
            wide = np.maximum(_norm(tokens) @ layer.widen + layer.widen_bias, 0.0)
            tokens = tokens + wide @ layer.narrow + layer.narrow_bias
        reduced = np.tanh(tokens.reshape(len(offsets), -1) @ self.reduce + self.reduce_bias)
        straight = offsets.reshape(len(offsets), -1) @ self.straight
        return np.asarray(np.clip(reduced @ self.last + straight + self.offset, -1.0, 1.0))


def _norm(tokens: FloatArray) -> FloatArray:
    centred = tokens - tokens.mean(axis=-1, keepdims=True)
    return np.asarray(centred / np.sqrt(np.square(centred).mean(axis=-1, keepdims=True) + EPSILON))
