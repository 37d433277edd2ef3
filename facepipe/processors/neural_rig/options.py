"""Options of all that is done with neural rigs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from facepipe.errors import InputError
from facepipe.options import check_ranges

HEADS = 4


@dataclass(frozen=True, kw_only=True)
class SampleMotionOptions:
    """How many frames of which kind.

    :raises InputError: a number out of range
    """

    spread: int = field(
        default=1000,
        metadata={"help": "frames of many controls at once, spread evenly (latin hypercube)", "range": (0, 1e6)},
    )
    busy: float = field(
        default=0.6,
        metadata={
            "help": "most of the controls that one of those frames moves, as a share; each draws its own, up to it",
            "range": (0.01, 1.0),
        },
    )
    sweep: int = field(
        default=8, metadata={"help": "frames of each control alone, from one limit to the other", "range": (0, 1000)}
    )
    together: int = field(default=500, metadata={"help": "frames of two or three controls at once", "range": (0, 1e6)})
    seed: int = field(default=0, metadata={"help": "another number draws other frames", "range": (0, 2**31)})

    def __post_init__(self) -> None:
        check_ranges(self)

    def count(self, controls: int) -> int:
        """Frames of so many controls."""
        return self.spread + self.sweep * controls + self.together


@dataclass(frozen=True, kw_only=True)
class FrameBlocksOptions:
    """How clips are cut.

    :raises InputError: a number out of range, or margins that leave little of a block
    """

    block: int = field(
        default=30, metadata={"help": "frames of a clip that are held out together, about", "range": (2, 1e6)}
    )
    margin: int = field(
        default=2, metadata={"help": "frames left out between two blocks of a clip", "range": (0, 1000)}
    )

    def __post_init__(self) -> None:
        check_ranges(self)
        if not 2 * self.margin < self.block:
            raise InputError("option margin", f"is {self.margin}, expected less than half of block {self.block}")


@dataclass(frozen=True, kw_only=True)
class TrainNeuralRigOptions:
    """How a neural rig is trained.

    :raises InputError: a number out of range
    """

    width: int = field(default=256, metadata={"help": "units of the hidden layer", "range": (1, 4096)})
    shapes: int = field(default=128, metadata={"help": "most shapes that motion is a sum of", "range": (1, 2048)})
    tolerance_mm: float = field(
        default=0.01,
        metadata={"help": "what those shapes may leave of all frames, RMS", "unit": "mm", "range": (0.0, 10.0)},
    )
    held_out: float = field(
        default=0.15, metadata={"help": "share of the frames to check on, in whole blocks", "range": (0.01, 0.9)}
    )
    influences: Literal[4, 8, 0] = field(
        default=4,
        metadata={
            "help": "largest number of joints that move a point, as engines and `export --influences` have it: shapes "
            "make up for the others; 0 keeps all",
            "choices": (4, 8, 0),
        },
    )
    steps: int = field(default=6000, metadata={"help": "most steps of training", "range": (1, 1e7)})
    detail: float = field(
        default=1.0,
        metadata={
            "help": "what an error of differential coordinates, dents and bumps, counts beside one of points",
            "range": (0.0, 1000.0),
        },
    )
    sparsity: float = field(
        default=0.2,
        metadata={"help": "how strongly a unit of the hidden layer is held to few controls", "range": (0.0, 10.0)},
    )
    patience: int = field(
        default=1000, metadata={"help": "steps without a better check that end it", "range": (1, 1e7)}
    )
    seed: int = field(default=0, metadata={"help": "of the split, the network and the batches", "range": (0, 2**31)})

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class TrainEncoderOptions:
    """How an encoder is trained.

    :raises InputError: a number out of range
    """

    points: int = field(default=256, metadata={"help": "points that the encoder looks at", "range": (1, 16384)})
    per_token: int = field(default=8, metadata={"help": "of them in one token, neighbours", "range": (1, 256)})
    head_width: int = field(
        default=8, metadata={"help": f"numbers of each of the {HEADS} heads of the attention", "range": (1, 256)}
    )
    layers: int = field(default=2, metadata={"help": "layers of the transformer", "range": (1, 24)})
    reduced: int = field(default=64, metadata={"help": "numbers that a face is reduced to", "range": (1, 4096)})
    noise_mm: float = field(
        default=0.02,
        metadata={"help": "noise on the points that it learns from; 0.1 for scans", "unit": "mm", "range": (0.0, 10.0)},
    )
    held_out: float = field(
        default=0.15, metadata={"help": "share of the frames to check on, in whole blocks", "range": (0.01, 0.9)}
    )
    encoder_steps: int = field(default=2000, metadata={"help": "most steps of training", "range": (1, 1e7)})
    encoder_patience: int = field(
        default=1000, metadata={"help": "steps without a better check that end it", "range": (1, 1e7)}
    )
    seed: int = field(default=0, metadata={"help": "of the split, the network and the batches", "range": (0, 2**31)})

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class AttachOptions:
    """What of the shapes is kept."""

    offset_tolerance_mm: float = field(
        default=1e-2,
        metadata={
            "help": "a shape leaves out points that it moves by less than this",
            "range": (0.0, 1.0),
            "unit": "mm",
        },
    )
    keep_shapes: bool = field(
        default=True,
        metadata={
            "help": "keep the face's own shapes beside the rig's, to be set as before and for clips that play them; "
            "without them files are smaller"
        },
    )


@dataclass(frozen=True, kw_only=True)
class InvertNeuralRigOptions:
    """How controls are found for points.

    :raises InputError: a number out of range
    """

    mode: Literal["lm", "adam"] = field(
        default="lm",
        metadata={"help": "bounded Levenberg-Marquardt, or Adam from random controls", "choices": ("lm", "adam")},
    )
    l1: float = field(
        default=2e-4,
        metadata={
            "help": "price of a control its whole range from its default",
            "unit": "mm2",
            "range": (0.0, 1e6),
        },
    )
    smoothness: float = field(
        default=1e-3,
        metadata={
            "help": "price of a change of speed by the range a frame, squared, in clips",
            "unit": "mm2",
            "range": (0.0, 1e6),
        },
    )
    starts: int = field(
        default=6,
        metadata={"help": "starts of frames that fit much worse than the others, or are few", "range": (1, 100)},
    )
    steps: int = field(default=60, metadata={"help": "most steps from a start (lm)", "range": (1, 1e6)})
    points: int = field(
        default=500, metadata={"help": "points that second derivatives are of, with bones (lm)", "range": (3, 1e7)}
    )
    accuracy_mm: float = field(
        default=0.01,
        metadata={
            "help": "how near targets are known, for what is told of controls",
            "unit": "mm",
            "range": (0, 10),
        },
    )
    adam_steps: int = field(default=1000, metadata={"help": "steps (adam)", "range": (1, 1e7)})
    adam_rate: float = field(
        default=0.05, metadata={"help": "first rate, of ranges; it falls to a hundredth (adam)", "range": (1e-6, 10.0)}
    )
    seed: int = field(default=0, metadata={"help": "of random starts", "range": (0, 2**31)})

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, kw_only=True)
class RetargetOptions:
    """How a neural rig is carried to a subject.

    :raises InputError: a number out of range
    """

    mode: Literal["points", "network"] = field(
        default="points",
        metadata={
            "help": "point by point in closed form, or the published fully connected network of the whole deformation",
            "choices": ("points", "network"),
        },
    )
    noise_mm: float = field(
        default=-1.0,
        metadata={
            "help": "noise on what the rig says while the subject is learned; -1: what does best on frames left out",
            "unit": "mm",
            "range": (-1.0, 100.0),
        },
    )
    noise: float = field(
        default=0.05,
        metadata={"help": "noise at first, in deviations of the rig's deformations (network)", "range": (0.0, 100.0)},
    )
    steps: int = field(default=3000, metadata={"help": "most steps (network)", "range": (1, 1e7)})
    rounds: int = field(
        default=2, metadata={"help": "how often controls are found, where they aren't given", "range": (1, 20)}
    )
    held_out: float = field(
        default=0.15,
        metadata={"help": "share of the frames, the last ones, that the report is on", "range": (0.01, 0.9)},
    )
    shapes: int = field(default=256, metadata={"help": "most shapes of the subject's rig", "range": (1, 2048)})
    tolerance_mm: float = field(
        default=0.005, metadata={"help": "what those may leave, RMS", "unit": "mm", "range": (0.0, 10.0)}
    )

    def __post_init__(self) -> None:
        check_ranges(self)
