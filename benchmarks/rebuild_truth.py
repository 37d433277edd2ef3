"""How true a rebuild is: simulated scans of people that the database can't show, from scans to shapes.

Each actor has a neutral and 15 expressions scanned; every stage of `facepipe rebuild` runs on the scans. Distances are
those of points from where they truly are, in millimetres, over the face area. Shapes are told by the sum of their
errors over that of the generic ones, which deformation transfer carries to the rebuilt neutral.

usage: python benchmarks/rebuild_truth.py [--actors 6] [--json OUT]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from arguments import positive
from tables import aligned

FloatArray = npt.NDArray[np.floating]

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

_FIRST = 101
_COLUMNS = {
    "neutral": "mean",
    "neutral p95": "p95",
    "narrow": "narrow",
    "narrow p95": "p95",
    "expressions": "expressions",
    "delta": "delta",
    "delta p95": "p95",
    "template delta": "template's",
    "template p95": "p95",
    "shapes": "shapes / generic",
    "worse": "worse of 53",
}


class Actor:
    """One actor, rebuilt."""

    def __init__(self, seed: int, template: Any, database: Any) -> None:
        from scan_actors import COMPOSITES, Actor, ict
        from scan_simulator import simulate

        self._model, self._who, self._composites = ict(), Actor(seed), COMPOSITES
        self._seed, self._template, self._database = seed, template, database
        self._scan = simulate(self._who.neutral, seed)

    def figures(self) -> dict[str, float]:
        """All of its row."""
        from facepipe.processors.rebuild import FitNeutral, NeutralScan, PersonalTemplate

        scan, landmarks = self._read("neutral", self._scan)
        fit = FitNeutral()(self._template, scan, landmarks, self._database)
        self._place = fit.place
        off = np.linalg.norm(self._home(fit.points) - self._who.neutral, axis=1)
        narrow = off[: self._model.narrow_face]
        off = off[: self._model.full_face]
        found = {"neutral": off.mean(), "neutral p95": np.percentile(off, 95)}
        found |= {"narrow": narrow.mean(), "narrow p95": np.percentile(narrow, 95)}
        shapes = PersonalTemplate()(self._template, fit.points)
        base = NeutralScan(points=fit.points, place=fit.place, landmarks=landmarks)
        registered, rows = self._registered(base, shapes)
        found |= {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        found |= self._split(fit.points, shapes, registered)
        return {key: float(value) for key, value in found.items()}

    def _registered(self, base: Any, shapes: dict[str, FloatArray]) -> tuple[dict[str, Any], list[dict[str, float]]]:
        from scan_simulator import simulate

        from facepipe.processors.rebuild import ExpressionScan, RegisterScans

        found, rows, face = {}, [], slice(0, self._model.full_face)
        own = self._home(base.points)
        for number, (name, shown) in enumerate(self._composites.items()):
            truth = self._who.composite(shown)
            weights = {_ours(shape): weight for shape, weight in shown.items()}
            scan, landmarks = self._read(name, simulate(truth, 100 * self._seed + number))
            given = ExpressionScan(scan=scan, landmarks=landmarks, weights=weights)
            found[name] = RegisterScans()(self._template, base, shapes, given)
            motion = (truth - self._who.neutral)[face]
            start = base.points + np.sum([weight * shapes[shape] for shape, weight in weights.items()], axis=0)
            delta, before = (
                np.linalg.norm((self._home(points) - own)[face] - motion, axis=1)
                for points in (found[name].points, start)
            )
            off = np.linalg.norm((self._home(found[name].points) - truth)[face], axis=1)
            rows.append(
                {
                    "expressions": off.mean(),
                    "delta": delta.mean(),
                    "delta p95": np.percentile(delta, 95),
                    "template delta": before.mean(),
                    "template p95": np.percentile(before, 95),
                }
            )
        return found, rows

    def _split(
        self, neutral: FloatArray, shapes: dict[str, FloatArray], registered: dict[str, Any]
    ) -> dict[str, float]:
        from facepipe.processors.rebuild.register_scans import Composite
        from facepipe.processors.rebuild.split_expressions import SplitExpressions

        composites = {
            name: Composite(
                points=one.points,
                weights={_ours(shape): weight for shape, weight in self._composites[name].items()},
                matched=one.matched,
            )
            for name, one in registered.items()
        }
        found = SplitExpressions()(self._template, neutral, shapes, composites).shapes
        errors = np.array([[self._off(one, name) for name in self._model.names] for one in (found, shapes)])
        worse = int((errors[0] > errors[1] * (1.0 + 1e-6)).sum())
        return {"shapes": errors[0].sum() / errors[1].sum(), "worse": worse}

    def _off(self, shapes: Any, name: str) -> float:
        """Mean distance of a shape's deltas from the truth."""
        turned = self._home(shapes[_ours(name)]) - self._home(np.zeros((1, 3)))
        apart = (turned - self._who.shape(name))[: self._model.full_face]
        return float(np.linalg.norm(apart, axis=1).mean())

    def _home(self, points: FloatArray) -> FloatArray:
        """Points of the rebuild in the actor's own place and size."""
        return np.asarray(self._scan.pose.undo(self._place.undo(points)))

    def _read(self, name: str, scan: Any) -> tuple[Any, Any]:
        from facepipe.scans import Scan, ScanLandmarks

        read = Scan(name=name, points=scan.points, triangles=scan.triangles)
        return read, ScanLandmarks(points=scan.landmarks)


def _ours(name: str) -> str:
    """A shape's name as the importer gives it."""
    return name.replace("_L", "Left").replace("_R", "Right")


def _prepared() -> tuple[Any, Any]:
    """The template and the database of 60 people."""
    from import_data import shared
    from scan_actors import database_faces

    from facepipe.geometry.identity_model import IdentityModel
    from facepipe.importers import ict, load
    from facepipe.processors.database import FaceDatabase
    from facepipe.processors.rebuild import Template

    parts = load("ict", Path(shared("ict_facekit/ict_facekit.npz")), ict.Options()).parts
    template, faces = Template.of(parts, "ict.usda"), database_faces()
    identity = IdentityModel.of(faces)
    database = FaceDatabase(
        topology=template.topology,
        identity=identity,
        coefficients=identity.coefficients(faces),
        expressions=None,
        entries=(),
        history=(),
        tolerance_mm=0.1,
    )
    return template, database


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--actors", type=positive, default=6, help="how many, of other seeds each (default 6)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    template, database = _prepared()
    rows = {}
    for seed in range(_FIRST, _FIRST + arguments.actors):
        rows[str(seed)] = Actor(seed, template, database).figures()
        print(f"{seed}: " + ", ".join(f"{key} {value:.3f}" for key, value in rows[str(seed)].items()), file=sys.stderr)
    rows["mean"] = {key: float(np.mean([row[key] for row in rows.values()])) for key in _COLUMNS}
    table = [("", "", *_COLUMNS.values())]
    table += [("actor", seed, *(f"{row[key]:.3f}" for key in _COLUMNS)) for seed, row in rows.items()]
    print("\n".join(aligned(table)))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, sort_keys=True, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
