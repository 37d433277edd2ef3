"""Prints the tables of bone fits and payloads in bones.md, skin.md and benchmarks.md: `python docs/bone_tables.py`.

Needs ../shared/data (MakeHuman, CC0; ICT-FaceKit, MIT license) and about five minutes.
Distances are over all points of a face, measured on the saved stages, in millimetres: mean / RMS / p95 / largest.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

import facepipe
from facepipe.importers import ict, load, makehuman
from facepipe.parts import FloatArray
from facepipe.payload import PayloadContent, Precision
from facepipe.stage import Face, save_parts
from facepipe.verbs.bone_payload import PayloadReport, write_payload
from facepipe.verbs.fit_bones import FitBones, FitBonesReport, LimitRules, Target, read_limits, read_targets
from facepipe.verbs.skin import SkinFace, SkinReport

HERE = Path(__file__).resolve().parent
DATA = HERE.parents[1] / "shared" / "data"
LIMITS = HERE / "face_bones.json"  # the face's joints alone, in wide limits
MAKEHUMAN, ICT = "makehuman/makehuman_head.npz", "ict_facekit/ict_facekit.npz"
PARTS = ("nose", "mouth", "chin", "cheek", "forehead", "eyebrows", "eyes")  # three targets of each make a person
PEOPLE = 10
GROUPS = ("nose", "mouth", "chin")  # of MakeHuman's targets
TELLING = (
    *("jawOpen", "mouthSmileLeft", "mouthPucker", "browInnerUpLeft"),
    *("eyeBlinkLeft", "cheekPuffLeft", "noseSneerLeft"),
)
PRECISIONS: tuple[Precision, ...] = ("float32", "float16")
ENTRY = 2 + 12  # bytes of a sparse offset: its point as uint16, its offset as float32
MOVES_MM = 1e-3  # a point that a face moves by more is in its sparse data
WITHIN_MM = (0.1, 0.5, 1.0)  # thresholds of residuals


def makehuman_face(data: Path, out: Path, options: makehuman.Options) -> Face:
    """The MakeHuman head, imported and saved."""
    save_parts(load("makehuman", data / MAKEHUMAN, options).parts, out)
    return facepipe.open(out)


def ict_face(data: Path, out: Path, seed: int | None = None) -> Face:
    """An ICT-FaceKit head, imported and saved."""
    save_parts(load("ict", data / ICT, ict.Options(identity_seed=seed)).parts, out)
    return facepipe.open(out)


def skinned(face: Face, source: Face, out: Path, *, optimise: bool = False) -> tuple[Face, SkinReport]:
    """A face with the bones of another."""
    with face.deriving(out) as result:
        report = SkinFace(source=source, optimise=optimise)(result)
    return facepipe.open(out), report


def people(data: Path, folder: Path) -> Iterator[str]:
    """Files of MakeHuman heads, each with random targets of all parts of the face."""
    with np.load(data / MAKEHUMAN) as arrays:
        names = [str(name) for name in arrays["target_names"]]
    for seed in range(PEOPLE):
        random = np.random.default_rng(seed)
        chosen: dict[str, float] = {}
        for part in PARTS:
            own = [name for name in names if name.startswith(f"{part}/")]
            chosen |= {str(name): float(random.uniform(0.2, 0.8)) for name in random.choice(own, 3, replace=False)}
        file = folder / f"makehuman{seed}.usdc"
        makehuman_face(data, file, makehuman.Options(targets=chosen))
        yield str(file)


@dataclass(frozen=True)
class Reach:
    """How near targets are reached: distances (k, n) of all points from k targets."""

    name: str
    before: FloatArray
    even: FloatArray  # bones, as the command fits them
    bones: FloatArray  # by least squares alone, as residuals are added to them
    whole: FloatArray  # bones and residual
    points: FloatArray  # (k,) that the residuals hold

    def part(self, name: str, rows: Sequence[int]) -> Reach:
        """Some of the targets."""
        arrays = (getattr(self, field.name)[list(rows)] for field in fields(self)[1:])
        return Reach(name, *arrays)


@dataclass(frozen=True)
class Payload:
    """Bytes of faces by bones and by offsets, each a mean over the faces."""

    name: str
    full: float  # bytes, float32
    half: float  # bytes, float16
    half_mm: float  # what its rounding moves a point by, at most
    dense: float
    sparse: float
    residuals: tuple[float, ...]  # bytes of the offsets that bring bones to within thresholds
    rest: str  # rest from the faces, mm
    bones: str  # bones from them


@dataclass(frozen=True)
class Moved:
    """A fit, and what its saved stage is off, (k, n) mm."""

    report: FitBonesReport
    bones: FloatArray
    whole: FloatArray  # with residuals, if any


def moved(face: Face, targets: Sequence[Target], out: Path, fit: FitBones) -> Moved:
    """Fit, save, measure."""
    with face.deriving(out) as result:
        report = fit(result, targets)
    saved, bones, whole = facepipe.open(out), [], []
    for target, name in zip(targets, report.targets, strict=True):
        local, weights = saved.sample(name)
        bones.append(distances(face, saved.evaluate(joint_transforms=local), target))
        whole.append(distances(face, saved.evaluate(weights, joint_transforms=local), target))
    missed = [key for key, one in report.targets.items() if fit.residual and not one.reached]
    if missed or (fit.residual and np.max(whole) > report.threshold_mm):
        raise SystemExit(f"{face.name}: missed with residual: {', '.join(missed)}")
    return Moved(report, np.stack(bones), np.stack(whole))


def distances(face: Face, points: FloatArray, target: Target) -> FloatArray:
    """(n,) mm"""
    return np.asarray(np.linalg.norm(points - target.points[0], axis=1) * face.mm_per_unit)


def reach(name: str, face: Face, targets: Sequence[Target], out: Path, limits: LimitRules) -> Reach:
    """Fit with largest distances evened, and by least squares with residuals."""
    rest = face.evaluate()
    even = moved(face, targets, out, FitBones(limits=limits))
    least = moved(face, targets, out, FitBones(limits=limits, residual=True))
    points = [one.residual.points if one.residual else 0 for one in least.report.targets.values()]
    seconds = even.report.seconds, least.report.seconds
    sys.stderr.write(f"{name}: {len(targets)} targets in {seconds[0]:.0f} and {seconds[1]:.0f} s\n")
    before = np.stack([distances(face, rest, target) for target in targets])
    return Reach(name, before, even.bones, least.bones, least.whole, np.array(points))


def payload(name: str, face: Face, targets: Sequence[Target], out: Path, limits: LimitRules) -> Payload:
    """A payload of each target against its offsets."""
    found = moved(face, targets, out, FitBones(limits=limits, rounds=0))
    poses = {animation.name: animation.coefficients for animation in facepipe.open(out).animations}
    file, rest, written = out.with_suffix(".fpb"), face.evaluate(), []
    for key in found.report.targets:
        values = poses[key]
        assert values is not None
        full, half = (_written(file, face, values[0], precision) for precision in PRECISIONS)
        written.append((full.bytes, half.bytes, half.error_mm))
    before = np.stack([distances(face, rest, target) for target in targets])
    full_bytes, half_bytes, _ = np.mean(written, axis=0)
    return Payload(
        name=name,
        full=full_bytes,
        half=half_bytes,
        half_mm=max(one[2] for one in written),
        dense=12.0 * len(rest),
        sparse=ENTRY * entries(before, MOVES_MM),
        residuals=tuple(ENTRY * entries(found.bones, threshold) for threshold in WITHIN_MM),
        rest=mm(before),
        bones=mm(found.bones),
    )


def entries(off: FloatArray, threshold: float) -> float:
    """How many points are off by more, a mean over the targets."""
    return float((off > threshold).sum(axis=1).mean())


def _written(file: Path, face: Face, values: FloatArray, precision: Precision) -> PayloadReport:
    """A payload of one pose."""
    content = PayloadContent(
        joints=face.skeleton.joints,
        coefficients=values,
        meters_per_unit=face.meters_per_unit,
        precision=precision,
    )
    return write_payload(file, content, face.rig())


def mm(off: FloatArray) -> str:
    """Mean / RMS / p95 / largest of distances."""
    values = off.mean(), np.sqrt((off**2).mean()), np.percentile(off, 95), off.max()
    return " / ".join(f"{value:.2f}" if value < 9.995 else f"{value:.1f}" for value in values)


def reach_table(rows: Sequence[Reach]) -> str:
    """Markdown: a row a set of targets."""
    lines = [
        "| targets | rest | bones | bones, least squares | bones + residual | points in it (that move) |",
        "|---|---|---|---|---|---|",
    ]
    for one in rows:
        cells = (
            mm(one.before),
            mm(one.even),
            mm(one.bones),
            mm(one.whole),
            f"{one.points.mean():,.0f} ({entries(one.before, WITHIN_MM[0]):,.0f})",
        )
        lines.append(f"| {one.name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def shapes_table(plain: Reach, refined: Reach, names: Sequence[str]) -> str:
    """Markdown: a row a shape, RMS / largest."""

    def cell(off: FloatArray) -> str:
        return f"{np.sqrt((off**2).mean()):.2f} / {off.max():.1f}"

    lines = [
        "| shape | rest | bones | bones + residual | bones, `--optimise` | bones + residual | points in both |",
        "|---|---|---|---|---|---|---|",
    ]
    for row, name in enumerate(names):
        if name in TELLING:
            sides = [cell(off) for one in (plain, refined) for off in (one.even[row], one.whole[row])]
            points = f"{plain.points[row]:,.0f}, {refined.points[row]:,.0f}"
            lines.append(f"| {name} | {cell(plain.before[row])} | {' | '.join(sides)} | {points} |")
    return "\n".join(lines)


def payload_table(rows: Sequence[Payload]) -> str:
    """Markdown: a row a kind of face; ratios are of float32 and float16."""
    lines = [
        "| | rest, mm | bones alone, mm | `.fpb` float32, float16 | dense offsets | sparse offsets "
        f"| sparse residual to {', '.join(f'{value:g}' for value in WITHIN_MM)} mm |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in rows:
        dense, sparse = (
            f"{value:,.0f} ({value / one.full:,.0f}x, {value / one.half:,.0f}x)" for value in (one.dense, one.sparse)
        )
        residuals = ", ".join(f"{value:,.0f}" for value in one.residuals)
        sizes = f"{one.full:,.0f}, {one.half:,.0f} (to {one.half_mm:.2f} mm)"
        lines.append(f"| {one.name} | {one.rest} | {one.bones} | {sizes} | {dense} | {sparse} | {residuals} |")
    return "\n".join(lines)


def skin_table(reports: dict[str, SkinReport]) -> str:
    """Markdown: what skinning reports."""
    lines = [
        "| | joints with weight | steepest weight, a mm | 53 shapes by rigid joints, RMS, max |",
        "|---|---|---|---|",
    ]
    for name, one in reports.items():
        fit = one.fit
        text = "" if fit is None else f"{fit.rms_after_mm:.2f}, {fit.max_after_mm:.1f} mm"
        before = "" if fit is None else f" (before {fit.rms_before_mm:.2f}, {fit.max_before_mm:.1f})"
        with_weight = one.joints - len(one.weightless)
        lines.append(f"| {name} | {with_weight} of {one.joints} | {one.largest_step_per_mm:.2f} | {text}{before} |")
    return "\n".join(lines)


def all_reaches(human: Face, sides: Sequence[Face], out: Path, limits: LimitRules) -> list[Reach]:
    """MakeHuman's shapes by groups, then ICT's with both skins."""
    own = reach("MakeHuman", human, read_targets(human, ["shapes"]), out, limits)
    found = []
    for group in GROUPS:
        rows = [row for row, shape in enumerate(human.shapes) if shape.startswith(group)]
        found.append(own.part(f"MakeHuman, {len(rows)} {group} shapes", rows))
    for face, text in zip(sides, ("bones from MakeHuman", "the same, `--optimise`"), strict=True):
        name = f"ICT, {len(face.shapes)} shapes, {text}"
        found.append(reach(name, face, read_targets(face, ["shapes"]), out, limits))
    return found


def all_payloads(human: Face, other: Face, data: Path, folder: Path, limits: LimitRules) -> list[Payload]:
    """People of both kinds, and ICT's shapes."""
    files = [folder / f"ict{seed}.usdc" for seed in range(PEOPLE)]
    for seed, file in enumerate(files):
        ict_face(data, file, seed)
    tasks = (
        ("MakeHuman person", human, list(people(data, folder))),
        ("ICT person", other, [str(file) for file in files]),
        ("ICT shape", other, ["shapes"]),
    )
    out = folder / "poses.usda"
    return [payload(name, face, read_targets(face, words), out, limits) for name, face, words in tasks]


def main() -> None:
    """Import, skin, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the source faces")
    data, limits = parser.parse_args().data, read_limits(LIMITS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shapes = makehuman.Options(shapes=",".join(f"{group}/*" for group in GROUPS))
        human = makehuman_face(data, folder / "makehuman.usdc", shapes)
        bare = ict_face(data, folder / "ict.usdc")
        plain, plain_report = skinned(bare, human, folder / "plain.usda")
        refined, refined_report = skinned(bare, human, folder / "refined.usdc", optimise=True)
        reaches = all_reaches(human, (plain, refined), folder / "fitted.usdc", limits)
        payloads = all_payloads(human, refined, data, folder, limits)
    tables = (
        reach_table(reaches),
        shapes_table(reaches[-2], reaches[-1], plain.shapes),
        skin_table({"`--from`": plain_report, "`--from --optimise`": refined_report}),
        payload_table(payloads),
    )
    sys.stdout.write("\n\n".join(tables) + "\n")


if __name__ == "__main__":
    main()
