"""How near people of a studio's database come in how many bytes: MakeHuman's head, by its sliders and by others.

A database of people whom random values of half of the sliders draw; others, of another seed, are sent relative to it:
by the same sliders, and by the other half alone, which no mode of the database has. All points, millimetres from the
person, mean / largest over all of a kind, with so many bytes altogether.

example: python benchmarks/person_database.py --people 30 --json out.json
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import positive
from tables import aligned

import facepipe
from facepipe.core.arrays import FloatArray
from facepipe.importers.makehuman import Options, read
from facepipe.parts import FaceParts
from facepipe.stage import save_parts
from facepipe.verbs.person_basis import database_basis
from facepipe.verbs.person_layers import encode_points
from facepipe.verbs.whole_faces import whole_points

_FILE = Path(__file__).resolve().parents[2] / "shared" / "data" / "makehuman" / "makehuman_head.npz"
_BYTES = (600, 1306, 2000, 4000, 8000)
_REACH = 0.5  # standard deviation of a slider's value, of 1 at its end
_SHARE = 0.1  # of the sliders that a person has off 0
_GROUPS = ("nose", "mouth", "eyes", "chin", "cheek", "forehead", "ears", "eyebrows")


def main() -> None:
    """Draw, make the database, encode, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=positive, default=30, help="of each kind (default 30)")
    parser.add_argument("--database", type=positive, default=100, help="people in it (default 100)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    given = parser.parse_args()
    rows = [("people", "modes alone", *(f"{most:,} bytes" for most in _BYTES))]
    found: dict[str, dict[str, dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        face, sliders = head()
        halves = sliders[0::2], sliders[1::2]
        drawn = people(face, halves[0], given.database, seed=0)
        paths = []
        for number, points in enumerate(drawn):
            paths.append(Path(folder) / f"p{number}.usdc")
            save_parts(moved(face, points), paths[-1])
        facepipe.database_create(paths, out=Path(folder) / "people.fpdb")
        basis = database_basis(Path(folder) / "people.fpdb", face, "face")
        for kind, half in zip(("its sliders", "other sliders"), halves, strict=True):
            found[kind] = {}
            for most in (None, *_BYTES):
                off, sizes = [], []
                for points in people(face, half, given.people, seed=1):
                    data, layers = encode_points(basis, points, most=most)
                    off.append(np.linalg.norm(layers[-1].points - points, axis=1))
                    sizes.append(len(data))
                one = {"bytes": np.mean(sizes), "mean": np.mean(off), "max": np.max(off)}
                found[kind][str(most)] = {name: float(value) for name, value in one.items()}
            cells = [f"{one['mean']:.3f} / {one['max']:.2f}" for one in found[kind].values()]
            rows.append((kind, f"{found[kind]['None']['bytes']:.0f}: {cells[0]}", *cells[1:]))
            print("\n".join(aligned(rows)), flush=True)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1), encoding="utf-8")


def head() -> tuple[FaceParts, list[FloatArray]]:
    """MakeHuman's head in millimetres, without shapes, and (n, 3) offsets of sliders at their upper ends."""
    shapes = ",".join(f"{group}/*" for group in _GROUPS)
    parts = read(_FILE, Options(shapes=shapes)).parts
    cuts = np.cumsum([0, *(len(mesh.points) for mesh in parts.meshes)])
    scale = 1000 * parts.meters_per_unit
    whole: dict[str, FloatArray] = {}
    for mesh, start in zip(parts.meshes, cuts, strict=False):
        for shape in mesh.blendshapes:
            offsets = whole.setdefault(shape.name, np.zeros((cuts[-1], 3)))
            offsets[start + np.asarray(shape.point_indices)] = scale * np.asarray(shape.offsets)
    bare = replace(parts, meshes=tuple(replace(mesh, blendshapes=()) for mesh in parts.meshes), sliders=())
    return bare, [whole[name] for name in sorted(whole)]


def people(face: FaceParts, sliders: list[FloatArray], count: int, seed: int) -> list[FloatArray]:
    """(n, 3) whole points of each."""
    rng, base, moves = np.random.default_rng(seed), whole_points(face), np.array(sliders)
    return [
        base
        + np.tensordot(np.abs(rng.normal(0, _REACH, len(moves))) * (rng.random(len(moves)) < _SHARE), moves, axes=1)
        for _ in range(count)
    ]


def moved(face: FaceParts, points: FloatArray) -> FaceParts:
    """The face with whole points (n, 3) in millimetres."""
    cuts = np.cumsum([len(mesh.points) for mesh in face.meshes])[:-1]
    scale = 1000 * face.meters_per_unit
    pieces = np.split(points / scale, cuts)
    return replace(face, meshes=tuple(replace(one, points=own) for one, own in zip(face.meshes, pieces, strict=True)))


if __name__ == "__main__":
    main()
