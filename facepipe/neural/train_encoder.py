"""Train the encoder of a neural rig: deformation to controls, the first submodel backwards.

Before that what it takes: where a training stands, and few points of a surface that show what moves it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from facepipe.core.arrays import AnyArray, FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.geometry.ridge import ridge
from facepipe.neural.motion import Motion
from facepipe.neural.options import HEADS, TrainEncoderOptions
from facepipe.rig.neural_rig import EncoderLayer, NeuralEncoder, inputs
from facepipe.verbs.array_file import Content, read_arrays, write_arrays

if TYPE_CHECKING:
    from facepipe.neural.learning.encoder_fit import EncoderSamples, EncoderSize

_PRIOR_VARIANCE = 1.0 / 3.0  # variance of a mover before any point is seen: any value from -1 to 1
KIND = "facepipe neural rig training 2"
_NAMES = ("numbers", "random")
_WATCHED = 0.1  # of the frames to learn from: their error says when to stop
_CANDIDATES = 2048  # points that those of the encoder are chosen from
_SEEN_WITH = 0.3  # mm of noise that points are chosen for: with much less, those of one place would do
_CONTROL_NOISE = 1e-3  # of half their ranges: two that always move together share what they move
_STILL = 1e-6  # mm: a point that moves no further does not move


def farthest_points(places: FloatArray, weight: FloatArray, count: int) -> IntArray:
    """(count,) points, each the one whose distance to the ones before, times its weight, is the largest.

    Points of weight 0 are never taken: there may be fewer. Source: Gonzalez, Clustering to minimize the maximum
    intercluster distance (1985).

    :param places: (n, 3)
    :param weight: (n,)
    """
    count = min(count, int(np.count_nonzero(weight)))
    chosen = np.zeros(count, np.int64)
    near = np.full(len(places), np.inf)
    for number in range(count):
        chosen[number] = np.argmax(near * weight) if number else np.argmax(weight)
        near = np.minimum(near, np.linalg.norm(places - places[chosen[number]], axis=1))
        near[chosen[number]] = -1.0  # places of several points are taken last, and none twice
    return chosen


def informative_points(moves: FloatArray, noise: float, count: int) -> IntArray:
    """(count,) points, each the one that leaves the least doubt about all movers after the ones before it.

    Doubt is the summed variance of the movers' posterior, where each mover moves the points straight and points are
    seen with noise. With C the covariance of a point with the movers and S its own, noise included, seeing it takes
    ``trace(C C^T S^-1)`` off the doubt; all other covariances then lose what it explains of them, as in a Kalman
    filter, so that no inverse larger than 3 x 3 is needed. Source: greedy A-optimal design, e.g. Pukelsheim, Optimal
    Design of Experiments (1993).

    :param moves: (n, 3, c) how far each of c movers moves a point
    :param noise: standard deviation of a coordinate, in the unit of the moves
    """
    count = min(count, len(moves))
    chosen = np.zeros(count, np.int64)
    seen = moves * _PRIOR_VARIANCE  # (n, 3, c) covariance of points with movers
    spread = np.matmul(moves, seen.transpose(0, 2, 1)) + noise**2 * np.eye(3)  # (n, 3, 3) of points
    for number in range(count):
        inverse = np.linalg.inv(spread)
        gain = np.einsum("nij,nji->n", np.matmul(seen, seen.transpose(0, 2, 1)), inverse)
        gain[chosen[:number]] = -1.0
        taken = chosen[number] = np.argmax(gain)
        covariance = seen[taken].copy()
        shared = moves @ covariance.T  # (n, 3, 3) covariance with the point taken
        gains = shared @ inverse[taken]
        seen -= gains @ covariance
        spread -= gains @ shared.transpose(0, 2, 1)
    return chosen


def well_placed(places: FloatArray, moves: FloatArray, noise: float, count: int, candidates: int) -> IntArray:
    """(<= count,) points that show the movers, out of candidates that are spread over what moves, in the order of
    `halved`. It depends on where points are and how they move, not on how they are numbered.

    :param places: (n, 3)
    :param moves: (n, 3, c)
    """
    chosen = farthest_points(places, np.sqrt(np.linalg.norm(moves, axis=(1, 2))), candidates)
    chosen = chosen[informative_points(moves[chosen], noise, count)]
    return np.asarray(chosen[halved(places[chosen])])


def halved(places: FloatArray) -> IntArray:
    """(n,) points in the order of a balanced k-d tree: halved across the longest side of their box, the lower half
    first, and each half again. Any piece of a power of 2, at a multiple of it, is then a cell where n is one too.

    Source: Bentley, Multidimensional binary search trees (1975).

    :param places: (n, 3)
    """
    pieces: list[IntArray] = [np.arange(len(places))]
    while any(len(piece) > 1 for piece in pieces):
        whole, pieces = pieces, []
        for piece in whole:
            here = places[piece]
            ordered = piece[np.argsort(here[:, np.ptp(here, axis=0).argmax()], kind="stable")]
            middle = (len(piece) + 1) // 2
            pieces += [ordered[:middle], ordered[middle:]] if len(piece) > 1 else [piece]
    return np.concatenate(pieces)


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """One part of a training's file: of these frames, with these options. Parts don't touch each other."""

    path: Path
    part: str
    key: str  # digest of frames and options

    @classmethod
    def for_training(cls, path: Path, part: Literal["rig", "encoder"], motion: Motion, options: Any) -> Checkpoint:
        """:param options: a dataclass of plain values"""
        digest = hashlib.sha256(json.dumps(dataclasses.asdict(options), sort_keys=True).encode())
        for array in (motion.values, motion.points, motion.blocks, motion.coefficients):
            digest.update(b"" if array is None else np.ascontiguousarray(array).data)
        return cls(path=path, part=part, key=digest.hexdigest())

    def state(self) -> Mapping[str, AnyArray] | None:
        """What was kept last; None where nothing was yet.

        :raises InputError: a damaged file, or one of other frames or options
        """
        file = self._file()
        key = _keys(file).get(self.part)
        if key is None:
            return None
        if key != self.key:
            what = f"a training of other frames or options ({self.part})"
            raise InputError(self.path, f"{what}, expected these (or another file)")
        prefix = f"{self.part}."
        arrays = {name.removeprefix(prefix): one for name, one in file.arrays.items() if name.startswith(prefix)}
        lacking = [name for name in _NAMES if name not in arrays]
        if lacking:
            raise InputError(self.path, f"lacks {prefix}{lacking[0]}, expected a training")
        return arrays

    def keep(self, state: Mapping[str, AnyArray]) -> None:
        """Write, whole or not at all; the other parts stay as they are."""
        file, prefix = self._file(), f"{self.part}."
        others = {name: one for name, one in file.arrays.items() if not name.startswith(prefix)}
        arrays = {f"{prefix}{name}": one for name, one in state.items()}
        write_arrays(self.path, KIND, {"keys": {**_keys(file), self.part: self.key}}, others | arrays)

    def _file(self) -> Content:
        return read_arrays(self.path, KIND) if self.path.exists() else Content({}, {})


def _keys(file: Content) -> dict[str, str]:
    keys = file.content.get("keys")
    return keys if isinstance(keys, dict) else {}


@dataclass(frozen=True, kw_only=True)
class EncoderReport(Report):
    """How near an encoder comes to the controls of frames that it was not trained on, in shares of their ranges.

    Controls that move nothing, or the same as others do together, can't be found from points: they have large errors
    here whatever the encoder.
    """

    frames: int
    held_out: int
    points: int  # that it looks at
    steps: int
    error_mean: float  # absolute, over controls and held-out frames
    error_median: float  # of the controls' means
    ridge_mean: float  # of a straight map from the same points, with the same noise
    ridge_median: float
    constant_mean: float  # of each control's mean over the frames learned from
    errors: Mapping[str, float]  # control -> mean
    ridge_errors: Mapping[str, float]
    left_out: tuple[str, ...]  # controls that no frame moves


@dataclass(frozen=True, kw_only=True)
class TrainedEncoder:
    """An encoder, and how good it is."""

    encoder: NeuralEncoder
    report: EncoderReport


@dataclass(frozen=True, kw_only=True)
class TrainEncoder:
    """A transformer over features of points, beside the straight map from them (ridge regression), to controls.

    The loss is the mean square of the controls, from -1 to 1 over their ranges: each counts by its range, not by what
    it moves. Source: neural-face-rig, claims 2-4 (S201-S203); points, order and the straight map are ours.
    """

    options: TrainEncoderOptions = field(default_factory=TrainEncoderOptions)

    @one_thread()
    def __call__(
        self, motion: Motion, done: Callable[[], object] = lambda: None, checkpoint: Path | None = None
    ) -> TrainedEncoder:
        """Train on some blocks of frames, and measure on the others.

        :param done: called once for each step
        :param checkpoint: as `TrainNeuralRig` has it, whose part of the same file stays as it is
        :raises InputError: no control or no point that moves, a single block of frames, or a checkpoint of another
            training
        """
        from facepipe.neural.learning.encoder_fit import train_encoder

        options, still = self.options, motion.constant
        if len(still) == len(motion.controls):
            raise InputError(motion.where, "no control moves in any frame, expected one or more that do")
        moving = motion.without(still)
        learned, checked = moving.split(options.held_out, options.seed)
        chosen, size = _chosen(learned, options)
        several = len(np.unique(learned.blocks)) > 1
        taught, watched = learned.split(_WATCHED, options.seed) if several else (learned, learned)
        kept = Checkpoint.for_training(checkpoint, "encoder", motion, options) if checkpoint else None
        pairs = [_pairs(one, chosen) for one in (taught, watched)]
        weights, steps = train_encoder(
            pairs[0],
            pairs[1],
            moving.rest[chosen],
            _straight(pairs[0], options),
            size=size,
            noise=options.noise_mm,
            seed=options.seed,
            steps=options.encoder_steps,
            patience=options.encoder_patience,
            done=done,
            state=kept.state() if kept else None,
            keep=kept.keep if kept else lambda _: None,
        )
        arrays = {name: array for name, array in weights.items() if "." not in name and name != "scale"}
        layers: dict[str, dict[str, FloatArray]] = {}
        for name, array in weights.items():
            if "." in name:
                number, key = name.split(".")
                layers.setdefault(number, {})[key] = array
        encoder = NeuralEncoder(
            controls=moving.controls,
            topology=moving.topology.digest,
            point_count=moving.topology.point_count,
            chosen=chosen,
            rest=moving.rest[chosen].astype(np.float32),
            scale=float(weights["scale"]),
            heads=HEADS,
            layers=tuple(EncoderLayer(**layers[number]) for number in sorted(layers, key=int)),
            **arrays,
        )
        report = _report(encoder, _pairs(learned, chosen), _pairs(checked, chosen), options)
        return TrainedEncoder(encoder=encoder, report=replace(report, steps=steps, left_out=still))


def _chosen(motion: Motion, options: TrainEncoderOptions) -> tuple[IntArray, EncoderSize]:
    """Whole points in the order of the sequence, and the network for them: all tokens have as many points."""
    from facepipe.neural.learning.encoder_fit import EncoderSize

    moving = np.flatnonzero(np.abs(motion.points - motion.rest).max(axis=(0, 2)) > _STILL)
    if not len(moving):
        raise InputError(motion.where, "no point moves in any frame, expected some that do")
    count = min(options.points, len(moving))
    per_token = min(options.per_token, count)
    count -= count % per_token
    x = inputs(motion.controls, motion.values)
    # Points are chosen by what controls do to them: those of one place say little more than one of them.
    straight, _ = ridge(x, motion.points[:, moving].reshape(len(x), -1), _CONTROL_NOISE)
    moves = straight.reshape(-1, len(moving), 3).transpose(1, 2, 0)
    chosen = moving[well_placed(motion.rest[moving], moves, _SEEN_WITH, count, max(_CANDIDATES, count))]
    size = EncoderSize(
        per_token=per_token,
        width=HEADS * options.head_width,
        layers=options.layers,
        heads=HEADS,
        reduced=options.reduced,
    )
    return chosen, size


def _pairs(motion: Motion, chosen: IntArray) -> EncoderSamples:
    from facepipe.neural.learning.encoder_fit import EncoderSamples

    offsets = np.asarray(motion.points[:, chosen] - motion.rest[chosen], np.float32)
    return EncoderSamples(offsets=offsets, controls=inputs(motion.controls, motion.values))


def _straight(samples: EncoderSamples, options: TrainEncoderOptions) -> tuple[FloatArray, FloatArray]:
    """(3 p, c) and (c,) of least squared error."""
    from facepipe.neural.learning.encoder_fit import LEAST_NOISE

    flat = samples.offsets.reshape(len(samples.offsets), -1).astype(np.float64)
    return ridge(flat, samples.controls, max(options.noise_mm, LEAST_NOISE))


def _report(
    encoder: NeuralEncoder, learned: EncoderSamples, checked: EncoderSamples, options: TrainEncoderOptions
) -> EncoderReport:
    straight = _straight(learned, options)
    by_ridge = np.clip(checked.offsets.reshape(len(checked.offsets), -1) @ straight[0] + straight[1], -1.0, 1.0)
    found = encoder.of_offsets(checked.offsets)
    off, ridge_off, constant_off = (
        np.abs(one - checked.controls).mean(axis=0) / 2.0 for one in (found, by_ridge, learned.controls.mean(axis=0))
    )
    names = [control.name for control in encoder.controls]
    return EncoderReport(
        frames=len(learned.offsets),
        held_out=len(checked.offsets),
        points=len(encoder.chosen),
        steps=0,
        error_mean=float(off.mean()),
        error_median=float(np.median(off)),
        ridge_mean=float(ridge_off.mean()),
        ridge_median=float(np.median(ridge_off)),
        constant_mean=float(constant_off.mean()),
        errors=dict(zip(names, off.tolist(), strict=True)),
        ridge_errors=dict(zip(names, ridge_off.tolist(), strict=True)),
        left_out=(),
    )
