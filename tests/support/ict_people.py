"""ICT-FaceKit as a rebuild takes it: template, database, and simulated scans as they are read."""

from __future__ import annotations

from pathlib import Path

from import_data import shared
from scan_actors import database_faces
from scan_simulator import SimulatedScan

from facepipe.geometry.identity_model import IdentityModel
from facepipe.importers import ict as ict_importer
from facepipe.importers import load
from facepipe.scanning.database import FaceDatabase
from facepipe.scanning.rebuild import Template
from facepipe.scans import Scan, ScanLandmarks


def ict_template() -> Template:
    """ICT-FaceKit."""
    parts = load("ict", Path(shared("ict_facekit/ict_facekit.npz")), ict_importer.Options()).parts
    return Template.of(parts, "ict.usda")


def ict_database(template: Template) -> FaceDatabase:
    """Sixty people of some of its modes."""
    faces = database_faces()
    identity = IdentityModel.from_faces(faces)
    return FaceDatabase(
        topology=template.topology,
        identity=identity,
        coefficients=identity.coefficients(faces),
        expressions=None,
        entries=(),
        history=(),
        tolerance_mm=0.1,
    )


def read(name: str, scan: SimulatedScan) -> tuple[Scan, ScanLandmarks]:
    """A simulated scan as files are read."""
    return Scan(name=name, points=scan.points, triangles=scan.triangles), ScanLandmarks(points=scan.landmarks)


def ours(weights: dict[str, float]) -> dict[str, float]:
    """Weights by the names that the importer gives the shapes."""
    return {name.replace("_L", "Left").replace("_R", "Right"): weight for name, weight in weights.items()}
