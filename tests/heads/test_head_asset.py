"""The package data of the head: what `samples/head` makes of its sources, to half a step, and to rounding."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from import_data import shared
from PIL import Image
from places import REPOSITORY, SHARED

from facepipe.heads.asset import IDENTITY_MODES, STEP, asset
from facepipe.payload.basis import decode_basis
from facepipe.rig.conventions import ARKIT_SHAPES

DATA = REPOSITORY / "facepipe" / "heads" / "data"
HALF_A_STEP = STEP / 2 + 1e-6


@pytest.fixture(scope="module")
def source() -> dict[str, np.ndarray]:
    with np.load(shared("ict_facekit/ict_facekit.npz")) as arrays:
        return {name: arrays[name] for name in arrays.files}


def outside_the_mouth() -> np.ndarray:
    """The points that the asset has as they are in its source."""
    mouth = [
        np.arange(one.start, one.stop) for one in (asset().parts[name].points for name in ("GumsAndTongue", "Teeth"))
    ]
    return np.setdiff1d(np.arange(len(asset().points)), np.concatenate(mouth))


def test_modes_are_those_of_the_source(source: dict[str, np.ndarray]) -> None:
    head = asset()
    kept = outside_the_mouth()
    assert np.abs(head.points[kept] - source["neutral"][kept]).max() < 1e-6
    assert np.abs(head.modes[:, kept] - source["identity_deltas"][:, kept]).max() < HALF_A_STEP


@pytest.mark.parametrize("weights", [{}, {"jawOpen": 1.0}, {"jawLeft": 1.0}])
def test_teeth_are_those_of_the_source_in_a_smaller_size(
    source: dict[str, np.ndarray], weights: dict[str, float]
) -> None:
    head, theirs = asset(), source["neutral"].astype(np.float64)
    ours, names = head.points, source["expression_names"].tolist()
    for name in weights:
        ours, theirs = ours + head.shapes[name][1.0], theirs + source["expression_deltas"][names.index(name)]
    incisor = slice(18067, 18143)
    spans = [np.linalg.norm(one[incisor] - one[incisor.start], axis=1)[1:] for one in (ours, theirs)]
    np.testing.assert_allclose(spans[0] / spans[1], 0.92, rtol=0.02)


def test_shapes_are_those_of_the_source_made_even(source: dict[str, np.ndarray]) -> None:
    head = asset()
    theirs = dict(
        zip(source["expression_names"].tolist(), source["expression_deltas"][:, : len(head.points)], strict=True)
    )
    both = theirs["browInnerUp_L"].astype(np.float64) + theirs["browInnerUp_R"]
    for name, offsets in {
        "mouthSmileLeft": theirs["mouthSmile_L"],
        "jawOpen": theirs["jawOpen"],
        "browInnerUp": both,
    }.items():
        missed = np.linalg.norm(head.shapes[name][1.0] - offsets, axis=1)[outside_the_mouth()]
        assert np.sqrt((missed**2).mean()) < 0.01 * np.linalg.norm(offsets, axis=1).max()


def test_there_are_the_52_shapes_of_arkit() -> None:
    assert set(asset().shapes) >= ARKIT_SHAPES
    assert all(list(ways)[-1] == 1.0 for ways in asset().shapes.values())


def test_parts_hold_all_points_and_faces_once() -> None:
    head = asset()
    ends = np.cumsum(head.counts)
    points, faces, corners = 0, 0, 0
    for name, part in head.parts.items():
        assert (part.points.start, part.faces.start, part.corners.start) == (points, faces, corners)
        points, faces, corners = part.points.stop, part.faces.stop, part.corners.stop
        assert ends[faces - 1] == corners
        used = np.unique(head.indices[part.corners])
        np.testing.assert_array_equal(used, np.arange(part.points.start, part.points.stop))
        assert head.place(part.points.start + 1) == (name, 1)
    assert (points, faces, corners) == (len(head.points), len(head.counts), len(head.indices))
    np.testing.assert_allclose(sum(head.regions.values()), 1.0, atol=1e-12)


def test_the_head_is_small_without_its_pictures() -> None:
    whole = ("head.npz", "head.fpbasis", "lids.npz", "measures.npz", "identity.npz")
    assert sum((DATA / name).stat().st_size for name in whole) <= 5_000_000
    assert (DATA / "head.fpbasis").stat().st_size <= 3_000_000


def test_identity_joints_are_sound() -> None:
    own = asset().basis.identity_joints
    assert own is not None
    places, indices, weights = own.places, own.indices, own.weights
    skin = asset().parts["Head"].points
    assert indices.shape == weights.shape == (skin.stop, 8)
    assert (indices < len(places)).all()
    assert (weights.sum(axis=1, dtype=np.int64) == 255).all()
    for joints, shares in zip(indices[::50], weights[::50], strict=True):
        used = joints[shares > 0]
        assert len(set(used.tolist())) == len(used), "a joint twice"
    low, high = 10 * asset().points[skin].min(axis=0), 10 * asset().points[skin].max(axis=0)
    assert ((places > low) & (places < high)).all()


@pytest.mark.slow
def test_the_script_makes_the_same_files(tmp_path: Path) -> None:
    """But for a few numbers in archives, which processors round differently.

    What hangs on the skin is compared by its places: one on an edge is of two triangles, and rounding says which.
    """
    shared("ict_facekit/ict_facekit.npz"), shared("makehuman/makehuman_head.npz")
    script = REPOSITORY / "samples" / "head" / "build.py"
    subprocess.run([sys.executable, script, "--data", SHARED, "-o", tmp_path], check=True, capture_output=True)
    # of the finished head, by a script of its own: what its sliders do
    others = {"identity.npz"}
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in DATA.iterdir()} - others
    for path in tmp_path.iterdir():
        made, shipped = contents(path), contents(DATA / path.name)
        assert made.keys() == shipped.keys()
        for name, values in made.items():
            assert (values.dtype, values.shape) == (shipped[name].dtype, shipped[name].shape), (path.name, name)
            most = 0.01 if path.suffix in (".npz", ".fpbasis") else 0
            assert (values != shipped[name]).mean() <= most, (path.name, name)


def contents(path: Path) -> dict[str, Any]:
    """Arrays of a file by name: those of an archive, a picture's pixels, or the bytes."""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            found = dict(arrays)
        for name in [name.removesuffix("_shares") for name in found if name.endswith("_shares")]:
            if f"{name}_corners" in found:
                corners, two = found.pop(f"{name}_corners"), found.pop(f"{name}_shares") / 255
                shares = np.column_stack([two, 1 - two.sum(axis=1)])
                places = np.einsum("nk,nkc->nc", shares, asset().points[corners])
                found[f"{name}_places"] = places.astype(np.float32)
        return found
    if path.suffix == ".fpbasis":
        basis = decode_basis(path.read_bytes(), path)[0]
        rows = [*basis.levels, *basis.joints]
        tables = {
            f"{name}{i}": getattr(one, name) for i, one in enumerate(rows) for name in one._fields if name != "path"
        }
        # later modes are components of people that the finished head draws: their signs are the processor's
        return {"places": basis.places, "modes": basis.modes[:IDENTITY_MODES], **tables}
    if path.suffix in (".png", ".jpg"):
        with Image.open(path) as image:
            return {"pixels": np.asarray(image)}
    return {"bytes": np.frombuffer(path.read_bytes(), np.uint8)}


@pytest.mark.slow
def test_dense_points_are_those_that_the_script_chooses() -> None:
    chosen = runpy.run_path(str(REPOSITORY / "samples" / "head" / "dense_points.py"))["chosen"]()
    assert chosen == json.loads((DATA / "dense.json").read_text())
