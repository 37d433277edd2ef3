"""How shapes come out on heads of others: MakeHuman's, drawn people remeshed, and what lies in ../shared/data.

MakeHuman's heads are made by its own targets (seeded), and its pose units are an independent truth: what its authors
mean by a jaw that drops, a blink, a smile, brows. For each shape that one stands for, the cosine between the motion
that was transferred and that of the pose unit, over all points of the skin that the unit moves by more than 0.3 mm, 0
where none was made; pose units are evaluated here, not by facepipe. People are drawn by seed and remeshed by
fast-simplification.

In the table: the share of the head's points on the face within 1 mm of the fitted template, and what 95 % are within;
of jawOpen with mouthClose the widest gap between the lips, the widest with both at 0.5, how far lips cross beyond what
they do at rest, and triangles of lips that turn over; of blinks the gap's mean and largest, the depth in the eyeball
beyond that at rest and triangles that turn over; processor seconds of finding the landmarks where none are given, of
the fit, and of 52 shapes. Landmarks are given but for files without any: these need `pip install 'facepipe[train]'`.

usage: python benchmarks/heads_of_others.py [--heads 10] [--json OUT] [--data DIR]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from arguments import positive
from tables import aligned, verdict

FloatArray = npt.NDArray[np.floating]

_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
_MOVED_MM = 0.3
_PARTS = {
    "jaw": ("jawOpen",),
    "smile": ("mouthSmileLeft", "mouthSmileRight"),
    "blink": ("eyeBlinkLeft", "eyeBlinkRight"),
    "brows": ("browInnerUp", "browDownLeft", "browDownRight", "browOuterUpLeft", "browOuterUpRight"),
}
_COSINES = {"jaw": 0.93, "smile": 0.90, "blink": 0.84, "all": 0.85}
_FAR_MM = 15.0  # from the template's face: what is farther is no face
_CATEGORIES = ("head", "forehead", "eyes", "nose", "mouth", "cheek", "chin")
_TARGETS, _MACRO = 14, 0.8  # of a head: how many of those, and how much of a people, a sex and an age
_TRIANGLES = {"Head": 14000}
_SHARE_OF_MESH = 0.3  # of other meshes' triangles
_LIPS = {"gap": 0.2, "half": 0.2, "over": 0.5, "lip flips": 0.0}
_LIDS = {"lids": 0.1, "lids most": 0.4, "in ball": 0.1, "lid flips": 0.0}
_COLUMNS = ("points", "within", "p95", *_LIPS, *_LIDS, "shapes", "find s", "fit s", "carry s")


class Bench:
    """The head in the box, and who people may be."""

    def __init__(self) -> None:
        from facepipe.scanning.transfer.transfer import template_in

        self._body, self._people, _ = template_in(None)

    def run(self, parts: Any, where: str, landmarks: FloatArray | None = None) -> tuple[dict[str, float], Any]:
        """Figures of one head, and (n, 3) whole deltas in millimetres by name.

        :param landmarks: (68, 3) in the coordinates of the file; None: its own, or they are found
        """
        from facepipe.scanning.transfer.fit import fit_head
        from facepipe.scanning.transfer.head import Head
        from facepipe.scanning.transfer.transfer import _shapes_of, wanted_shapes

        times = [time.process_time()]
        with tempfile.TemporaryDirectory() as folder:
            given = None
            if landmarks is not None:
                given = Path(folder) / "landmarks.json"
                given.write_text(json.dumps({"points": landmarks.tolist()}))
            head = Head.of(parts, where, given)
        times.append(time.process_time())
        skin = head.skin()
        triangles = head.surface.part_triangles(skin)
        fit = fit_head(self._body, self._people, head.sewn[skin], triangles, head.landmarks, name=where)
        times.append(time.process_time())
        names = wanted_shapes(self._body.parts, parts, (), anew=True)[0]
        made, _ = _shapes_of(head, skin, self._body, fit, names, {}, lambda: None)
        times.append(time.process_time())
        found = np.diff(times)
        figures = {
            "points": float(len(head.points)),
            **self._on_face(fit),
            **_met(made.verdicts),
            "shapes": float(len(made.deltas)),
            "find s": float(found[0]) if "found" in head.source else np.nan,
            "fit s": float(found[1]),
            "carry s": float(found[2]),
        }
        return figures, {name: head.whole(delta) for name, delta in made.deltas.items()}

    def _on_face(self, fit: Any) -> dict[str, float]:
        from facepipe.scanning.transfer.places import nearest_places

        places = nearest_places(fit.points[self._body.rows], self._body.triangles, fit.head)
        away = places.distances[self._body.face[places.corners].all(axis=1)]
        away = away[away < _FAR_MM]
        return {"within": 100.0 * float((away <= 1.0).mean()), "p95": float(np.percentile(away, 95))}


def _met(verdicts: Any) -> dict[str, float]:
    """Of lips and lids; what a head has none of is left out."""
    lips = [one.lips for one in verdicts if one.lips is not None]
    lids = [one.lids for one in verdicts if one.lids is not None]
    found: dict[str, float] = {}
    if lips:
        found = {name: float(getattr(lips[0], field)) for name, field in zip(
            _LIPS, ("gap_most", "half_most", "over_most", "lip_flips"), strict=True)}  # fmt: skip
    if lids:
        found["lids"] = float(np.mean([one.gap_mean for one in lids]))
        found["lids most"] = max(one.gap_most for one in lids)
        found["in ball"] = max(one.in_ball - one.in_ball_neutral for one in lids)
        found["lid flips"] = float(sum(one.lid_flips for one in lids))
    return found


class MakeHuman:
    """The packed head: people by targets, and what its pose units move."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as file:
            self._arrays = {name: file[name] for name in file.files}
        self._path = path

    def targets(self, seed: int) -> dict[str, float]:
        """Target -> weight of a seed's person; none of seed 0."""
        if not seed:
            return {}
        rng = np.random.default_rng([seed, 45])
        of = self._arrays["target_category_names"][self._arrays["target_category"]]
        names = self._arrays["target_names"]
        chosen = rng.choice(names[np.isin(of, _CATEGORIES)], _TARGETS, replace=False)
        weights = {str(name): float(rng.uniform(0.2, 0.7)) for name in chosen}
        return {**weights, str(rng.choice(names[of == "macro_ethnic"])): _MACRO}

    def parts(self, targets: Mapping[str, float]) -> Any:
        """The person's face, with landmarks."""
        from facepipe.importers.makehuman import read
        from facepipe.importers.options import MakeHumanOptions

        return read(self._path, MakeHumanOptions(targets=targets)).parts

    def truth(self, targets: Mapping[str, float], units: tuple[str, ...]) -> FloatArray:
        """(k, 3) mm that pose units move the skin of the person."""
        from scipy.spatial.transform import Rotation

        data, points = self._arrays, self._arrays["vertices"].astype(np.float64)
        for name, weight in targets.items():
            number = int(np.flatnonzero(data["target_names"] == name)[0])
            of = slice(*data["target_offset"][number : number + 2])
            points[data["target_vertex"][of]] += weight * data["target_delta"][of]
        ends = data["bone_head_vertices_offset"]
        heads = np.array([points[data["bone_head_vertices"][a:b]].mean(axis=0) for a, b in pairwise(ends)])
        turned = np.broadcast_to(np.eye(3), (len(heads), 3, 3))
        for unit in units:
            vectors = data["poseunit_rotvec"][int(np.flatnonzero(data["poseunit_names"] == unit)[0])]
            turned = Rotation.from_rotvec(vectors.astype(np.float64)).as_matrix() @ turned
        turns, places = turned.copy(), heads.copy()
        for bone, parent in enumerate(data["bone_parent"].tolist()):
            if parent >= 0:
                turns[bone] = turns[parent] @ turned[bone]
                places[bone] = places[parent] + turns[parent] @ (heads[bone] - heads[parent])
        skin = data["vertex_kind"] == data["vertex_kind_names"].tolist().index("skin")
        at, weights = points[skin], data["skin_weights"][skin].astype(np.float64)
        posed = np.einsum("vb,bij,vj->vi", weights, turns, at)
        posed += weights @ (places - np.einsum("bij,bj->bi", turns, heads))
        return np.asarray(100.0 * (posed - at))


