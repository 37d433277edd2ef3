"""Shapes on heads of others that are known: fitted, carried, and held against the truth."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from transfer_heads import MOVED_MM, TransferHead, head

from facepipe.geometry.similarity import fit_similarity
from facepipe.heads.assembly import average
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild import Template
from facepipe.scanning.rebuild.built_in_head import people
from facepipe.scanning.transfer import Carried, carried, fit_head
from facepipe.scans import ScanLandmarks
from facepipe.verbs.whole_faces import whole_face

pytestmark = pytest.mark.slow
OFF_MM = 2.0


@cache
def known() -> tuple[Template, FaceDatabase]:
    body = average()
    return Template.of(body, "head"), people(body)


def on(made: TransferHead) -> Carried:
    """Its shapes, as found; its landmarks say how far off they are."""
    template, database = known()
    landmarks = ScanLandmarks(points=made.landmarks, sigma_mm=np.full(68, OFF_MM / np.sqrt(3.0)))
    fit = fit_head(template, database, made.points, made.triangles, landmarks)
    deltas = whole_face(average(), "head").deltas
    return carried(template, fit, {name: deltas[name] for name in made.shapes})


def means(made: TransferHead, found: Carried) -> dict[str, float]:
    """Shape -> mean error in millimetres of the points that truly move."""
    off = {}
    for name, truth in made.shapes.items():
        moved = made.mm_per_unit * np.linalg.norm(truth, axis=1) > MOVED_MM
        off[name] = made.mm_per_unit * np.linalg.norm(found.deltas[name] - truth, axis=1)[moved].mean()
    return off


def test_shapes_of_a_coarse_head_are_true_whatever_its_unit_and_place() -> None:
    pytest.importorskip("fast_simplification")
    made = head(0, 3000, off_mm=OFF_MM)
    found = on(made)
    off = means(made, found)
    assert len(off) == 52
    assert np.mean(list(off.values())) < 0.13
    assert off["jawOpen"] < 0.3
    # the same head in its own place, in millimetres
    home = fit_similarity(made.points, made.identity[made.kept])
    again = on(
        TransferHead(**{**vars(made), "points": home.apply(made.points), "landmarks": home.apply(made.landmarks)})
    )
    for name, delta in found.deltas.items():
        np.testing.assert_allclose(again.deltas[name], home.scale * delta @ home.rotation.T, rtol=0, atol=1e-3)


def test_shapes_of_a_head_that_no_mode_of_people_reaches_are_true() -> None:
    # a smooth warp of 5 mm: by the modes of people and a membrane alone 0.18 and 0.42 mm
    pytest.importorskip("fast_simplification")
    made = head(0, 3000, warp_mm=5.0, off_mm=OFF_MM, names=("jawOpen", "eyeBlinkLeft", "eyeBlinkRight"))
    off = means(made, on(made))
    assert off["jawOpen"] < 0.33
    assert max(off.values()) < 0.6
