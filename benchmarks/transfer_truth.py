"""How true shapes are that are carried to the meshes of other heads: identities of ICT-FaceKit, whose shapes are known.

Each head is decimated by fast-simplification, turned, scaled and far from the origin; its truth is deformation transfer
on the undecimated identity, at the points that are left (tests/support/transfer_heads.py). Landmarks are exact, or 2 mm
off and say so. "Beyond the model" is a smooth warp of 5 mm that no identity mode holds. Errors are means over the
points that truly move by more than 0.3 mm, in millimetres; of blinks, as a share of their mean motion, also of blinks
whose truth has lids that end at the hole instead of running into sockets. 99 % of the points of the lips in jawOpen and
of the lids in blinks are within the last columns, beside what copying the motion of the nearest point of the template
gives on the same fit.

usage: python benchmarks/transfer_truth.py [--seeds 10] [--json OUT]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from arguments import positive
from tables import aligned, verdict

FloatArray = npt.NDArray[np.floating]

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

_ROWS: dict[str, dict[str, Any]] = {
    "inside the model, 14k triangles": {"triangles": 14000},
    "the same, 3k, landmarks 2 mm off": {"triangles": 3000, "off_mm": 2.0},
    "beyond the model, 14k triangles": {"triangles": 14000, "warp_mm": 5.0},
    "the same, 3k, landmarks 2 mm off ": {"triangles": 3000, "off_mm": 2.0, "warp_mm": 5.0},
}
_AIMS = (
    {"shapes": 0.13, "jaw": 0.25, "blink": 8.0},
    {"shapes": 0.20, "jaw": 0.50},
    {"shapes": 0.35, "jaw p99": 4.0},
    {"shapes": 0.60, "jaw p99": 4.0},
)
_SHARE_OF_NEAREST = 1.0 / 3.0
_COLUMNS = {
    "shapes": "52 shapes",
    "jaw": "jawOpen",
    "jaw p99": "p99",
    "blink": "blink %",
    "blink bare": "no sockets %",
    "lips": "lips p99",
    "lips nearest": "nearest",
    "lids": "lids p99",
    "lids nearest": "nearest",
    "fit": "fit s",
    "carry": "carry s",
}
_BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")


class Bench:
    """The head in the box, who people may be, and its shapes."""

    def __init__(self) -> None:
        from facepipe.heads.assembly import average
        from facepipe.scanning.rebuild import Template
        from facepipe.scanning.rebuild.built_in_head import people
        from facepipe.verbs.whole_faces import whole_face

        body = average()
        self._template, self._people = Template.of(body, "head"), people(body)
        self._shapes = whole_face(body, "head").deltas
        self._labels = self._template.labels[self._template.row_of]

    def figures(self, seed: int, *, off_mm: float = 0.0, **kind: Any) -> dict[str, float]:
        """All columns of one head."""
        from transfer_heads import head, identity_shapes, shape_names

        from facepipe.scanning.transfer import carried, fit_head
        from facepipe.scans import ScanLandmarks

        made = head(seed, off_mm=off_mm, **kind)
        sigma = off_mm / np.sqrt(3.0) if off_mm else np.nan
        landmarks = ScanLandmarks(points=made.landmarks, sigma_mm=np.full(68, sigma))
        start = time.process_time()
        fit = fit_head(self._template, self._people, made.points, made.triangles, landmarks)
        middle = time.process_time()
        found = carried(self._template, fit, {name: self._shapes[name] for name in shape_names()})
        end = time.process_time()
        truth = {name: made.mm_per_unit * delta for name, delta in made.shapes.items()}
        own = {name: made.mm_per_unit * delta for name, delta in found.deltas.items()}
        means = {name: _off(own[name], truth[name]).mean() for name in truth}
        labels, nearest = self._labels[made.kept], self._nearest(fit)
        bare = identity_shapes(made.identity, _BLINKS, sockets=False)
        turned = {name: own[name] @ fit.place.rotation.T for name in _BLINKS}
        lids = {number: np.abs(labels) == number for number in (2, 3)}
        result = {
            "shapes": np.mean(list(means.values())),
            "jaw": means["jawOpen"],
            "jaw p99": np.percentile(_off(own["jawOpen"], truth["jawOpen"]), 99),
            "blink": 100.0 * np.mean([_share(own[name], truth[name]) for name in _BLINKS]),
            "blink bare": 100.0 * np.mean([_share(turned[name], bare[name][made.kept]) for name in _BLINKS]),
            "fit": middle - start,
            "carry": end - middle,
        }
        for column, shapes in (("", own), (" nearest", {n: nearest(n) for n in ("jawOpen", *_BLINKS)})):
            lips = _off(shapes["jawOpen"], truth["jawOpen"], np.abs(labels) == 1)
            of_lids = [
                _off(shapes[name], truth[name], lids[number]) for name, number in zip(_BLINKS, (3, 2), strict=True)
            ]
            result[f"lips{column}"] = np.percentile(lips, 99)
            result[f"lids{column}"] = np.percentile(np.concatenate(of_lids), 99)
        return {name: float(result[name]) for name in _COLUMNS}

    def _nearest(self, fit: Any) -> Any:
        """What copies the motion of the template's nearest point, in millimetres along the head's own axes."""
        from scipy.spatial import cKDTree

        rows = self._template.rows
        _, near = cKDTree(fit.points[rows]).query(fit.head.points)
        taken = rows[near[fit.head.group]]
        return lambda name: self._shapes[name][taken] @ fit.place.rotation


def _off(found: FloatArray, truth: FloatArray, of: Any = True) -> FloatArray:
    """Errors at the points that move."""
    from transfer_heads import MOVED_MM

    moved = (np.linalg.norm(truth, axis=1) > MOVED_MM) & of
    return np.asarray(np.linalg.norm(found - truth, axis=1)[moved])


def _share(found: FloatArray, truth: FloatArray) -> float:
    """Mean error over mean motion of the points that move."""
    return float(_off(found, truth).sum() / _off(np.zeros_like(truth), truth).sum())


def main() -> int:
    """Print the table and the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=positive, default=10, help="heads a row (default 10)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    bench = Bench()
    table, lines = [("", "seed", *_COLUMNS.values())], []
    figures: dict[str, dict[str, dict[str, float]]] = {row: {} for row in _ROWS}
    for seed in range(arguments.seeds):
        for row, kind in _ROWS.items():
            one = figures[row][str(seed)] = bench.figures(seed, **kind)
            print(f"{seed} {row}: " + ", ".join(f"{key} {one[key]:.3f}" for key in _COLUMNS), file=sys.stderr)
    for (row, found), aims in zip(figures.items(), _AIMS, strict=True):
        for name, of in (("mean", np.mean), ("worst", np.max)):
            found[name] = {key: float(of([one[key] for one in found.values()])) for key in _COLUMNS}
        table += [(row, seed, *(f"{one[key]:.3f}" for key in _COLUMNS)) for seed, one in found.items()]
        mean = found["mean"]
        lines += [verdict(f"{row}: {_COLUMNS[key]}", mean[key], aim) for key, aim in aims.items()]
        for part in ("lips", "lids"):
            share = mean[part] / mean[f"{part} nearest"]
            lines.append(verdict(f"{row}: {part} p99 over nearest", share, round(_SHARE_OF_NEAREST, 3)))
    print("\n".join([*aligned(table), "", *lines]))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, sort_keys=True, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
