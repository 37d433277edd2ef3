"""The side of trimesh in rebuild.py: its two non-rigid registrations, with their own settings and with better ones."""

from __future__ import annotations

from typing import Any

from children import Json, peak_memory
from rebuild_task import Clock, RebuildTask

TUNED: dict[str, dict[str, Any]] = {
    "amberg": {  # stiffness, landmarks, normals, rounds
        "steps": [[0.02, 30, 0.5, 10], [0.01, 30, 0.5, 10], [0.005, 30, 0.5, 10], [0.002, 30, 0.5, 10]],
        "distance_threshold": 0.03,
    },
    "sumner": {  # nearest places, identity, smoothness, landmarks, normals
        "steps": [[1, 0.3, 1, 1000, 0], *([wanted, 0.3, 1, 1000, 1] for wanted in (1, 10, 100, 100))],
        "distance_threshold": 0.03,
    },
}
"""What fitted best of about ten settings each on another person (seed 103)."""


def trimesh_fit(kind: str, setting: str, path: str) -> Json:
    """The mesh of the face area drawn onto the scan by ``nricp_amberg`` or ``nricp_sumner``."""
    import rtree  # noqa: F401  (modules are loaded before the clock runs)
    import scipy.sparse.linalg
    import scipy.spatial  # noqa: F401
    import trimesh
    import trimesh.registration

    fit = {"amberg": trimesh.registration.nricp_amberg, "sumner": trimesh.registration.nricp_sumner}[kind]
    task = RebuildTask.load(path).face_alone()
    before, clock = peak_memory(), Clock()
    place = task.start()
    source = trimesh.Trimesh(task.mean, task.triangles, process=False)
    scan = trimesh.Trimesh(place.apply(task.scan_points), task.scan_triangles, process=False)
    fitted = fit(
        source,
        scan,
        source_landmarks=task.landmarks,
        target_positions=place.apply(task.scan_landmarks),
        **(TUNED[kind] if setting == "tuned" else {}),
    )
    seconds, peak = clock.read(), peak_memory()
    errors = task.errors(fitted, place)
    return {
        **seconds,
        **errors,
        "points": len(task.mean),
        "before_bytes": before,
        "peak_bytes": peak,
        "version": trimesh.__version__,
    }
