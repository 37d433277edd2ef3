"""What a neural rig costs an engine: bytes and milliseconds of its graphs and GLB, beside dense blendshapes.

The teacher is that of neural_rig.py, and errors are those of frames drawn by another seed than those that are learned.
The peer is one dense blendshape a control, of least squared error on the same frames. To compare bytes at equal error,
small neural rigs come down to what it errs, and correctives of pairs of controls bring it nearer. Graphs run in
onnxruntime on one thread; the teacher runs in numpy.

    python benchmarks/neural_rig_engine.py
    python benchmarks/neural_rig_engine.py --rig head.fpnr --json engine.json
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import support_modules  # noqa: F401  (finds the modules of tests/support)
from arguments import add_common
from neural_rig_teacher import HEAD, Teacher, teacher
from onnx_timing import median, start
from tables import aligned

if TYPE_CHECKING:
    from facepipe.neural import Motion
    from facepipe.rig.neural_rig import NeuralRig

FloatArray = npt.NDArray[np.floating]
WEIGHTS = ("float32", "float16", "int8")
SMALL = {"small, with bones": (8, 32), "small, without bones": (36, 128)}  # shapes and units of about the peer's error
SMALL_STEPS = 3000
CORRECTIVES = 128
FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]
_ROUNDS = 4  # pairs are chosen a part at a time, each by what the ones before it leave
_KEPT = 128  # principal components of what is left, to choose by
_FIRM = 1e-6  # of the products' squares; those of controls that seldom move together say nothing


@dataclass(frozen=True)
class Row:
    """One file, or way to make points."""

    of: str
    way: str
    kilobytes: float | None = None
    ms: float | None = None
    mean_mm: float | None = None
    max_mm: float | None = None


class Held:
    """What exporters need of a face."""

    def __init__(self, parts: Any) -> None:
        self._parts = parts

    def parts(self) -> Any:
        """Its arrays."""
        return self._parts


@dataclass(frozen=True)
class Correctives:
    """Dense blendshapes with correctives, the peer that goes on where blendshapes, one a control, end.

    ``rest + [x, 1, products of pairs] shapes`` of x, the controls from 0 to 1.
    """

    rest: FloatArray  # (n, 3) millimetres
    pairs: IntArray  # (p, 2)
    shapes: FloatArray  # (c + 1 + p, n, 3)

    def points(self, values: FloatArray) -> FloatArray:
        """(n, 3) of (c,) values."""
        row = np.concatenate([values, [1.0], values[self.pairs[:, 0]] * values[self.pairs[:, 1]]])
        return np.asarray(self.rest + np.tensordot(row, self.shapes, axes=1))


def main() -> int:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_common(parser, 500, "the median")
    parser.add_argument("--rig", type=Path, action="append", default=[], help="learned on the teacher; else one is")
    parser.add_argument("--spread", type=int, default=3000, help="frames to learn that move many controls")
    parser.add_argument("--steps", type=int, default=0, help="of training; 0: as many as by default")
    arguments = parser.parse_args()
    if not (arguments.data / HEAD).exists():
        print(f"{arguments.data / HEAD}: not there, nothing to measure", file=sys.stderr)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        rows = list(_rows(teacher(arguments.data), arguments, Path(folder)))
    head = ("of", "", "KB", "ms", "mean mm", "max mm")
    print("\n".join(aligned([head, *((row.of, row.way, *map(_cell, list(asdict(row).values())[2:])) for row in rows)])))
    for line in _shares(rows):
        print(line)
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": [asdict(row) for row in rows]}, indent=2))
    return 0


def _shares(rows: list[Row]) -> Iterator[str]:
    """Each rig's shapes and graph of matrices together, and its error, beside those of the dense blendshapes."""
    sizes: dict[str, float] = {}
    off: dict[str, float] = {}
    for row in rows:
        if row.way.startswith(("shapes", "matrices, float32")):
            sizes[row.of] = sizes.get(row.of, 0.0) + (row.kilobytes or 0.0)
        if row.mean_mm is not None:
            off[row.of] = row.mean_mm
    peer = sizes.pop("blendshapes")
    for name in dict.fromkeys(row.of for row in rows if row.way == "points" and row.of in sizes):
        size = sizes[name]
        line = f"{name}: shapes and matrices {size:,.0f} KB, {size / peer:.2f} of those of the blendshapes"
        yield f"{line}; {off[name]:.3f} mm, {off[name] / off['blendshapes']:.2f} of theirs"


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:,.3f}" if value < 100 else f"{value:,.0f}"


