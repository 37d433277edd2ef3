"""How much of a person its sliders are: `facepipe sliders HEAD --person` on people that modes reach, and on others.

Skin of the head in the box (without the mouth's inside), millimetres from the person, mean / 95 % / largest over all
people of a kind, as `person_bytes.py` makes them: the average head with all sliders at the person's own values; with
the section beside them, and its bytes. Then what sliders of measures leave alone, in percent of the person's shape: at
the person's own values, and at those that come nearest within their ranges. Last the values at a limit.

example: python benchmarks/person_sliders.py --people 10 --kinds drawn 'of a photo' scan
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from arguments import positive
from person_bytes import KINDS
from scipy.optimize import lsq_linear
from tables import aligned

from facepipe.core.arrays import FloatArray
from facepipe.heads import make
from facepipe.heads.assembly import MODE
from facepipe.heads.asset import arrays
from facepipe.parts import FaceParts
from facepipe.rig import set_face
from facepipe.verbs.person_basis import head_basis
from facepipe.verbs.person_sliders import person_sliders
from facepipe.verbs.whole_faces import in_order, whole_points

WITHIN = 0.3  # mm, as of the command


def main() -> None:
    """Set, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=positive, default=10, help="of each kind (default 10)")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), help="default: all")
    given = parser.parse_args()
    rows = [("person", "sliders alone", "with section", "bytes", "measures, own", "nearest", "at a limit")]
    with tempfile.TemporaryDirectory() as folder:
        for kind in given.kinds:
            people = list(KINDS[kind](given.people, Path(folder)))
            if people:
                rows.append((kind, *measured(people)))
            print("\n".join(aligned(rows)), flush=True)


def measured(people: list[FloatArray]) -> tuple[str, ...]:
    """The cells of a kind."""
    head, rows = make(0), head_basis().fitted
    ranges = {slider.name: slider for slider in head.sliders}
    still = whole(head)
    names = arrays("measures")["names"].tolist()
    moves = np.stack([(whole(with_values(head, {name: 1.0})) - still)[rows] for name in names])
    alone, section, sizes, own, nearest, limits = [], [], [], [], [], []
    for points in people:
        found = person_sliders(head.sliders, points, within=WITHIN)
        size = np.linalg.norm((points - still)[rows], axis=1).mean()
        alone.append(np.linalg.norm((whole(with_values(head, found.values)) - points)[rows], axis=1))
        section.append(np.linalg.norm(found.left[rows], axis=1))
        sizes.append(len(found.basis.section))
        measures = {name: value for name, value in found.values.items() if not name.startswith(MODE)}
        own.append(np.linalg.norm((whole(with_values(head, measures)) - points)[rows], axis=1).mean() / size)
        flat, reach = moves.reshape(len(moves), -1), ranges[names[0]].maximum
        best = lsq_linear(flat @ flat.T, flat @ (points - still)[rows].ravel(), (-reach, reach)).x
        left = (points - still)[rows] - np.tensordot(best, moves, axes=1)
        nearest.append(np.linalg.norm(left, axis=1).mean() / size)
        limits.append(np.mean([abs(value) >= ranges[name].maximum for name, value in found.values.items()]))
    return (
        cell(alone),
        cell(section),
        f"{np.mean(sizes):,.0f}",
        *(f"{100 * np.mean(one):.0f} %" for one in (own, nearest)),
        f"{100 * np.mean(limits):.1f} %",
    )


def cell(off: list[FloatArray]) -> str:
    """Mean, 95 %, largest."""
    every = np.concatenate(off)
    return f"{every.mean():.3f} / {np.percentile(every, 95):.2f} / {every.max():.2f}"


def with_values(head: FaceParts, values: dict[str, float]) -> FaceParts:
    """The head with sliders set."""
    return replace(head, sliders=tuple(replace(one, value=values.get(one.name)) for one in head.sliders))


def whole(parts: FaceParts) -> FloatArray:
    """(n, 3) millimetres of the head as it is set."""
    basis = head_basis()
    return whole_points(in_order(basis.topology.parts(basis.mean), basis.name, set_face(parts).parts, parts.name))


if __name__ == "__main__":
    main()
