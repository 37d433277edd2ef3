"""Landmarks of random heads, without pictures: ``python training/features_geometry.py OUT.npz --persons 10000``.

What landmarks show of a head can be learned from many more heads than there is time to paint. OUT.npz holds `VIEWS`
rows a person, one after the other:

- ``marks`` (n, 68, 2) float32 landmarks in the aligned crop, 0..1, with a random expression and camera
- ``shapes`` (n, 204) float32 landmarks of the person's neutral, as ``neutral`` of `features_heads.py`
- ``attributes`` (n, a) float32 slider values 0..1, NaN where the person has none; ``names`` (a,) str
- ``sources`` (n,) int8: 0 drawn from the modes of identity, 1 the average head under sliders of bones
"""

from __future__ import annotations

import argparse
from pathlib import Path

import head_sources
import numpy as np
import scenes
from features_heads import neutral_landmarks

from facepipe.geometry.face_crops import face_crop, to_crop

VIEWS = 2
_SHARE_SLIDERS = 0.5


def marks_of(subject: head_sources.Subject, rng: np.random.Generator) -> np.ndarray:
    """(68, 2) in the aligned crop, seen as `scenes.render` sees heads."""
    _, marks = scenes.random_camera(subject.pose(rng), scenes.Placement(1.0, 0.0, np.zeros(2)), scenes.SIZE, rng)
    return np.asarray(to_crop(marks, face_crop(marks, 1)))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Landmarks of random heads, without pictures.")
    parser.add_argument("out", type=Path, help="the .npz file")
    parser.add_argument("--persons", type=int, default=10000, help="how many (default 10000)")
    parser.add_argument("--seed", type=int, default=3, help="of the heads (default 3)")
    options = parser.parse_args()
    rng, rows = np.random.default_rng(options.seed), []
    for _ in range(options.persons):
        who = head_sources.Person(rng, by_sliders=rng.random() < _SHARE_SLIDERS)
        subject, by_sliders = who.bare(), np.isfinite(who.attributes).all()
        shape = neutral_landmarks(subject).ravel()
        rows += [(marks_of(subject, rng), shape, who.attributes, by_sliders) for _ in range(VIEWS)]
    marks, shapes, attributes, sources = (np.array(one) for one in zip(*rows, strict=True))
    np.savez(
        options.out,
        marks=marks.astype(np.float32),
        shapes=shapes.astype(np.float32),
        attributes=attributes.astype(np.float32),
        sources=sources.astype(np.int8),
        names=np.array(head_sources.slider_names()),
    )


if __name__ == "__main__":
    main()
