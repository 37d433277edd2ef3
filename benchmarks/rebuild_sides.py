"""Sides of rebuild.py, a process each: a scan of a known person is made, or facepipe or trimesh fits a face to it.

usage: rebuild_sides.py --side prepare SEED DATA TASK REPORT
       rebuild_sides.py --side facepipe face|head TASK REPORT
       rebuild_sides.py --side trimesh amberg|sumner default|tuned TASK REPORT
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from children import Json, is_side, peak_memory

from facepipe.geometry.similarity import Similarity, fit_similarity

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]
HEAD = 14062  # first points of ICT-FaceKit: face, neck, back of the head, insides of mouth and sockets
_TESTS = Path(__file__).resolve().parents[1] / "tests" / "support"
_REACH_MM, _ANGLE = 10.0, 0.84  # places on the scan that count for the distance from it
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


class Clock:
    """Wall and processor seconds since it was made."""

    def __init__(self) -> None:
        self._wall, self._processor = time.perf_counter(), time.process_time()

    def read(self) -> Json:
        """Both; the second is of all threads together."""
        return {"wall_s": time.perf_counter() - self._wall, "processor_s": time.process_time() - self._processor}


@dataclass(frozen=True, kw_only=True)
class RebuildTask:
    """Points are in millimetres, those of the scan in its own unit and place."""

    mean: FloatArray  # (n, 3) of the database: what all sides start from
    modes: FloatArray  # (k, n, 3) of one standard deviation
    triangles: IntArray  # (t, 3)
    seen: IntArray  # (m,) points that a scan can show
    landmarks: IntArray  # (68,) points
    truth: FloatArray  # (n, 3)
    scan_points: FloatArray  # (p, 3)
    scan_triangles: IntArray  # (q, 3)
    scan_landmarks: FloatArray  # (68, 3)
    pose: FloatArray  # (13,) rotation, translation and scale from the truth to the scan
    areas: IntArray  # (2,) points of the face area and of its narrow part: the first ones

    @classmethod
    def of(cls, seed: int, data: Path) -> RebuildTask:
        """The person `seed`, whom the tests' simulator scans; the database holds 60 others."""
        sys.path.append(str(_TESTS))
        import import_data

        import_data.SHARED = data
        from scan_actors import Actor, database_faces, ict
        from scan_simulator import simulate, visible_triangles

        from facepipe.geometry.identity_model import IdentityModel

        identity = IdentityModel.from_faces(database_faces()[:, :HEAD])
        person, seen = Actor(seed).neutral, np.unique(visible_triangles(ict().neutral))
        scan = simulate(person, seed)
        return cls(
            mean=identity.mean,
            modes=identity.components * identity.deviations[:, None, None],
            triangles=ict().triangles[(ict().triangles < HEAD).all(axis=1)],
            seen=seen[seen < HEAD],
            landmarks=ict().landmarks,
            truth=person[:HEAD],
            scan_points=scan.points,
            scan_triangles=scan.triangles,
            scan_landmarks=scan.landmarks,
            pose=np.concatenate([scan.pose.rotation.ravel(), scan.pose.translation, [scan.pose.scale]]),
            areas=np.array([ict().full_face, ict().narrow_face]),
        )

    @classmethod
    def load(cls, path: str | Path) -> RebuildTask:
        """What `save` has written."""
        with np.load(path) as arrays:
            return cls(**{field.name: arrays[field.name] for field in fields(cls)})

    def save(self, path: str | Path) -> None:
        """As .npz."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    def face_alone(self) -> RebuildTask:
        """The same with the mesh of the face area alone."""
        count = int(self.areas[0])
        arrays: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays |= {"mean": self.mean[:count], "modes": self.modes[:, :count], "truth": self.truth[:count]}
        inside = (self.triangles < count).all(axis=1)
        arrays |= {"triangles": self.triangles[inside], "seen": self.seen[self.seen < count]}
        return RebuildTask(**arrays)

    def start(self) -> Similarity:
        """From the scan to the mean face, by landmarks."""
        return fit_similarity(self.scan_landmarks, self.mean[self.landmarks])

    def errors(self, fitted: FloatArray, place: Similarity) -> Json:
        """How far points (n, 3) are from where they truly are, in the truth's size and place, and from the scan.

        :param place: from the scan to where the points are
        """
        from facepipe.geometry.polygons import point_normals
        from facepipe.geometry.registration import ScanTarget

        full, narrow = self.areas
        pose = Similarity(rotation=self.pose[:9].reshape(3, 3), translation=self.pose[9:12], scale=float(self.pose[12]))
        at_home = pose.undo(place.undo(fitted))
        off = np.linalg.norm(at_home[:full] - self.truth[:full], axis=1)
        seen = self.seen[self.seen < full]
        normals = point_normals(at_home, self.triangles[(self.triangles < len(at_home)).all(axis=1)])[seen]
        scan = ScanTarget.of_surface(pose.undo(self.scan_points), self.scan_triangles)
        matches = scan.matches(at_home[seen], normals, _REACH_MM, _ANGLE)
        return {
            "mean_mm": float(off.mean()),
            "p95_mm": float(np.percentile(off, 95)),
            "narrow_mean_mm": float(off[:narrow].mean()),
            "narrow_p95_mm": float(np.percentile(off[:narrow], 95)),
            "surface_mm": float(matches.distances[matches.kept].mean()),
        }


def prepare(seed: str, data: str, task: str) -> Json:
    """Write the task."""
    made = RebuildTask.of(int(seed), Path(data))
    made.save(task)
    return {
        "seed": int(seed),
        "scan_points": len(made.scan_points),
        "scan_triangles": len(made.scan_triangles),
        "modes": len(made.modes),
    }


def facepipe_fit(mesh: str, path: str) -> Json:
    """The fit of a neutral as `fit_neutral` makes it, of the mesh of the face area alone or of the whole head."""
    import scipy.sparse.linalg
    import scipy.spatial.transform  # noqa: F401  (modules are loaded before the clock runs)

    from facepipe.geometry.registration import Anchors, DeformableSurface, ScanTarget, register

    task = RebuildTask.load(path)
    task = task.face_alone() if mesh == "face" else task
    before, clock = peak_memory(), Clock()
    surface = DeformableSurface(
        base=task.mean,
        modes=task.modes,
        expected=np.zeros(len(task.modes)),
        precision=np.full(len(task.modes), 0.1),
        triangles=task.triangles,
        seen=task.seen,
        held=np.zeros(len(task.mean)),
    )
    target = ScanTarget.of_surface(task.scan_points, task.scan_triangles)
    anchors = Anchors.at_points(task.landmarks, task.scan_landmarks)
    found = register(surface, target, anchors, task.start())
    seconds, peak = clock.read(), peak_memory()
    errors = task.errors(found.points, found.place)
    return {**seconds, **errors, "points": len(task.mean), "before_bytes": before, "peak_bytes": peak}


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


if __name__ == "__main__":
    is_side({"prepare": prepare, "facepipe": facepipe_fit, "trimesh": trimesh_fit})
