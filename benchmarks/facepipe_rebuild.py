"""Child of rebuild.py: prepares a scan of a known person, or fits a face to it with facepipe or with trimesh.

usage: facepipe_rebuild.py prepare SEED DATA TASK REPORT
       facepipe_rebuild.py facepipe face|head TASK REPORT
       facepipe_rebuild.py trimesh amberg|sumner default|tuned TASK REPORT
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from children import Json, peak_memory, write_report
from rebuild_task import Clock, RebuildTask
from trimesh_rebuild import trimesh_fit


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
    """The fit of a neutral as `FitNeutral` makes it, of the mesh of the face area alone or of the whole head."""
    import scipy.sparse.linalg
    import scipy.spatial.transform  # noqa: F401  (modules are loaded before the clock runs)

    from facepipe.geometry.registration import Anchors, DeformableSurface, ScanTarget, register

    with contextlib.suppress(ImportError):
        import cholespy  # noqa: F401
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


def main(words: Sequence[str]) -> int:
    """Run one of the jobs and write what it reports to the last argument."""
    jobs = {"prepare": prepare, "facepipe": facepipe_fit, "trimesh": trimesh_fit}
    write_report(words[-1], jobs[words[0]](*words[1:-1]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
