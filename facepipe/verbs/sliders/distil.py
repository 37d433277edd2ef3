"""A face whose sliders do nearly what they did, by straight lines and one small learned network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.core.threads import one_thread
from facepipe.declare import check_ranges
from facepipe.parts import FaceParts, Slider, SliderNetwork
from facepipe.rig import CHANNELS, Rig, build, slide
from facepipe.rig.sliders import channel_entries, shape_entries
from facepipe.verbs.sliders.options import DistilOptions
from facepipe.verbs.sliders.shape_fits import channel_effects

VECTORS = 200  # held-out slider vectors that errors are measured on
LEVER_MM = 10.0  # what a radian, or a factor, is taken to move where a joint moves no point


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Sizes of errors."""

    mean: float
    p95: float
    max: float


@dataclass(frozen=True, kw_only=True)
class DistilReport(Report):
    """What was learnt, and how far off it is on slider vectors that it never saw."""

    sliders: tuple[str, ...]  # that the network takes
    channels: int  # that it adds to
    shapes: int
    width: int
    activation: str
    seed: int
    steps: int
    vectors: int  # held out: random all over the ranges
    points_mm: Spread | None  # over all points and vectors; None for a face without points
    coefficients: Mapping[str, Spread] = field(default_factory=dict)  # translation (stage units), rotation (rad), scale
    shape_weights: Spread | None = None
    threshold_mm: float = 0.0

    @property
    def missed(self) -> bool:
        """A point is further off than the threshold."""
        return self.points_mm is not None and self.points_mm.max > self.threshold_mm


class DistilSliders(DistilOptions):
    """Learns what curves and a network of a face's sliders do: they become straight, one small network does the rest.

    What is straight already stays exactly so. Needs torch.
    """

    @one_thread()
    def __call__(self, parts: FaceParts) -> tuple[FaceParts, DistilReport]:
        """The face with its learned sliders, and how good they are.

        :raises InputError: an option out of range, no sliders, sliders of what is not there, or no torch
        """
        check_ranges(self)
        if not parts.sliders:
            raise InputError(parts.name, "no sliders, expected some to learn from")
        from facepipe.rig.torch.distil import bent_sliders, distil

        rig = build(parts)
        bent = bent_sliders(parts.sliders, parts.slider_network)
        if not bent:
            warning = "all sliders are straight: there is nothing to learn, the graph is exact"
            return parts, self._report(0, None, Errors(), (warning,))
        face = (parts.sliders, parts.slider_network, rig.joints, rig.shapes, _driven(rig, parts, bent))
        sliders, network, steps = distil(
            *face, width=self.width, activation=self.activation, seed=self.seed, steps=self.steps
        )
        # errors of posed points, as the loss of training weighs coefficients by what each moves alone; on vectors of
        # another stream than the training's, which are learnt ones
        random = np.random.default_rng((self.seed, 1))
        columns = [(rig.joints.index(joint), CHANNELS.index(channel)) for joint, channel in network.channels]
        off_by: dict[str, list[Any]] = {"t": [], "r": [], "s": [], "shape": [], "point": []}
        for _ in range(VECTORS):
            values = {slider.name: float(random.uniform(slider.minimum, slider.maximum)) for slider in parts.sliders}
            exact, exact_weights = slide(parts.sliders, rig.joints, values, parts.slider_network)
            learnt, weights = slide(sliders, rig.joints, values, network)
            off: FloatArray = np.abs(learnt - exact)
            for joint, channel in columns:
                off_by[CHANNELS[channel][0]].append(off[joint, channel])
            off_by["shape"] += [abs(weights.get(name, 0.0) - exact_weights.get(name, 0.0)) for name in network.shapes]
            if len(rig.points):
                moved = rig.evaluate(weights, coefficients=learnt) - rig.evaluate(exact_weights, coefficients=exact)
                off_by["point"].append(np.linalg.norm(moved, axis=1) * parts.meters_per_unit * 1000.0)
        kinds = {"translation": "t", "rotation": "r", "scale": "s"}
        errors = Errors(
            points_mm=_spread(off_by["point"]),
            coefficients={name: one for name, key in kinds.items() if (one := _spread(off_by[key])) is not None},
            shape_weights=_spread(off_by["shape"]),
        )
        warnings: tuple[str, ...] = ()
        if errors.points_mm is not None and errors.points_mm.max > self.threshold_mm:
            off_mm = f"up to {errors.points_mm.max:.3f} mm off, expected at most {self.threshold_mm:g}"
            advice = "a larger width learns more; without distilling the graph is exact"
            warnings = (f"the learned sliders are {off_mm} ({advice})",)
        report = self._report(steps, network, errors, warnings)
        figures = {key: value for key, value in asdict(report).items() if key not in ("sliders", "warnings")}
        return replace(parts, sliders=sliders, slider_network=replace(network, info={"distilled": figures})), report

    def _report(
        self, steps: int, network: SliderNetwork | None, errors: Errors, warnings: tuple[str, ...]
    ) -> DistilReport:
        return DistilReport(
            sliders=network.sliders if network else (),
            channels=len(network.channels) if network else 0,
            shapes=len(network.shapes) if network else 0,
            width=self.width,
            activation=self.activation,
            seed=self.seed,
            steps=steps,
            vectors=VECTORS if network else 0,
            threshold_mm=self.threshold_mm,
            warnings=warnings,
            **vars(errors),
        )


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of learned sliders."""

    points_mm: Spread | None = None
    coefficients: Mapping[str, Spread] = field(default_factory=dict)
    shape_weights: Spread | None = None


def _spread(sizes: list[Any]) -> Spread | None:
    if not sizes:
        return None
    whole = np.concatenate([np.atleast_1d(size) for size in sizes])
    mean, p95, largest = whole.mean(), np.percentile(whole, 95), whole.max()
    return Spread(mean=float(mean), p95=float(p95), max=float(largest))


def _driven(rig: Rig, parts: FaceParts, bent: tuple[Slider, ...]) -> list[Any]:
    """What curves and network of the `bent` sliders add to, with what a unit of it moves the face."""
    from facepipe.rig.torch.distil import Driven

    network = parts.slider_network
    channels = {(joint, channel) for one in bent for (joint, channel, _), curve in channel_entries(one) if curve}
    shapes = {shape for one in bent for (shape, _), curve in shape_entries(one) if curve}
    if network is not None:
        channels |= set(network.channels)
        shapes |= set(network.shapes)
    mm = parts.meters_per_unit * 1000.0
    effects = channel_effects(rig) * mm if rig.joints else np.zeros((0, 9))
    reach = dict.fromkeys(rig.shapes, 0.0)
    for target in rig.targets:
        name = rig.shapes[target.shape]
        reach[name] = max(reach[name], float(np.linalg.norm(target.offsets, axis=1).max(initial=0.0)) * mm)
    driven = []
    for joint, channel in sorted(channels):
        if joint not in rig.joints or channel not in CHANNELS:
            raise InputError("sliders", f"no joint '{joint}' with a channel '{channel}'")
        effect = float(effects[rig.joints.index(joint), CHANNELS.index(channel)])
        # not 0: the channel would have no share in the error, and learned gains are divided by it
        least = mm if channel.startswith("t") else LEVER_MM
        driven.append(Driven(channel=(joint, channel), shape=None, mm=effect or least))
    return driven + [Driven(channel=None, shape=shape, mm=reach.get(shape) or LEVER_MM) for shape in sorted(shapes)]
