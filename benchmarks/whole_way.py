"""README's lines on the head in the box, each a command: processor seconds, peak memory, bytes written.

    python benchmarks/whole_way.py [--against REV] [--runs 3] [--only sample lod] [--json out.json]

With --against another revision of this repository takes turns with this one, run by run, from an environment of its
own (`--environment` keeps it for the next time); a ratio below 1 is less than there. What a command does that it did
not do there is timed apart, where it can be left out. Photos and scans need ../shared/data and the libraries of
[train]; without them their lines are left out, and said to be.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from arguments import add_common
from tables import mib

_ROOT = Path(__file__).resolve().parents[1]
PHOTO, SCAN = "photos/astronaut.png", "scans/LeePerrySmith.glb"


class Line(NamedTuple):
    """A command, and what of the shared data it reads."""

    name: str
    words: str
    reads: str = ""
    beyond: str = ""  # words for what the other revision does not do, which it is not given


LINES = (
    Line("sample", "sample anna.usdc --seed 3"),
    Line("sample, the second", "sample bea.usdc --seed 8"),
    Line("inspect", "inspect anna.usdc"),
    Line("export the head", "export anna.usdc -o anna.glb"),
    Line("sliders", "sliders anna.usdc --set noseWidth=0.8 --set jawWidth=0.5 -o person.usdc"),
    Line("export the person", "export person.usdc -o person.glb"),
    Line("render", "render person.usdc -o person.png --size 800"),
    Line("blend", "blend anna.usdc bea.usdc -o child.usdc --set eyes=0.2,0.8 --set mouth=0,1 --default 0.6,0.4"),
    Line("blend --edit", "blend --edit child.usdc --set nose=1,0"),
    Line(
        "blend, no contacts",
        "blend anna.usdc bea.usdc -o plain.usdc --set eyes=0.2,0.8 --set mouth=0,1 --default 0.6,0.4",
        beyond="--no-contacts",
    ),
    Line("--edit, no contacts", "blend --edit plain.usdc --set nose=1,0", beyond="--no-contacts"),
    Line("fit-bones", "fit-bones anna.usdc --target mouthSmileLeft -o smile.usdc --residual"),
    Line("lod", "lod anna.usdc --triangles 20000,8000,2500 -o levels.usdc"),
    Line("demo", "demo demo"),
    Line("fit-photo", "fit-photo {data} anna.usdc -o fitted.usdc", PHOTO),
    Line("bake-photo", "bake-photo fitted.usdc {data} -o baked.usdc", PHOTO),
    Line("fit-neutral", "fit-neutral {data} -o scanned.usdc", SCAN),
)


class Cost(NamedTuple):
    """What a command took."""

    seconds: float  # of processors, its children's too
    peak: int  # bytes
    written: int  # bytes of all that it wrote


def main() -> int:
    """Run, print; 2 where a command fails or the other revision can't be installed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_common(parser, 3, "the medians")
    parser.add_argument("--against", metavar="REV", help="revision of git that takes turns with this one")
    parser.add_argument("--environment", type=Path, metavar="FOLDER", help="of --against: made here, or found and used")
    names = [line.name for line in LINES]
    parser.add_argument(
        "--only", nargs="+", choices=names, default=names, metavar="LINE", help=f"of {', '.join(names)}"
    )
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        try:
            pythons = {"here": Path(sys.executable)}
            if given.against:
                pythons[given.against] = environment(given.against, given.environment or Path(passing) / "environment")
            found = measured(pythons, Path(passing), given)
        except CommandError as error:
            print(f"whole_way: {error}", file=sys.stderr)
            return 2
    if given.json:
        content = {name: {side: one._asdict() for side, one in sides.items()} for name, sides in found.items()}
        given.json.write_text(json.dumps(content, indent=1), encoding="utf-8")
    return 0


class CommandError(Exception):
    """A command failed; the message is its last line."""


