"""A scan of a known person and the face to fit to it, as arrays that all sides of rebuild.py load."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from children import Json

from facepipe.geometry.similarity import Similarity, fit_similarity

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

HEAD = 14062  # first points of ICT-FaceKit: face, neck, back of the head, insides of mouth and sockets
_TESTS = Path(__file__).resolve().parents[1] / "tests" / "support"
_REACH_MM, _ANGLE = 10.0, 0.84  # places on the scan that count for the distance from it


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


class Clock:
    """Wall and processor seconds since it was made."""

    def __init__(self) -> None:
        self._wall, self._processor = time.perf_counter(), time.process_time()

    def read(self) -> Json:
        """Both; the second is of all threads together."""
        return {"wall_s": time.perf_counter() - self._wall, "processor_s": time.process_time() - self._processor}
