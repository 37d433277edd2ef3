"""What a file with a network for first guesses says of itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from facepipe.learn.photo.amortised.network import MEAN, SIZE, STD
from facepipe.learn.photo.subject import Subject

if TYPE_CHECKING:
    from facepipe.learn.photo.amortised.training import Trained
    from facepipe.start_options import StartOptions

KEY = "facepipe.photo"
KIND = "photo-start"
_CONVENTIONS = {
    "image": "(b, 3, size, size) RGB, sRGB 0..1 less mean over std, the crop 'face' by the 68 landmarks",
    "landmarks": "(b, 68, 2) x right, y down, in sides of the crop from its top left corner",
    "shares": "0..1 of the sliders' ranges, in their order",
    "expressions": "weights 0..1 of the expressions, in their order",
    "pose": "rotation vector (3, radians) from facing the viewer, along the line of sight; middle of the head (2) and "
    "logarithm of its size in sides of the crop; logarithm of its distance in head heights",
}


def controls(subject: Subject) -> dict[str, Any]:
    """What a network's outputs stand for: sliders with their ranges, expressions, the axis that points up."""
    sliders = [
        {"name": one.name, "range": [_short(one.minimum), _short(one.maximum)], "default": _short(one.default)}
        for one in subject.free_sliders
    ]
    shapes = [subject.rig.shapes[i] for i in subject.expressions]
    return {"sliders": sliders, "expressions": shapes, "up_axis": subject.parts.up_axis}


def start_metadata(trained: Trained, options: StartOptions) -> dict[str, Any]:
    """As JSON; how it was trained without the names of files."""
    flags = {name: getattr(options, name) for name in ("people", "renders", "epochs", "steps", "seed")}
    photos = f"{trained.photos} photos without labels, after " if trained.photos else ""
    images = "--images DIR " if trained.photos else ""
    return {
        "kind": KIND,
        "face": trained.subject.parts.name,
        **controls(trained.subject),
        "size": SIZE,
        "crop": "face",
        "mean": [MEAN] * 3,
        "std": [STD] * 3,
        "order": "RGB",
        "conventions": _CONVENTIONS,
        "trained_on": f"{photos}{options.renders} renders of FACE",
        "training": f"facepipe train-photo FACE -o OUT {images}"
        + " ".join(f"--{name} {value}" for name, value in flags.items()),
        **flags,
        "held_out": {
            "pictures": trained.held_out,
            "before": _rounded(trained.before),
            "after": _rounded(trained.after),
        },
    }


def held_out(trained: Trained) -> dict[str, Any]:
    """The joint loss on pictures that training has not seen, by term."""
    return {
        "pictures": trained.held_out,
        "before": _rounded(trained.before),
        "after": _rounded(trained.after),
    }


def _rounded(terms: dict[str, float]) -> dict[str, float]:
    return {name: _short(value) for name, value in terms.items()}


def _short(value: float) -> float:
    """Six digits: what a stage keeps of a number, and it is the same on every machine."""
    return float(f"{value:.6g}")
