"""How true a rebuild is: simulated scans of people that the database can't show, from scans to shapes.

Each actor has a neutral and 15 expressions scanned; every stage of `facepipe rebuild` runs on the scans, and with
--joint once more, from a neutral that was refined on all of them. Distances are those of points from where they truly
are, in millimetres, over the face area; "surface" is that of the neutral's points from the true surface. Shapes are
measured by the sum of their errors over that of the generic ones, carried to the rebuilt neutral by deformation
transfer.

usage: python benchmarks/rebuild_truth.py [--actors 6] [--joint] [--json OUT]
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from arguments import positive
from tables import aligned

FloatArray = npt.NDArray[np.floating]

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

_FIRST = 101
_COLUMNS = {
    "neutral": "mean",
    "neutral p95": "p95",
    "surface": "surface",
    "narrow": "narrow",
    "narrow p95": "p95",
    "expressions": "expressions",
    "delta": "delta",
    "delta p95": "p95",
    "template delta": "template's",
    "template p95": "p95",
    "shapes": "shapes / generic",
    "worse": "worse of 53",
    "worst": "worst / generic",
}
_WRONG = "pucker"


class Actor:
    """One actor, rebuilt."""

    def __init__(self, seed: int, template: Any, database: Any) -> None:
        from scan_actors import COMPOSITES, Actor, ict
        from scan_simulator import simulate

        self._model, self._who, self._composites = ict(), Actor(seed), COMPOSITES
        self._seed, self._template, self._database = seed, template, database
        self._scan = simulate(self._who.neutral, seed)
        truths = {name: self._who.composite(shown) for name, shown in COMPOSITES.items()}
        self._scans = {
            name: (truth, simulate(truth, 100 * seed + number)) for number, (name, truth) in enumerate(truths.items())
        }

    def figures(self, *, joint: bool, wrong: bool) -> dict[str, dict[str, float]]:
        """All of its rows."""
        from facepipe.scanning.rebuild.fit_neutral import fit_neutral

        scan, landmarks = self._read("neutral", self._scan)
        base, _, report = fit_neutral(self._template, scan, landmarks, self._database)
        rows, (shapes, registered) = {}, self._expressions(base)
        rows["alone"] = self._row(base, shapes, registered)
        if wrong:
            rows |= self._with_wrong(base, shapes, registered)
        if joint:
            base = self._together(scan, base, np.array(report.coefficients), shapes, registered)
            rows["joint"] = self._row(base, *self._expressions(base))
        return rows

    def _with_wrong(
        self, base: Any, shapes: dict[str, FloatArray], registered: dict[str, Any]
    ) -> dict[str, dict[str, float]]:
        """Rows with another's scan of an expression and with the neutral's, and the same with what belongs."""
        from scan_actors import Actor
        from scan_simulator import simulate

        from facepipe.scanning.rebuild import register_scan
        from facepipe.scanning.rebuild.scan_check import misfits, scan_checks

        other = Actor(self._seed + 1)
        truths = {"person": other.composite(self._composites[_WRONG]), "neutral": self._who.neutral}
        rows, self._place = {}, base.place
        for kind, truth in truths.items():
            given = self._given(_WRONG, simulate(truth, 100 * self._seed + 99))
            found = registered | {_WRONG: register_scan(self._template, base, shapes, given)}
            composites = self._given_weights(found)
            fits = {name: vars(report.fit) for name, (_, _, report) in found.items()}
            judged = scan_checks(self._template, base.points, shapes, composites, fits)
            left_out = misfits(judged, {name: one.weights for name, one in composites.items()})
            print(f"{self._seed}: {kind}: left out: {left_out}", file=sys.stderr)
            rows[f"wrong {kind}"] = self._row(base, shapes, found)
            belonging = {name: one for name, one in found.items() if name not in left_out}
            rows[f"wrong {kind} left out"] = self._row(base, shapes, belonging)
        return rows

    def _expressions(self, base: Any) -> tuple[dict[str, FloatArray], dict[str, Any]]:
        """The personal template, and what was registered from it."""
        from facepipe.scanning.rebuild import register_scan, starting_shapes

        shapes = starting_shapes(self._template, base.points)
        return shapes, {name: register_scan(self._template, base, shapes, self._given(name)) for name in self._scans}

    def _together(
        self, scan: Any, base: Any, coefficients: FloatArray, shapes: dict[str, FloatArray], registered: dict[str, Any]
    ) -> Any:
        """The neutral refined on all scans."""
        from facepipe.scanning.rebuild import fit_together

        placed = [replace(self._given(name), place=place) for name, (_, place, _) in registered.items()]
        fit, _, _, _ = fit_together(self._template, scan, base, coefficients, self._database, shapes, placed)
        return fit

    def _row(self, base: Any, shapes: dict[str, FloatArray], registered: dict[str, Any]) -> dict[str, float]:
        self._place = base.place
        rows = [self._expression(name, base, shapes, one.points) for name, (one, _, _) in registered.items()]
        found = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        found |= self._neutral(base.points) | self._split(base.points, shapes, registered)
        return {key: float(value) for key, value in found.items()}

    def _neutral(self, points: FloatArray) -> dict[str, float]:
        from facepipe.geometry.closest_points import closest_places

        points, truth = self._home(points), self._who.neutral
        face, near = slice(0, self._model.full_face), slice(0, self._model.narrow_face)
        off = np.linalg.norm(points - truth, axis=1)
        nearest = closest_places(points[face], truth, self._model.triangles).places
        surface = np.linalg.norm(points[face] - nearest, axis=1)
        found = {"neutral": off[face].mean(), "neutral p95": np.percentile(off[face], 95), "surface": surface.mean()}
        return found | {"narrow": off[near].mean(), "narrow p95": np.percentile(off[near], 95)}

    def _expression(self, name: str, base: Any, shapes: dict[str, FloatArray], points: FloatArray) -> dict[str, float]:
        face, (truth, _) = slice(0, self._model.full_face), self._scans[name]
        own, weights = self._home(base.points), self._given(name).weights
        motion = (truth - self._who.neutral)[face]
        start = base.points + np.sum([weight * shapes[shape] for shape, weight in weights.items()], axis=0)
        delta, before = (np.linalg.norm((self._home(one) - own)[face] - motion, axis=1) for one in (points, start))
        return {
            "expressions": np.linalg.norm((self._home(points) - truth)[face], axis=1).mean(),
            "delta": delta.mean(),
            "delta p95": np.percentile(delta, 95),
            "template delta": before.mean(),
            "template p95": np.percentile(before, 95),
        }

    def _given(self, name: str, scanned: Any = None) -> Any:
        """A scanned expression as a project gives it."""
        from facepipe.scanning.rebuild import ExpressionScan

        scan, landmarks = self._read(name, scanned or self._scans[name][1])
        weights = {_ours(shape): weight for shape, weight in self._composites[name].items()}
        return ExpressionScan(scan=scan, landmarks=landmarks, weights=weights)

    def _split(
        self, neutral: FloatArray, shapes: dict[str, FloatArray], registered: dict[str, Any]
    ) -> dict[str, float]:
        from facepipe.scanning.rebuild.split_expressions import split_expressions

        found, _ = split_expressions(self._template, neutral, shapes, self._given_weights(registered))
        errors = np.array([[self._off(one, name) for name in self._model.names] for one in (found, shapes)])
        worse = int((errors[0] > errors[1] * (1.0 + 1e-6)).sum())
        worst = float((errors[0] / errors[1]).max())
        return {"shapes": errors[0].sum() / errors[1].sum(), "worse": worse, "worst": worst}

    def _given_weights(self, registered: dict[str, Any]) -> dict[str, Any]:
        """Registered expressions with the weights that were asked for."""
        from facepipe.scanning.rebuild.register_scans import Composite

        return {
            name: Composite(
                points=one.points,
                weights={_ours(shape): weight for shape, weight in self._composites[name].items()},
                matched=one.matched,
            )
            for name, (one, _, _) in registered.items()
        }

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
    from facepipe.scanning.database import FaceDatabase
    from facepipe.scanning.rebuild import Template

    parts = load("ict", Path(shared("ict_facekit/ict_facekit.npz")), ict.Options()).parts
    template, faces = Template.of(parts, "ict.usda"), database_faces()
    identity = IdentityModel.from_faces(faces)
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
    parser.add_argument("--joint", action="store_true", help="also from a neutral refined on all scans")
    parser.add_argument("--wrong", action="store_true", help="also with a scan that does not belong")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    template, database = _prepared()
    found: dict[str, dict[str, dict[str, float]]] = {}
    for seed in range(_FIRST, _FIRST + arguments.actors):
        for way, row in Actor(seed, template, database).figures(joint=arguments.joint, wrong=arguments.wrong).items():
            found.setdefault(way, {})[str(seed)] = row
            print(f"{way} {seed}: " + ", ".join(f"{key} {row[key]:.3f}" for key in _COLUMNS), file=sys.stderr)
    table = [("", "actor", *_COLUMNS.values())]
    for way, rows in found.items():
        rows["mean"] = {key: float(np.mean([row[key] for row in rows.values()])) for key in _COLUMNS}
        table += [(way, seed, *(f"{row[key]:.3f}" for key in _COLUMNS)) for seed, row in rows.items()]
    print("\n".join(aligned(table)))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, sort_keys=True, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