def _rows(first: Teacher, arguments: argparse.Namespace, folder: Path) -> Iterator[Row]:
    from facepipe.neural import (
        SampleMotionOptions,
        TrainNeuralRig,
        TrainNeuralRigOptions,
        load_neural_rig,
    )
    from facepipe.neural.train_neural_rig import best_blendshapes
    from facepipe.rig import build

    learned = first.motion(SampleMotionOptions(spread=arguments.spread, sweep=6, together=2000))
    unseen = first.motion(SampleMotionOptions(spread=150, sweep=0, together=150, seed=99))
    rig, values = build(first.parts), unseen.values[0]

    def evaluate() -> None:
        coefficients, weights = first(values)
        rig.evaluate(weights, coefficients=coefficients)

    yield Row("teacher", "numpy", ms=median(evaluate, 50))
    rigs = {path.stem: load_neural_rig(path) for path in arguments.rig}
    if not rigs:
        options = TrainNeuralRigOptions(influences=0)
        options = replace(options, steps=arguments.steps) if arguments.steps else options
        rigs["neural rig"] = TrainNeuralRig(options=options)(learned).rig
    peer = best_blendshapes(learned).shapes.reshape(-1, *learned.rest.shape)
    for name, one in {"blendshapes": _of_shapes(learned, peer), **rigs, **_small(learned, arguments.steps)}.items():
        yield from _measured(name, one, first, unseen, folder, arguments.runs)
    yield _corrected(first, learned, unseen, folder)


def _of_shapes(learned: Motion, shapes: FloatArray) -> NeuralRig:
    """Shapes of the controls, an offset, and shapes of pairs, as a rig that moves the first."""
    from facepipe.rig.neural_rig import NeuralRig

    count = len(learned.controls)
    used = np.delete(shapes, count, axis=0)
    return NeuralRig(
        controls=learned.controls,
        rest=learned.rest + shapes[count],
        shapes=used,
        linear=np.eye(count, len(used)),
        hidden=np.zeros((1, count)),
        hidden_bias=np.zeros(1),
        last=np.zeros((len(used), 1)),
        last_bias=np.zeros(len(used)),
        topology=learned.topology.digest,
    )


def _small(learned: Motion, steps: int) -> dict[str, NeuralRig]:
    """Neural rigs of few shapes and units."""
    from facepipe.neural import TrainNeuralRig, TrainNeuralRigOptions

    found = {}
    for name, (shapes, width) in SMALL.items():
        options = TrainNeuralRigOptions(
            shapes=shapes, width=width, steps=min(steps or SMALL_STEPS, SMALL_STEPS), influences=0
        )
        frames = replace(learned, bones=None, coefficients=None) if "without" in name else learned
        found[name] = TrainNeuralRig(options=options)(frames).rig
    return found


def _corrected(first: Teacher, learned: Motion, unseen: Motion, folder: Path) -> Row:
    """The blendshapes with shapes of the pairs of controls that explain most."""
    found = pair_correctives(learned, CORRECTIVES)
    off = np.stack([found.points(values) for values in unseen.values]) - unseen.points
    off = np.linalg.norm(off, axis=2)
    size = _shape_bytes(_of_shapes(learned, found.shapes), first, folder) / 1000.0
    name = f"blendshapes and {CORRECTIVES} correctives"
    return Row(name, "shapes of the GLB", size, mean_mm=float(off.mean()), max_mm=float(off.max()))


def _shape_bytes(rig: NeuralRig, first: Teacher, folder: Path) -> int:
    """What shapes add to a GLB."""
    import facepipe_gltf

    parts = _attached(first, rig)
    bare = replace(parts, meshes=tuple(replace(mesh, blendshapes=()) for mesh in parts.meshes))
    sizes = [int(facepipe_gltf.export(Held(one), folder / "face.glb").bytes) for one in (parts, bare)]
    return sizes[0] - sizes[1]