def cosines(human: MakeHuman, targets: Mapping[str, float], deltas: Mapping[str, FloatArray]) -> dict[str, float]:
    """Shape -> cosine of its motion with that of the pose units which it stands for, 0 of one that was not made."""
    from facepipe.importers.makehuman_rig import ARKIT_UNITS

    found = {}
    for name in (name for names in _PARTS.values() for name in names):
        truth = human.truth(targets, ARKIT_UNITS[name]) if name in ARKIT_UNITS else None
        if truth is None:
            continue
        moved = np.linalg.norm(truth, axis=1) > _MOVED_MM
        own = deltas[name][: len(truth)][moved] if name in deltas else np.zeros_like(truth[moved])
        length = np.linalg.norm(own) * np.linalg.norm(truth[moved])
        found[name] = float((own * truth[moved]).sum() / length) if length else 0.0
    return found


def remeshed(seed: int) -> tuple[Any, FloatArray]:
    """A drawn person of other triangles, in centimetres, and its landmarks."""
    import fast_simplification

    from facepipe.geometry.polygons import point_triangles
    from facepipe.heads.assembly import make_head
    from facepipe.heads.people import draw
    from facepipe.parts import FaceParts, Mesh

    made = make_head(draw(seed).identity)
    meshes = []
    for mesh in made.meshes:
        triangles = point_triangles(mesh.face_vertex_counts, mesh.face_vertex_indices)
        count = _TRIANGLES.get(mesh.name, int(_SHARE_OF_MESH * len(triangles)))
        points, triangles = fast_simplification.simplify(
            np.asarray(mesh.points, np.float32), triangles.astype(np.int32), target_count=count
        )
        meshes.append(
            Mesh(
                name=mesh.name,
                points=points.astype(np.float64),
                face_vertex_counts=np.full(len(triangles), 3, np.int32),
                face_vertex_indices=triangles.ravel().astype(np.int32),
            )
        )
    marked = next(mesh for mesh in made.meshes if "multipie68" in mesh.landmarks)
    landmarks = np.asarray(marked.points, np.float64)[marked.landmarks["multipie68"].indices]
    return FaceParts(meters_per_unit=made.meters_per_unit, up_axis=made.up_axis, meshes=tuple(meshes)), landmarks


