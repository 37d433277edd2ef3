"""Stages of the head as it was while all people shared the shapes of lids, and modes left lips apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gltf_reader
import numpy as np
import pytest
from shared_lids import LOOKS, with_shared_lids

import facepipe
from facepipe.heads.assembly import make_head
from facepipe.heads.asset import arrays, asset
from facepipe.heads.people import Look, draw
from facepipe.heads.surfaces import dressed
from facepipe.parts import FaceParts
from facepipe.stage import save_parts

KEPT = ("eyeLookDownLeft", "eyeSquintRight", "eyeBlinkLeft", "jawOpen", "mouthClose")


def few(parts: FaceParts) -> FaceParts:
    """The face with some of its shapes, and without what needs the others."""
    meshes = tuple(
        replace(mesh, blendshapes=tuple(one for one in mesh.blendshapes if one.name in KEPT)) for mesh in parts.meshes
    )
    return replace(parts, meshes=meshes, sliders=(), animations=(), played=None)


def former(seed: int) -> FaceParts:
    """A person as those stages hold one: the modes' lips, and looks and squints of the package."""
    return few(with_shared_lids(make_head(draw(seed).identity, closed=False)))


def offsets(parts: FaceParts, name: str) -> np.ndarray:
    """(n, 3) of the skin at 1."""
    mesh = parts.meshes[0]
    found, shape = np.zeros_like(mesh.points), next(one for one in mesh.blendshapes if one.name == name)
    found[shape.point_indices] = shape.offsets
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a stage of before, one of today, and their blend."""
    folder = tmp_path_factory.mktemp("heads")
    for name, parts in (("former", former(3)), ("today", few(make_head(draw(5).identity)))):
        save_parts(dressed(parts, Look(), None), folder / f"{name}.usdc")
    facepipe.blend([folder / "former.usdc", folder / "today.usdc"], out=folder / "mix.usdc")
    return folder


def test_they_open_with_their_own_lids_and_lips(folder: Path) -> None:
    found, made, fitted = facepipe.open(folder / "former.usdc").parts(), former(3), make_head(draw(3).identity)
    np.testing.assert_allclose(found.meshes[0].points, made.meshes[0].points, atol=1e-5)
    assert np.abs(found.meshes[0].points - fitted.meshes[0].points).max() > 0.02  # cm, of lips that would meet now
    for name in LOOKS:
        if name in KEPT:
            shared = asset().shapes[name][1.0][: len(made.meshes[0].points)]
            np.testing.assert_allclose(offsets(found, name), shared, atol=1e-5)
            assert np.abs(offsets(fitted, name) - shared).max() > 0.02


def test_they_blend_with_heads_of_today(folder: Path) -> None:
    """Lids of the blend move as those of both in the mean, but for what keeps them before its eyeballs."""
    faces = [facepipe.open(folder / f"{name}.usdc").parts() for name in ("former", "today", "mix")]
    assert [len(mesh.points) for mesh in faces[2].meshes] == [len(mesh.points) for mesh in faces[0].meshes]
    lids = arrays("lids")["lids"].ravel()
    for name in KEPT:
        one, other, mix = (offsets(face, name)[lids] for face in faces)
        apart = np.abs(one - other).max()  # cm
        assert (apart > 0.04) == name.startswith("eye")
        assert np.abs(mix - (one + other) / 2).max() < 0.2 * apart + 0.005, name


def test_their_blend_is_exported_as_it_is(folder: Path) -> None:
    mix, path = facepipe.open(folder / "mix.usdc"), folder / "mix.glb"
    facepipe.export(mix, path)
    file = gltf_reader.read(path)
    skin = mix.parts().meshes[0]
    for weights in ({}, {"eyeLookDownLeft": 1.0}, {"jawOpen": 1.0, "mouthClose": 1.0}):
        points = file.evaluate(weights)["Head"]
        moved = skin.points + sum((weight * offsets(mix.parts(), name) for name, weight in weights.items()), 0.0)
        np.testing.assert_allclose(100 * points, moved, atol=1e-4)
