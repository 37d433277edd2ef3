"""Options of all that is done with neural rigs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from facepipe.core.errors import InputError
from facepipe.declare import Ranged, check_ranges, option

HEADS = 4


@dataclass(frozen=True, kw_only=True)
class _Seeded(Ranged):
    """What depends on chance, always in the same way."""

    seed: int = option(0, "another number draws other frames, and another split, network and batches", 0, 2**31)


@dataclass(frozen=True, kw_only=True)
class _Checked(_Seeded):
    """What is checked on frames that it isn't learned from."""

    held_out: float = option(0.15, "share of the frames to check on, in whole blocks", 0.01, 0.9)


@dataclass(frozen=True, kw_only=True)
class SampleMotionOptions(_Seeded):
    """How many frames of which kind.

    :raises InputError: a number out of range
    """

    spread: int = option(1000, "frames of many controls at once, spread evenly (latin hypercube)", 0, 1e6)
    busy: float = option(
        0.6, "most of the controls that one of those frames moves, as a share; each draws its own, up to it", 0.01, 1.0
    )
    sweep: int = option(8, "frames of each control alone, from one limit to the other", 0, 1000)
    together: int = option(500, "frames of two or three controls at once", 0, 1e6)

    def count(self, controls: int) -> int:
        """The number of frames for a number of controls."""
        return self.spread + self.sweep * controls + self.together


@dataclass(frozen=True, kw_only=True)
class FrameBlocksOptions:
    """How clips are cut.

    :raises InputError: a number out of range, or margins that leave little of a block
    """

    block: int = option(30, "frames of a clip that are held out together, about", 2, 1e6)
    margin: int = option(2, "frames left out between two blocks of a clip", 0, 1000)

    def __post_init__(self) -> None:
        check_ranges(self)
        if not 2 * self.margin < self.block:
            raise InputError("option margin", f"is {self.margin}, expected less than half of block {self.block}")


@dataclass(frozen=True, kw_only=True)
class TrainNeuralRigOptions(_Checked):
    """How a neural rig is trained.

    :raises InputError: a number out of range
    """

    width: int = option(256, "units of the hidden layer", 1, 4096)
    shapes: int = option(128, "most shapes that motion is a sum of", 1, 2048)
    tolerance_mm: float = option(0.01, "what those shapes may leave of all frames, RMS", 0.0, 10.0, "mm")
    influences: Literal[4, 8, 0] = option(
        4,
        "largest number of joints that move a point, as engines and `export --influences` have it: shapes "
        "make up for the others; 0 keeps all",
    )
    steps: int = option(6000, "most steps of training", 1, 1e7)
    detail: float = option(
        1.0, "what an error of differential coordinates, dents and bumps, counts beside one of points", 0.0, 1000.0
    )
    sparsity: float = option(0.2, "how strongly a unit of the hidden layer is held to few controls", 0.0, 10.0)
    patience: int = option(1000, "steps without a better check that end it", 1, 1e7)


@dataclass(frozen=True, kw_only=True)
class TrainEncoderOptions(_Checked):
    """How an encoder is trained.

    :raises InputError: a number out of range
    """

    points: int = option(256, "points that the encoder looks at", 1, 16384)
    per_token: int = option(8, "of them in one token, neighbours", 1, 256)
    head_width: int = option(8, f"numbers of each of the {HEADS} heads of the attention", 1, 256)
    layers: int = option(2, "layers of the transformer", 1, 24)
    reduced: int = option(64, "numbers that a face is reduced to", 1, 4096)
    noise_mm: float = option(0.02, "noise on the points that it learns from; 0.1 for scans", 0.0, 10.0, "mm")
    encoder_steps: int = option(2000, "most steps of the encoder's training", 1, 1e7)
    encoder_patience: int = option(1000, "steps without a better check that end that", 1, 1e7)


@dataclass(frozen=True, kw_only=True)
class AttachOptions:
    """What of the shapes is kept."""

    offset_tolerance_mm: float = option(
        1e-2, "a shape leaves out points that it moves by less than this", 0.0, 1.0, "mm"
    )
    keep_shapes: bool = option(
        True,
        "keep the face's own shapes beside the rig's, to be set as before and for clips that play them; "
        "without them files are smaller",
    )


@dataclass(frozen=True, kw_only=True)
class InvertNeuralRigOptions(Ranged):
    """How controls are found for points.

    :raises InputError: a number out of range
    """

    mode: Literal["lm", "adam"] = option("lm", "bounded Levenberg-Marquardt, or Adam from random controls")
    l1: float = option(2e-4, "price of a control its whole range from its default", 0.0, 1e6, "mm2")
    smoothness: float = option(
        1e-3, "price of a change of speed by the range a frame, squared, in clips", 0.0, 1e6, "mm2"
    )
    starts: int = option(6, "starts of frames that fit much worse than the others, or are few", 1, 100)
    steps: int = option(60, "most steps from a start (lm)", 1, 1e6)
    points: int = option(500, "points that second derivatives are of, with bones (lm)", 3, 1e7)
    accuracy_mm: float = option(
        0.01, "how exactly targets are known, for what the report says of controls", 0, 10, "mm"
    )
    adam_steps: int = option(1000, "steps (adam)", 1, 1e7)
    adam_rate: float = option(0.05, "first rate, of ranges; it falls to a hundredth (adam)", 1e-6, 10.0)
    seed: int = option(0, "of random starts", 0, 2**31)


@dataclass(frozen=True, kw_only=True)
class RetargetOptions(Ranged):
    """How a neural rig is carried to a subject.

    :raises InputError: a number out of range
    """

    mode: Literal["points", "network"] = option(
        "points", "point by point in closed form, or the published fully connected network of the whole deformation"
    )
    noise_mm: float = option(
        -1.0,
        "noise on what the rig says while the subject is learned; -1: what does best on frames left out",
        -1.0,
        100.0,
        "mm",
    )
    noise: float = option(0.05, "noise at first, in deviations of the rig's deformations (network)", 0.0, 100.0)
    steps: int = option(3000, "most steps (network)", 1, 1e7)
    rounds: int = option(2, "how often controls are found, where they aren't given", 1, 20)
    held_out: float = option(0.15, "share of the frames, the last ones, that the report is on", 0.01, 0.9)
    shapes: int = option(256, "most shapes of the subject's rig", 1, 2048)
    tolerance_mm: float = option(0.005, "what those may leave, RMS", 0.0, 10.0, "mm")
