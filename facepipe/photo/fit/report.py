"""What a photo fit found, as it was authored, and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from facepipe.core.reports import Report, not_in_json, table

if TYPE_CHECKING:
    from facepipe.parts import Slider
    from facepipe.photo.descent.result import Stopped
    from facepipe.photo.fit.fit_face import Fitted
    from facepipe.photo.fit.person_model import IdentityReport

ENDS = {
    "iterations": "all steps made",
    "loss-threshold": "ended at the loss asked for",
    "not-finite": "ended by a loss that was not finite",
}
_SHOWN = 5  # names of a list
_HIDDEN = 0.5  # share of a region from which on it is named
_OFF = 0.01  # of a slider's range, or a weight: what counts as set


def as_text(out: Path, report: PhotoFitReport, sliders: Sequence[Slider]) -> str:
    """How near each photo is, and what was found."""
    count = len(report.photos)
    total = report.losses.get("total")
    loss = f", loss {total.first:.4g} to {total.last:.4g}" if total and report.steps else ""
    steps = f"{report.steps} steps in {report.seconds:.1f} s"
    head = f"{out}: {count} photo{'s' * (count != 1)}, {steps}, {ENDS[report.stopped]}{loss}"
    judged = any(value is not None for value in report.similarities.values())
    titles = [
        "landmarks off by",
        "pixels",
        "of the outer eye corners' distance",
        *["similarity"] * judged,
        "expression",
    ]
    rows: list[list[object]] = [[*titles]]
    for name, photo in report.photos.items():
        alike = [] if not judged else ["none" if photo.similarity is None else f"{photo.similarity:.3f}"]
        figures = (f"{photo.landmark_error_px:.2f}", f"{percent(photo):.1f} %", *alike)
        rows.append([name, *figures, _largest(photo.expressions, {})])
    ranges = {slider.name: slider for slider in sliders}
    off = {name: value - ranges[name].default for name, value in report.sliders.items()}
    spans = {name: ranges[name].maximum - ranges[name].minimum for name in off}
    moved = sum(abs(value) > _OFF * spans[name] for name, value in off.items())
    last = f"{moved} of {len(off)} sliders off their defaults: {_largest(off, spans, report.sliders)}"
    lines = [head, table(rows), last]
    if report.identity is not None:
        lines.append(
            f"sliders leave {report.identity.beyond_sliders_mean_mm:.2f} mm of the person (mean), at most "
            f"{report.identity.beyond_sliders_max_mm:.2f} mm, which is in the neutral"
        )
    if judged and report.similarity_fitted:
        lines.append("the similarity is to a network that the fit was drawn to: --identity 0 keeps them apart")
    if report.at_limit:
        lines.append(f"sliders at a limit: {_some(report.at_limit)}")
    hidden = [f"{name} {share:.0%}" for name, share in report.unseen.items() if share >= _HIDDEN]
    if hidden:
        lines.append(f"no photo shows: {', '.join(hidden)}")
    if report.beyond_limits:
        lines.append(f"beyond bone limits: {_some(report.beyond_limits)}")
    return "\n".join(lines)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")


def _largest(off: Mapping[str, float], spans: Mapping[str, float], values: Mapping[str, float] | None = None) -> str:
    """The names that are furthest off, with their values."""
    shares = {name: abs(value) / max(spans.get(name, 1.0), 1e-9) for name, value in off.items()}
    order = sorted((name for name, share in shares.items() if share > _OFF), key=lambda name: (-shares[name], name))
    shown = ", ".join(f"{name} {(values or off)[name]:.2f}" for name in order[:_SHOWN])
    return (shown + (", ..." if len(order) > _SHOWN else "")) or "none"


@dataclass(frozen=True, kw_only=True)
class PhotoReport:
    """One photo."""

    animation: str  # the pose of the face in the photo; its camera has the same name
    size: tuple[int, int]  # width and height of the photo as it was fitted
    expressions: Mapping[str, float]  # shape -> weight, beside what sliders drive
    landmark_error_px: float  # mean distance of the face's landmarks from the photo's
    eye_distance_px: float  # between the outer corners of the eyes in the photo
    similarity: float | None = None  # of photo and render to the identity network given: cosine, 1 for the same person


@dataclass(frozen=True, kw_only=True)
class Loss:
    """A term of the joint loss, weighted."""

    first: float  # at the first step that had it
    last: float


@dataclass(frozen=True, kw_only=True)
class PhotoFitReport(Report):
    """What a photo fit did."""

    animation: str  # the neutral: the pose of the sliders alone
    sliders: Mapping[str, float]  # that were free
    photos: Mapping[str, PhotoReport]  # by file name
    steps: int
    stopped: Stopped
    losses: Mapping[str, Loss] = field(default_factory=dict)  # "total" and each term
    beyond_limits: tuple[str, ...] = ()  # "joint:channel" where the neutral is beyond the face's limits
    authored: tuple[str, ...] = ()
    seconds: float = 0.0
    identity: IdentityReport | None = None  # where the face has identity modes
    similarity_fitted: bool = False  # the network of the similarities was a term of the fit too
    unseen: Mapping[str, float] = field(default_factory=dict)  # region -> share of it that no photo shows
    at_limit: tuple[str, ...] = ()  # sliders
    fitted: Fitted = not_in_json()  # of the report of an action

    @property
    def similarities(self) -> dict[str, float | None]:
        """Of each photo."""
        return {name: photo.similarity for name, photo in self.photos.items()}

    @property
    def missed(self) -> bool:
        """Whether the fit ended before its time."""
        return self.stopped == "not-finite"


def off_landmarks(report: PhotoFitReport, threshold: float) -> list[str]:
    """A line for each photo whose landmarks are off by more than `threshold` percent."""
    return [
        f"{name}: landmarks off by {percent(photo):.1f} % of the distance of the outer eye corners, "
        f"expected at most {threshold:g} %"
        for name, photo in report.photos.items()
        if percent(photo) > threshold
    ]


def unlike(similarities: Mapping[str, float | None], threshold: float | None) -> list[str]:
    """A line for each photo that the face is less like than a threshold."""
    return [
        f"{name}: similarity of {'no number' if value is None else f'{value:.3f}'}, expected at least {threshold:g}"
        for name, value in similarities.items()
        if threshold is not None and (value is None or value < threshold)
    ]


def implausible(report: PhotoFitReport) -> list[str]:
    """A line where the person is like hardly anyone."""
    identity = report.identity
    if identity is None or identity.deviations <= identity.usual:
        return []
    found = f"{identity.deviations:.2f} standard deviations (root mean square over {identity.modes} modes)"
    return [f"the person is {found} from the average, expected at most {identity.usual:.2f}"]


def percent(photo: PhotoReport) -> float:
    """The mean landmark error, percent of the distance of the outer eye corners."""
    return 100 * photo.landmark_error_px / max(photo.eye_distance_px, 1e-9)


def loss_ends(history: Sequence[Mapping[str, float]]) -> dict[str, Loss]:
    """First and last value of each term, by name; steps with a loss that is not finite don't count."""
    ends: dict[str, Loss] = {}
    for step in history:
        if np.isfinite([float(one) for one in step.values()]).all():
            for name, value in step.items():
                first = ends[name].first if name in ends else float(value)
                ends[name] = Loss(first=first, last=float(value))
    return {name: ends[name] for name in sorted(ends)}
