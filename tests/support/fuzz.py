r"""Fuzzes what facepipe reads.

usage: python tests/support/fuzz.py FORMAT ...|all --cases N --seed S [--jobs N] [--work FOLDER]

One table: cases, lines refused and accepted, and what broke the rule. Exit 1 where something did. `cases` and `usd` are
what it calls itself with (fuzzing.py).

What arrives in folders of others, 31,500 cases in half an hour of a core:

    python tests/support/fuzz.py ledgers plans caches remains "project files" ply stl off usdc vrm "neural rigs" \
        "slider networks" makehuman "records of Blender" --cases 2250 --seed 40 --jobs 2
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

KINDS = ("cases", "refused", "accepted", "traceback", "line", "hang", "death", "partial", "killed in USD")


def usd_alone(path: str) -> None:
    """What our readers ask of USD, without them, in as much memory as they have."""
    from fuzzing import limit_memory
    from pxr import Tf, Usd

    limit_memory()
    with contextlib.suppress(Tf.ErrorException, UnicodeDecodeError, RuntimeError):
        stage = Usd.Stage.Open(path)
        stage.GetCompositionErrors()
        for prim in stage.Traverse():
            for attribute in prim.GetAttributes():
                for time_code in [Usd.TimeCode.Default(), *map(Usd.TimeCode, attribute.GetTimeSamples())]:
                    with contextlib.suppress(Tf.ErrorException, UnicodeDecodeError):
                        attribute.Get(time_code)
            for relationship in prim.GetRelationships():
                relationship.GetForwardedTargets()


def main() -> int:
    if sys.argv[1:2] == ["usd"]:
        usd_alone(sys.argv[2])
        return 0
    from fuzz_formats import FORMATS
    from fuzzing import fuzz, put_good, run_cases

    if sys.argv[1:2] == ["cases"]:
        name, seed, first, count, folder = sys.argv[2], *map(int, sys.argv[3:6]), Path(sys.argv[6])
        put_good(FORMATS[name], folder)
        run_cases(name, FORMATS[name], seed, first, count, folder)
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format", nargs="+", choices=["all", *FORMATS])
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="formats at once")
    parser.add_argument("--work", type=Path)
    arguments = parser.parse_args()
    names = list(FORMATS) if "all" in arguments.format else arguments.format
    work = arguments.work or Path(tempfile.mkdtemp(prefix="fuzz"))
    print("format".ljust(20), *(kind.rjust(max(8, len(kind))) for kind in KINDS), flush=True)
    failures: list[str] = []

    def one(name: str) -> Counter[str]:
        found = fuzz(name, arguments.seed, arguments.cases, work / name, stages=FORMATS[name].stages)
        _row(name, found.counts)
        for line in found.failures:
            print(line, file=sys.stderr, flush=True)
        failures.extend(found.failures)
        return found.counts

    with ThreadPoolExecutor(arguments.jobs) as pool:  # each waits for a process
        counts = [*pool.map(one, names)]
    _row("all", sum(counts, Counter()))
    return int(bool(failures))


def _row(name: str, counts: Counter[str]) -> None:
    print(name.ljust(20), *(str(counts[kind]).rjust(max(8, len(kind))) for kind in KINDS), flush=True)


if __name__ == "__main__":
    sys.exit(main())