def _attached(first: Teacher, rig: NeuralRig) -> Any:
    """The face with the shapes of the neural rig alone."""
    from facepipe.neural import AttachNeuralRig, AttachOptions

    return AttachNeuralRig(options=AttachOptions(keep_shapes=False))(first.parts, rig, "teacher").parts


def _measured(name: str, rig: NeuralRig, first: Teacher, unseen: Motion, folder: Path, runs: int) -> Iterator[Row]:
    from facepipe_onnx import Options, export_parts

    parts = _attached(first, rig)
    dense = 12 * len(rig.shapes) * len(rig.rest)
    yield Row(
        name, f"shapes of the GLB ({dense / 1000.0:,.0f} KB of points)", _shape_bytes(rig, first, folder) / 1000.0
    )
    for weights in WEIGHTS[:1] if name in ("blendshapes", *SMALL) else WEIGHTS:
        path = folder / f"{weights}.onnx"
        report = export_parts(parts, path, Options(sliders=True, weights=weights))  # type: ignore[arg-type]
        way = f"matrices, {weights}" + (" (mm from float32)" if report.error_mm is not None else "")
        yield Row(name, way, report.bytes / 1000.0, _ms(path, unseen.values[0], runs), max_mm=report.error_mm)
    path = folder / "points.onnx"
    size = export_parts(parts, path, Options(sliders=True, points=True)).bytes / 1000.0
    off = _off(path, unseen, 1000.0 * parts.meters_per_unit)
    yield Row(name, "points", size, _ms(path, unseen.values[0], runs), float(off.mean()), float(off.max()))


def _feeds(session: Any, values: Any) -> dict[str, Any]:
    feeds = {one.name: np.zeros(one.shape, np.float32) for one in session.get_inputs()}
    feeds["sliders"][:] = values
    return feeds


def _ms(path: Path, values: Any, runs: int) -> float:
    session = start(path)
    feeds = _feeds(session, values)
    return median(lambda: session.run(None, feeds), runs)


def _off(path: Path, unseen: Motion, mm_per_unit: float) -> Any:
    """(f, n) millimetres that the points of a graph are from those of the teacher, Y up both."""
    session = start(path)
    found = [session.run(["points"], _feeds(session, values))[0][0] for values in unseen.values]
    return np.linalg.norm(np.stack(found) * mm_per_unit - unseen.points, axis=2)


def pair_correctives(motion: Motion, count: int) -> Correctives:
    """The `count` pairs that explain most of what the others leave, and shapes of least squared error on all frames."""
    from facepipe.geometry.shape_basis import motion_basis

    x = motion.values
    deltas = (motion.points - motion.rest).reshape(len(x), -1)
    every = np.array(np.triu_indices(x.shape[1], 1)).T
    products = x[:, every[:, 0]] * x[:, every[:, 1]]
    rows = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    left = deltas - rows @ np.linalg.lstsq(rows, deltas, rcond=None)[0]
    target = motion_basis(left.reshape(motion.points.shape), 0.0, _KEPT)[1]
    chosen: list[int] = []
    for part in np.array_split(np.arange(count), _ROUNDS):
        own = np.linalg.qr(np.concatenate([rows, products[:, chosen]], axis=1))[0]
        fresh, rest = (one - own @ (own.T @ one) for one in (products, target))
        sizes = np.square(fresh).sum(axis=0)
        explained = np.square(fresh.T @ rest).sum(axis=1) / (sizes + _FIRM * sizes.max())
        explained[chosen] = -1.0
        chosen += np.argsort(-explained)[: len(part)].tolist()
    rows = np.concatenate([rows, products[:, chosen]], axis=1)
    shapes = np.linalg.lstsq(rows, deltas, rcond=None)[0]
    return Correctives(motion.rest, every[chosen], shapes.reshape(-1, *motion.rest.shape))


if __name__ == "__main__":
    raise SystemExit(main())