def files(data: Path) -> Iterator[tuple[str, Callable[[], tuple[Any, FloatArray | None]]]]:
    """Names of files, and what reads each, with its landmarks where they are known."""
    from facepipe.importers.makehuman import BASE_VERTICES
    from facepipe.importers.wavefront import read_obj
    from facepipe.scanning.transfer.head import read_head

    def known(path: Path) -> FloatArray | None:
        if path.name == "makehuman_base_body.obj":
            return np.asarray(read_obj(path).points)[list(BASE_VERTICES)]
        truth = path.with_suffix(".truth.npz")
        if not truth.is_file():
            return None
        with np.load(truth) as file:
            return np.asarray(file["landmarks"])

    def opened(path: Path) -> tuple[Any, FloatArray | None]:
        return read_head(path)[0], known(path)

    of_heads = (path for path in (data / "heads").glob("*") if path.suffix in (".obj", ".fbx", ".glb"))
    for path in sorted([*of_heads, *(data / "scans").glob("*.glb")]):
        yield path.name, partial(opened, path)


def _rows(
    bench: Bench, arguments: argparse.Namespace
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Head -> figures, and MakeHuman's head -> shape -> cosine; heads that can't be are named on stderr."""
    from facepipe.core.errors import FacepipeError

    figures, alike = {}, {}
    packed = arguments.data / "makehuman" / "makehuman_head.npz"
    if packed.is_file():
        human = MakeHuman(packed)
        for seed in range(arguments.heads):
            targets = human.targets(seed)
            name = f"makehuman {seed}"
            figures[name], deltas = bench.run(human.parts(targets), name)
            alike[name] = cosines(human, targets, deltas)
            _say(name, {**figures[name], **alike[name]})
    else:
        print(f"makehuman: skipped, needs {packed}", file=sys.stderr)
    sources: list[tuple[str, Callable[[], tuple[Any, FloatArray | None]]]] = []
    if importlib.util.find_spec("fast_simplification"):
        sources += [(f"drawn {seed}", partial(remeshed, seed)) for seed in range(1, 1 + (arguments.heads + 2) // 3)]
    else:
        print("drawn people: skipped, need pip install fast-simplification", file=sys.stderr)
    for name, read in [*sources, *files(arguments.data)]:
        try:
            parts, landmarks = read()
            if landmarks is None and not importlib.util.find_spec("torch"):
                print(f"{name}: skipped, its landmarks have to be found, which needs torch", file=sys.stderr)
                continue
            figures[name] = bench.run(parts, name, landmarks)[0]
        except FacepipeError as error:
            print(f"{name}: refused: {error}", file=sys.stderr)
            continue
        _say(name, figures[name])
    return figures, alike


def _say(name: str, found: Mapping[str, float]) -> None:
    print(f"{name}: " + ", ".join(f"{key} {value:.3f}" for key, value in found.items()), file=sys.stderr)


def _verdicts(figures: Mapping[str, Mapping[str, float]], alike: Mapping[str, Mapping[str, float]]) -> list[str]:
    """A line for each aim."""
    lines = []
    if alike:
        of_part = {
            part: [one[n] for one in alike.values() for n in names if n in one] for part, names in _PARTS.items()
        }
        medians = {part: float(np.median(values)) for part, values in of_part.items() if values}
        medians["all"] = float(np.median([value for one in alike.values() for value in one.values()]))
        for part, value in medians.items():
            aim = _COSINES.get(part)
            met = "" if aim is None else f", aim {aim:g}" + ("" if value >= aim else ": missed")
            lines.append(f"cosine with pose units, {part}: {value:.3f}{met}")
        missing = [f"{head} {name}" for head, one in alike.items() for name, value in one.items() if value == 0.0]
        lines.append(f"shapes that were not made, counted as 0: {len(missing)} ({', '.join(missing) or 'none'})")
    short = [name for name, one in figures.items() if one["within"] < 97.0]
    lines.append(f"face within 1 mm below 97 %: {', '.join(short) or 'none'}{': missed' if short else ''}")
    lines.append(verdict("face, largest p95", max(one["p95"] for one in figures.values()), 1.4))
    for what, aims in (("lips", _LIPS), ("lids", _LIDS)):
        known = {name: one for name, one in figures.items() if all(key in one for key in aims)}
        missed = {name: [key for key, aim in aims.items() if one[key] > aim] for name, one in known.items()}
        off = [f"{name} ({', '.join(keys)})" for name, keys in missed.items() if keys]
        lines.append(f"{what}: {len(known) - len(off)} of {len(known)}{': missed by ' + ', '.join(off) if off else ''}")
    lines.append(verdict("processor seconds of 52 shapes, most", max(one["carry s"] for one in figures.values()), 30.0))
    lines.append(verdict("of a fit, most", max(one["fit s"] for one in figures.values()), 60.0))
    return lines


def main() -> int:
    """Print the table and the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--heads", type=positive, default=10, help="heads of MakeHuman, and a third as many drawn ones (default 10)"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    parser.add_argument("--data", type=Path, default=_DATA, help="folder of the source faces (default ../shared/data)")
    arguments = parser.parse_args()
    figures, alike = _rows(Bench(), arguments)
    if not figures:
        print("no head to be measured")
        return 1
    cells = [
        (name, "", *(f"{one[key]:.2f}" if np.isfinite(one.get(key, np.nan)) else "-" for key in _COLUMNS))
        for name, one in figures.items()
    ]
    print("\n".join([*aligned([("head", "", *_COLUMNS), *cells]), "", *_verdicts(figures, alike)]))
    if arguments.json:
        arguments.json.write_text(json.dumps({"heads": figures, "cosines": alike}, sort_keys=True, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
