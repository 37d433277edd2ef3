"""Landmarks of random heads, without pictures: ``python training/features_geometry.py OUT.npz --persons 40000``.

What landmarks tell of a head can be learned from many more heads than there is time to paint. OUT.npz holds `VIEWS`
rows a person, one after the other:

- ``marks`` (n, 68, 2) float32 landmarks in the aligned crop, 0..1, with a random expression and camera
- ``shapes`` (n, 204) float32 landmarks of the person's neutral, as ``neutral`` of `features_heads.py`
- ``attributes`` (n, a) float32 slider values 0..1, NaN where the person has none; ``names`` (a,) str
- ``sources`` (n,) int8: 0 ICT-FaceKit, 1 sample
"""

from __future__ import annotations

import argparse
from pathlib import Path

import head_sources
import heads
import numpy as np
import scenes
import torch
from features_heads import neutral_landmarks
from scipy.spatial.transform import Rotation
from script_arguments import add_heads

from facepipe.learn.features.crops import face_crop, to_crop

VIEWS = 2
_SHARE_SAMPLE = 0.5


def marks_of(subject: head_sources.Subject, rng: np.random.Generator) -> np.ndarray:
    """(68, 2) in the aligned crop, seen as `scenes.render` sees heads."""
    points = subject.pose(rng).numpy().astype(np.float64)
    yaw, pitch = np.radians(np.clip(rng.normal(0, 19), -45, 45)), np.radians(np.clip(rng.normal(0, 9), -24, 24))
    local = points @ Rotation.from_euler("XY", [pitch, yaw]).as_matrix().T
    local -= local[subject.topology.landmarks].mean(axis=0)
    distance = float(np.exp(rng.uniform(np.log(32), np.log(220))))
    depth = np.maximum(distance - local[:, 2:], 1.0)
    marks = scenes._landmarks(subject.topology, local[:, :2] / depth * distance * (1, -1))
    return np.asarray(to_crop(marks, face_crop(marks, 1)))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Landmarks of random heads, without pictures.")
    parser.add_argument("out", type=Path, help="the .npz file")
    parser.add_argument("--persons", type=int, default=40000, help="how many (default 40000)")
    add_heads(parser, seed=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    studio = heads.Studio(options.ict)
    rng, rows = np.random.default_rng(options.seed), []
    for _ in range(options.persons):
        sample = rng.random() < _SHARE_SAMPLE
        subject = (studio.samples[rng.integers(len(studio.samples))] if sample else studio.ict).draw(rng)
        known = subject.attributes if sample else np.full(len(studio.names), np.nan)
        shape = neutral_landmarks(subject).ravel()
        rows += [(marks_of(subject, rng), shape, known, sample) for _ in range(VIEWS)]
    marks, shapes, attributes, sources = (np.array(one) for one in zip(*rows, strict=True))
    np.savez(
        options.out,
        marks=marks.astype(np.float32),
        shapes=shapes.astype(np.float32),
        attributes=attributes.astype(np.float32),
        sources=sources.astype(np.int8),
        names=np.array(studio.names),
    )


if __name__ == "__main__":
    main()