def environment(revision: str, folder: Path) -> Path:
    """The interpreter of an environment with a revision in it, as `pip install` makes it."""
    python = folder / "venv" / "bin" / "python"
    if not python.exists():
        clone = folder / "facepipe"
        done(["git", "clone", "--quiet", str(_ROOT), str(clone)])
        done(["git", "-C", str(clone), "checkout", "--quiet", revision])
        done([sys.executable, "-m", "venv", str(folder / "venv")])
        pins = str(_ROOT / ".ci" / "torch.txt")
        done([str(python), "-m", "pip", "install", "--quiet", "-e", f"{clone}[train,lod]", "-c", pins])
    return python


def needed(names: list[str]) -> list[Line]:
    """The lines of these names and those that make what they read, in order."""
    wanted, kept = set(names), []
    read: set[str] = set()
    for line in reversed(LINES):
        words = line.words.split()
        makes = {after for flag, after in pairwise(words) if flag in ("-o", "sample")}
        if line.name in wanted or makes & read:
            kept.append(line)
            read |= set(words) - makes
    return kept[::-1]


def measured(pythons: dict[str, Path], passing: Path, given: argparse.Namespace) -> dict[str, dict[str, Cost]]:
    """Every line on every side: the median of its runs, in turns."""
    found: dict[str, dict[str, Cost]] = {}
    for number, side in enumerate(pythons):
        (passing / str(number)).mkdir()
        print(f"{'line' if not number else '':20}  {side:>8}  {'peak':>12}  {'written':>12}", end="")
    print("  ratio" if len(pythons) > 1 else "")
    for line in needed(given.only):
        data = given.data / line.reads
        if not data.exists():
            print(f"{line.name:20}  left out: no {data}")
            continue
        runs: dict[str, list[Cost]] = {side: [] for side in pythons}
        for _ in range(given.runs if line.name in given.only else 1):
            for number, (side, python) in enumerate(pythons.items()):
                own = line if number else line._replace(words=f"{line.words} {line.beyond}")
                runs[side].append(run(python, own, data, passing / str(number)))
        if line.name in given.only:
            found[line.name] = {
                side: Cost(*(statistics.median(one) for one in zip(*costs, strict=True)))
                for side, costs in runs.items()
            }
            print("".join(_cells(line.name, found[line.name])), flush=True)
    return found


def _cells(name: str, sides: dict[str, Cost]) -> Iterator[str]:
    for number, one in enumerate(sides.values()):
        yield f"{name if not number else '':20}  {one.seconds:6.2f} s  {mib(one.peak):>12}  {mib(one.written):>12}"
    if len(sides) > 1:
        here, there = sides.values()
        yield f"  {here.seconds / there.seconds:5.2f}"


def run(python: Path, line: Line, data: Path, folder: Path) -> Cost:
    """One run of a command in a folder, with the files of the commands before."""
    words = [str(data) if word == "{data}" else word for word in line.words.split()]
    command = [str(python), "-m", "facepipe", *words]
    if words[0] not in ("inspect", "demo"):
        command.append("--force")
    shutil.rmtree(folder / "demo", ignore_errors=True)
    clean = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    begun = time.time()
    with (folder / "said.txt").open("w+", encoding="utf-8") as said:
        child = subprocess.Popen(command, cwd=folder, stdout=said, stderr=subprocess.STDOUT, env=clean)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode not in (0, 1):  # 1: done, but a threshold was missed
            said.seek(0)
            raise CommandError(f"{' '.join(words)}: {(said.read().strip().splitlines() or ['no word'])[-1]}")
    written = [one for one in folder.rglob("*") if one.is_file() and one.stat().st_mtime >= begun - 0.01]
    size = sum(one.stat().st_size for one in written if one.name != "said.txt")
    peak = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return Cost(usage.ru_utime + usage.ru_stime, peak, size)


def done(command: list[str]) -> None:
    """Run a command that says nothing.

    :raises CommandError: it failed
    """
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    if found.returncode:
        raise CommandError(f"{' '.join(command[:4])}: {(found.stderr.strip().splitlines() or ['no word'])[-1]}")


if __name__ == "__main__":
    sys.exit(main())
