"""What a first guess by a network spares a photo fit: few steps from it against many from the defaults.

usage: python benchmarks/photo_amortised.py start.onnx [--faces 4] [--seed 0] [--few 20] [--many 200] [--rate 0.1]
       [--networks] [--json out.json]

start.onnx is what `facepipe sample -o head.usdc && facepipe train-photo head.usdc -o start.onnx` writes. The portraits
are those of `photo_recovery.py`: known people, rendered by `facepipe.pictures` in lights, skins and before backgrounds
that no training saw, with noisy landmarks. Rows, means over the faces, by what comes before the descent:

  landmarks       stage one, bounded Levenberg-Marquardt on landmarks and priors
  raw             nothing: the defaults with the pose of an affine camera, or the guess as it is
  defaults        as `facepipe fit-photo` begins
  guess           as `facepipe fit-photo --start` does; it takes the raw one where that is better, as it mostly is
  truth           at the person's own sliders, expression and camera, what a network is trained to give

On each face all descents lower one joint loss: the trust in pixels is that of the defaults after stage one, and shadows
are always those of the face as it is, renewed once more before its loss is taken. Columns: the joint loss at the start,
after few steps of the rate, and from the defaults after many of the fit's own rate; seconds of these steps; mean slider
errors (a share of the range, sliders that move the head by more than 1 mm). The last lines compare few steps from the
guess, and from the truth, with many from the defaults.
Without --networks the joint loss is that of landmarks, colours and sparsity.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from tables import aligned

if TYPE_CHECKING:
    from recovery_targets import RecoveryTarget

    from facepipe.photo.amortised.guess import Guess
    from facepipe.photo.descent.descent import Unknowns
    from facepipe.photo.descent.joint_loss import JointLoss
    from facepipe.photo.descent.landmark_fit import State
    from facepipe.photo.descent.subject import Subject
    from facepipe.photo.options import PhotoFitOptions

STARTS = (("landmarks", "defaults"), ("landmarks", "guess"), ("raw", "defaults"), ("raw", "guess"), ("raw", "truth"))


@dataclass(frozen=True, kw_only=True)
class Descents:
    """One face from one start."""

    face: int
    stage: str
    start: str
    begin: float  # joint loss
    few: float
    few_s: float  # of the descent alone
    few_slider: float
    many: float = np.nan
    many_s: float = np.nan
    many_slider: float = np.nan


@dataclass(frozen=True, kw_only=True)
class _End:
    begin: float
    loss: float
    seconds: float
    slider: float


def main() -> None:
    """Fit, print the table, write JSON."""
    import torch

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", type=Path, metavar="start.onnx", help="of the sample with seed 0")
    parser.add_argument("--faces", type=positive, default=4, help="people (default 4)")
    parser.add_argument("--seed", type=int, default=0, help="of the people (default 0)")
    parser.add_argument("--few", type=positive, default=20, help="steps (default 20)")
    parser.add_argument("--many", type=positive, default=200, help="steps (default 200)")
    parser.add_argument("--rate", type=float, default=0.1, help="of the few steps (default 0.1)")
    parser.add_argument("--networks", action="store_true", help="with the terms of our own feature network")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = measured(arguments)
    print(table(found, arguments.few, arguments.many))
    lines = verdicts(found, arguments.few, arguments.many)
    print("\n".join(lines))
    if arguments.json:
        settings = {name: getattr(arguments, name) for name in ("faces", "seed", "few", "many", "rate", "networks")}
        report = {**settings, "fits": [_numbers(one) for one in found], "verdicts": lines}
        arguments.json.write_text(json.dumps(report, indent=2, sort_keys=True), encoding="utf-8")


def _numbers(one: Descents) -> dict[str, object]:
    """Without what was not measured, which JSON can't hold."""
    return {name: value for name, value in asdict(one).items() if value == value}


def measured(arguments: argparse.Namespace) -> list[Descents]:
    """Every face from every start."""
    from recovery_targets import sample, target

    from facepipe.photo.amortised.guess import load_start
    from facepipe.photo.descent.subject import Subject
    from facepipe.photo.options import PhotoFitOptions

    off = {} if arguments.networks else {"content": 0.0, "identity": 0.0, "attributes": 0.0}
    guess = load_start(arguments.network, Subject.of(sample().parts))
    found: list[Descents] = []
    for number in range(arguments.faces):
        for one in _of_face(target(number, arguments.seed), guess, PhotoFitOptions(**off), arguments):
            found.append(one)
            print(f"\rface {number + 1} of {arguments.faces}: {one.stage}, {one.start}", end="  ", file=sys.stderr)
    print(file=sys.stderr)
    return found


