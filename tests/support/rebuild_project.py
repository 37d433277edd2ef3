"""A project of a rebuild with its scans, and the rebuild."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scan_domes
from command_line import done

from facepipe.importers.scan_landmarks import write_scan_landmarks
from facepipe.importers.scan_ply import write_ply
from facepipe.scanning.database import save_database
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import save_parts

PERSON = 9
GAIN = 1.3  # the person opens the jaw further than the template
PROJECT = """
template = "head.usda"
database = "faces.fpdb"
[neutral]
scan = "neutral.ply"
[expressions.open]
scan = "open.ply"
weights = { jawOpen = 1 }
[options.neutral]
unit = "cm"
[options.expressions]
weight_sigma = 0.01
[options.split]
weight_spread = 0
"""


def put_drawer(folder: Path) -> None:
    """A project with its scans, template and database."""
    save_parts(scan_domes.face(), folder / "head.usda")
    save_database(scan_domes.database(), folder / "faces.fpdb")
    scan, landmarks = scan_domes.scan(PERSON)
    put(folder, "neutral", scan, landmarks)
    opened = scan_domes.POSE.scale * motion(scan_domes.grid(61)[0]) @ scan_domes.POSE.rotation.T
    own = scan_domes.grid(31)[0][scan_domes.face().meshes[0].landmarks["multipie68"].indices]
    marks = scan_domes.POSE.scale * motion(own) @ scan_domes.POSE.rotation.T
    put(folder, "open", replace(scan, points=scan.points + opened), ScanLandmarks(points=landmarks.points + marks))
    (folder / "anna.toml").write_text(PROJECT)


def opening(places: np.ndarray) -> np.ndarray:
    """(n, 3) millimetres that the template's jawOpen moves places on the dome."""
    lower = 1.0 / (1.0 + np.exp((places[:, 1] + 12.0) / 4.0))
    return np.where(lower > 0.02, lower, 0.0)[:, None] * np.array([0.0, -6.0, -2.0])


def motion(places: np.ndarray) -> np.ndarray:
    """Those of the person's."""
    return GAIN * opening(places)


def put(folder: Path, name: str, scan: Scan, landmarks: ScanLandmarks) -> None:
    write_ply(scan, folder / f"{name}.ply")
    write_scan_landmarks(landmarks, folder / f"{name}.landmarks.json")


def rebuilt(capsys: pytest.CaptureFixture[str], project: Path, name: str = "anna.usda") -> dict[str, object]:
    out = done(capsys, "rebuild", project, "-o", project.parent / name, "--json", "--force", quiet=False)
    return dict(json.loads(out))


HEAD = 'template = "head.usda"\ndatabase = "faces.fpdb"\n[neutral]\nscan = "neutral.ply"\n'
