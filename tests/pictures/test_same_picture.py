"""The same picture to the byte: on one thread and on several, and whatever the seed of Python's hashes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

SCRIPT = """
import hashlib, os, sys
os.cpu_count = lambda: int(sys.argv[1])
import numpy as np
from facepipe.parts import FaceParts, Material, Mesh
from facepipe.pictures import PictureOptions, picture

up, around = np.meshgrid(np.linspace(0, np.pi, 40), np.linspace(0, 2 * np.pi, 80), indexing="ij")
points = np.stack([np.sin(up) * np.sin(around), np.cos(up), np.sin(up) * np.cos(around)], axis=-1).reshape(-1, 3)
corner = np.arange(3200).reshape(40, 80)
quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).ravel()
meshes = [
    Mesh(
        name=name, points=points * scale, face_vertex_counts=np.full(len(quads) // 4, 4, np.int32),
        face_vertex_indices=quads.astype(np.int32), material=name,
    )
    for name, scale in (("skin", 10.0), ("film", 11.0))
]
materials = (Material(name="skin", diffuse_color=(0.6, 0.4, 0.3)), Material(name="film", opacity=0.3, roughness=0.1))
image = picture(FaceParts(meshes=tuple(meshes), materials=materials), None, PictureOptions(size=300))
print(hashlib.sha256(image.tobytes()).hexdigest())
"""


@pytest.fixture(scope="module")
def one_thread() -> str:
    return digest("1", "0")


def digest(threads: str, seed: str) -> str:
    environment = os.environ | {"PYTHONHASHSEED": seed, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
    command = [sys.executable, "-c", SCRIPT, threads]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    ("threads", "seed"),
    [("4", "7"), pytest.param("1", "1", marks=pytest.mark.slow), pytest.param("2", "0", marks=pytest.mark.slow)],
)
def test_threads_and_hash_seeds_change_nothing(one_thread: str, threads: str, seed: str) -> None:
    assert digest(threads, seed) == one_thread