def _of_face(
    made: RecoveryTarget, guess: Guess, options: PhotoFitOptions, arguments: argparse.Namespace
) -> Iterator[Descents]:
    from recovery_state import true_state

    image = made.image.astype(np.float32) / 255
    loss = _joint_loss(made, image, guess, options)
    space = loss.fit.spaces[0]
    raw = {
        "defaults": loss.fit.start(),
        "guess": guess(image, made.landmarks, space),
        "truth": true_state(made, guess.subject, space),
    }
    _calibrate(loss, loss.fit.solve(raw["defaults"]))
    for stage, start in STARTS:
        state = loss.fit.solve(raw[start]) if stage == "landmarks" else raw[start]
        figures: dict[str, float] = {}
        for name in ("few", "many") if start == "defaults" else ("few",):
            own = replace(options, iterations=getattr(arguments, name))
            own = replace(own, rate=arguments.rate) if name == "few" else own
            end = _descended(made, loss, state, own)
            figures |= {name: end.loss, f"{name}_s": end.seconds, f"{name}_slider": end.slider, "begin": end.begin}
        yield Descents(face=made.number, stage=stage, start=start, **figures)


def _joint_loss(made: RecoveryTarget, image: np.ndarray, guess: Guess, options: PhotoFitOptions) -> JointLoss:
    from facepipe.photo.descent.fit import pose_space, priors_of
    from facepipe.photo.descent.joint_loss import FEATURES, JointLoss
    from facepipe.photo.descent.landmark_fit import LandmarkFit
    from facepipe.photo.descent.working_photo import WorkingPhoto
    from facepipe.photo.features.extractor import own_extractors
    from facepipe.photo.renderer.face_model import FaceModel

    space = pose_space(guess.subject, image.shape[1], image.shape[0])
    fit = LandmarkFit(guess.subject, [made.landmarks], [space], priors_of(options))
    model = FaceModel(guess.subject.parts, largest_texture=options.size)
    extractors = own_extractors([kind for kind in FEATURES if getattr(options, kind)])
    return JointLoss(model, fit, [WorkingPhoto.from_photo(image, made.landmarks, options.size)], extractors, options)


def _calibrate(loss: JointLoss, state: State) -> None:
    """The joint loss as a fit that starts there has it."""
    from facepipe.photo.descent import lighting

    loss.calibrate(lighting.lit(loss, state))


def _descended(made: RecoveryTarget, loss: JointLoss, state: State, options: PhotoFitOptions) -> _End:
    from facepipe.photo.descent import lighting
    from facepipe.photo.descent.descent import descend
    from facepipe.photo.descent.lighting import in_better_light

    start = in_better_light(loss, lighting.lit(loss, state))
    begin = _total(loss, start)
    began = time.perf_counter()
    best = descend(loss, start, options, renew=partial(lighting.renew_shadows, loss)).best
    seconds = time.perf_counter() - began
    lighting.renew_shadows(loss, best)
    slider = _slider_error(made, loss.fit.subject, best.state().shares)
    return _End(begin=begin, loss=_total(loss, best), seconds=seconds, slider=slider)


def _total(loss: JointLoss, at: Unknowns) -> float:
    import torch

    with torch.no_grad():
        return float(loss(at)["total"])


def _slider_error(made: RecoveryTarget, subject: Subject, shares: np.ndarray) -> float:
    from recovery_measures import MOVES_MM, slider_reach

    reach = slider_reach(subject.parts, made.sliders)
    mm = 1000 * subject.parts.meters_per_unit
    values = subject.slider_values(shares)
    errors = [
        abs(values[i] - made.sliders[one.name]) / (one.maximum - one.minimum)
        for i, one in enumerate(subject.parts.sliders)
        if i in subject.sliders and mm * reach.get(one.name, 0.0) > MOVES_MM
    ]
    return float(np.mean(errors))


def table(found: list[Descents], few: int, many: int) -> str:
    """The means for people."""
    steps = [f"{few} steps", f"{many} steps"]
    cells = [("first", "start", "begin", *steps, *steps, "sliders", "sliders")]
    for stage, start in STARTS:
        own = [one for one in found if (one.stage, one.start) == (stage, start)]
        names = ("begin", "few", "many", "few_s", "many_s", "few_slider", "many_slider")
        means = {name: float(np.mean([getattr(one, name) for one in own])) for name in names}
        texts = [f"{value:.1f} s" if name.endswith("_s") else f"{value:.3f}" for name, value in means.items()]
        cells.append((stage, start, *("" if text.startswith("nan") else text for text in texts)))
    return "\n".join(aligned(cells))


def verdicts(found: list[Descents], few: int, many: int) -> list[str]:
    """Few steps from the guess against many from the defaults: alike before, and the quickest of both."""
    by_way = {way: [one for one in found if (one.stage, one.start) == way] for way in STARTS}
    defaults = [one for one in STARTS if one[1] == "defaults"]
    ways = [((stage, "guess"), (stage, start)) for stage, start in defaults]
    ways += [(("raw", start), ("landmarks", "defaults")) for start in ("guess", "truth")]
    lines = []
    for begun, default in ways:
        pairs = zip(by_way[begun], by_way[default], strict=True)
        ratios = [one.few / other.many for one, other in pairs]
        what = f"{begun[1]} ({begun[0]}) + {few} steps over defaults ({default[0]}) + {many} steps"
        reached = f"no higher on {sum(ratio <= 1 for ratio in ratios)} of {len(ratios)}"
        lines.append(f"{what}: joint loss {np.mean(ratios):.3f} times as high, worst {max(ratios):.3f}; {reached}")
    return lines


if __name__ == "__main__":
    main()
