"""A watch folder: what is put there goes through a plan, again whenever it changes.

usage: python samples/watch_folder.py PLAN.toml [SECONDS]

Runs `facepipe batch PLAN.toml` every SECONDS (default 10) until Ctrl-C. A run does only what has changed; a file that
is still being copied fails, and is taken up once it is whole.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import facepipe


def watch(plan: Path, pause: float) -> None:
    """Run the plan again and again, and print what was done."""
    failures: tuple[str, ...] = ()
    while True:
        try:
            report = facepipe.batch(plan)
        except facepipe.FacepipeError as error:  # no face yet, or a plan that is being edited
            lines: tuple[str, ...] = (str(error),)
        else:
            lines = report.failures
            if report.counts.get("made"):
                print(report.text(), flush=True)
        if lines != failures:
            print(*lines, sep="\n", file=sys.stderr, flush=True)
        failures = lines
        time.sleep(pause)


def main(words: list[str]) -> int:
    """The exit code."""
    if len(words) not in (1, 2):
        print(__doc__, file=sys.stderr)
        return 2
    try:
        watch(Path(words[0]), float(words[1]) if len(words) == 2 else 10.0)
    except KeyboardInterrupt:
        return 0
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
