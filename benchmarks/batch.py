"""`facepipe batch` over many faces with two processes against one: person, blend, bone fit, GLB, ONNX and payload.

Each side is a run of the command in a folder of its own, both with one thread a process; files are warm from a run over
two faces before. Then what is finished is run again, and once more after the limits of one face have changed.

    python benchmarks/batch.py                       500 faces, hours
    python benchmarks/batch.py --faces 4 --json out.json
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from arguments import positive
from tables import aligned

Json = dict[str, Any]
PLAN = """
out = "built"
[faces]
range = { seed = [1, FACES] }
[steps.base]
once = true
run = "sample --seed 0 --textures 0"
out = "base.usdc"
[steps.person]
run = "sample --seed {seed} --textures 0"
out = "people/{name}.usdc"
[steps.child]
run = "blend {person} {base}"
out = "children/{name}.usdc"
[steps.fitted]
run = "fit-bones {child} --target jawOpen --limits limits/{name}.json --coefficients {out}/bones/{name}.fpb"
out = "fitted/{name}.usda"
[steps.game]
run = "export {fitted}"
out = "game/{name}.glb"
[steps.rig]
run = "export {fitted}"
out = "rig/{name}.onnx"
"""
SIDES = (1, 2)  # processes


def main() -> None:
    """Run both sides, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faces", type=positive, default=500, help="(default 500)")
    parser.add_argument("--folder", type=Path, help="where results are left (default: a temporary one)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every figure")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        figures = measure(arguments.folder or Path(temporary), arguments.faces)
    print("\n".join(table(figures)))
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def measure(folder: Path, faces: int) -> Json:
    """Figures of both sides and of what is run again."""
    run(show(folder / "warm", 2), 2)
    shows = {count: show(folder / str(count), faces) for count in SIDES}
    sides = {count: run(shows[count], count) for count in SIDES}
    one, two = (content(shows[count] / "built") for count in SIDES)
    again = run(shows[2], 2)
    write_limits(shows[2], 1, 0.05)
    changed = run(shows[2], 2)
    return {
        "faces": faces,
        "sides": {str(count): side for count, side in sides.items()},
        "same_bytes": one == two,
        "again": again,
        "changed": changed,
    }


def show(folder: Path, faces: int) -> Path:
    """A folder with the plan, and limits for each face."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "limits").mkdir(parents=True)
    (folder / "plan.toml").write_text(PLAN.replace("FACES", str(faces)), encoding="utf-8")
    for face in range(1, faces + 1):
        write_limits(folder, face, 0.1)
    return folder


def write_limits(folder: Path, face: int, most: float) -> None:
    """The limits of a face [m]."""
    limits = {"joints": {"*": {"t": [-most, most]}}, "units": "m"}
    (folder / f"limits/{face}.json").write_text(json.dumps(limits), encoding="utf-8")


def run(folder: Path, processes: int) -> Json:
    """The command over a show: seconds, and what its report says."""
    words = ["batch", "plan.toml", "--processes", str(processes), "--thumbnails", "0", "--json"]
    before, start = used(), time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "facepipe", *words], cwd=folder, capture_output=True, check=False)
    wall, processor = time.perf_counter() - start, used() - before
    if done.returncode == 2 or not done.stdout:
        raise SystemExit(done.stderr.decode())
    report = json.loads(done.stdout)
    records = json.loads((folder / "plan_batch/report.json").read_bytes())["records"]
    made = [record for record in records if record["status"] == "made"]
    return {
        "wall": wall,
        "processor": processor,
        "work": sum(one["seconds"] for one in made),
        "scheduling": report["scheduling_seconds"],
        "counts": report["counts"],
        "peak_mb": max((one["peak_mb"] for one in made), default=0.0),
        "steps": report["steps"],
        "failures": report["failures"],
        "processes": processes,
    }


def used() -> float:
    """Seconds of processor time of all that this process has started, and that have ended."""
    of_children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return of_children.ru_utime + of_children.ru_stime


def content(folder: Path) -> dict[str, str]:
    """Digests of all files below a folder."""
    found = (one for one in sorted(folder.rglob("*")) if one.is_file())
    return {one.relative_to(folder).as_posix(): hashlib.sha256(one.read_bytes()).hexdigest() for one in found}


def table(figures: Json) -> list[str]:
    """Lines of the table."""
    one, two = (figures["sides"][str(count)] for count in SIDES)
    faces, ratio = figures["faces"], one["wall"] / two["wall"]
    rows = [("what", "figure", "1 process", "2 processes", "aim")]
    rows += [
        (f"{faces} faces", "wall", f"{one['wall']:.1f} s", f"{two['wall']:.1f} s", ""),
        ("", "1 process / 2 processes", "", f"{ratio:.2f}x", ">= 1.7x"),
        ("", "processor time", f"{one['processor']:.1f} s", f"{two['processor']:.1f} s", ""),
        ("", "giving tasks out, of the work", *(share(side["scheduling"], side["work"]) for side in (one, two)), "3 %"),
        ("", "processes without a task", *(idle(side) for side in (one, two)), ""),
        ("", "most memory of a process", *(f"{side['peak_mb']:.0f} MB" for side in (one, two)), "600 MB"),
        ("", "same bytes", "", "yes" if figures["same_bytes"] else "NO", "yes"),
    ]
    for name, step in two["steps"].items():
        cells = (f"{side['steps'][name].get('seconds_mean', 0.0):.2f} s" for side in (one, two))
        rows.append(("each", f"{name} ({step.get('peak_mb') or 0:.0f} MB)", *cells, ""))
    for key, what, aim in (("again", "nothing has changed", "2 %"), ("changed", "limits of one face", "")):
        side = figures[key]
        counts = ", ".join(f"{count} {status}" for status, count in sorted(side["counts"].items()))
        rows.append(("run again", what, "", f"{side['wall']:.1f} s, {share(side['wall'], two['wall'])}", aim))
        rows.append(("run again", "", "", counts, ""))
    failures = sorted({line for side in (one, two, figures["again"], figures["changed"]) for line in side["failures"]})
    cores = f"{os.cpu_count()} cores, Python {sys.version.split()[0]}"
    return [*aligned(rows), *(f"failed: {line}" for line in failures), cores]


def share(part: float, whole: float) -> str:
    """In percent."""
    return f"{100 * part / whole:.1f} %"


def idle(side: Json) -> str:
    """Of the time of its processes, how much no task had: they start, wait for one, or the command starts and ends."""
    return share(side["processes"] * side["wall"] - side["work"], side["processes"] * side["wall"])


if __name__ == "__main__":
    main()
