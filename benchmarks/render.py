"""Pictures of faces: seconds and memory at 800 pixels, and their rasteriser against Intel Embree on the same work.

Prints one table; --json writes every sample. Standard library only, so that this process stays small: the sides are
measured in children. Embree comes with `pip install embreex`; without it its columns stay empty.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from arguments import add_common
from children import ChildError, Json, run_side
from tables import aligned, mib, ms, times

_SIDES = Path(__file__).resolve().with_name("render_sides.py")
_ICT = "ict_facekit/ict_facekit.npz"
_SEEDS = {"head in the box": "0", "long hair": "4", "bald": "12"}
_COMPARED = ("command", "picture", "facepipe", "embreex")
_WORK = {"seen": "5.8 million samples seen", "sky": "24 directions of the sky, each point"}


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_common(parser, 3, "medians")
    arguments = parser.parse_args(words)
    result = measure(arguments.data, arguments.runs)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    print(table(result))
    return 0


def measure(data: Path, runs: int) -> Json:
    """Samples of every side on people of the head in the box and on ICT-FaceKit; what is missing has a reason."""
    faces: Json = {}
    reasons: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, stage in _stages(data, Path(folder), reasons).items():
            faces[name] = {}
            for side in _COMPARED:
                try:
                    report = Path(folder) / "report.json"
                    found = [run_side(_SIDES, side, stage, report) for _ in range(runs)]
                except ChildError as error:
                    reasons.append(f"{name}, {side}: {error}")
                    continue
                faces[name][side] = {key: _median([one[key] for one in found]) for key in found[0]}
    return {"faces": faces, "left_out": reasons}


def _stages(data: Path, folder: Path, reasons: list[str]) -> dict[str, Path]:
    stages = {name: folder / f"head{seed}.usdc" for name, seed in _SEEDS.items()}
    for name, seed in _SEEDS.items():
        run_side(_SIDES, "sample", seed, stages[name], folder / "report.json")
    if (data / _ICT).is_file():
        stages["ICT-FaceKit"] = folder / "ict.usdc"
        run_side(_SIDES, "ict", data / _ICT, stages["ICT-FaceKit"], folder / "report.json")
    else:
        reasons.append(f"ICT-FaceKit: {data / _ICT} is not there")
    return stages


def table(result: Json) -> str:
    """The figures of all faces."""
    rows = [("face", "what", "wall", "processor", "peak memory", "Embree, wall", "processor", "ratio")]
    for name, sides in result["faces"].items():
        if "command" in sides:
            one = sides["command"]
            rows.append((name, "facepipe render", ms(one["command_s"]), ms(one["command_cpu_s"]), "", "", "", ""))
        if "picture" in sides:
            one = sides["picture"]
            cells = (ms(one["picture_s"]), ms(one["picture_cpu_s"]), mib(one["peak_bytes"]))
            rows.append((name, "picture of 800 px", *cells, "", "", ""))
        if "facepipe" in sides:
            rows += [_row(name, work, sides["facepipe"], sides.get("embreex")) for work in _WORK]
    return "\n".join([*aligned(rows), *(f"left out: {reason}" for reason in result["left_out"])])


def _row(name: str, work: str, ours: Json, peer: Json | None) -> tuple[str, ...]:
    wall, processor = (f"{work}_s", f"{work}_cpu_s")
    cells = (name, _WORK[work], ms(ours[wall]), ms(ours[processor]), "")
    if peer is None:
        return (*cells, "", "", "")
    return (*cells, ms(peer[wall]), ms(peer[processor]), times(peer[processor] / ours[processor]))


def _median(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


if __name__ == "__main__":
    sys.exit(main())
