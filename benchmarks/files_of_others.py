"""Whether files as other programs write them are read as what they mean: nothing may be wrong without a word.

Inputs are drawn by seed over all kinds of `tests/support/their_*.py`: captured clips, glTF files, USD stages, bodies of
wrong units. Each is read by facepipe and by a small reading of its own there, by the formulas of the specifications,
and both are compared: points over time, weights, texture coordinates, pixels, colours, names, units. An input is

    right           all is as its file says
    named           what is otherwise is what a warning, or the line that refuses the file, says
    silently wrong  something else is otherwise

    python benchmarks/files_of_others.py                       60 inputs, the kinds in turn
    python benchmarks/files_of_others.py --seed 7 --inputs 600 --json out.json
    python benchmarks/files_of_others.py --seed 7 --only 12 --keep folder       one of them, its file kept

Exit code 1 where one is silently wrong; it is listed with its number.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import support_modules  # noqa: F401  (finds the modules of tests/support)
import their_bodies
import their_clips
import their_glbs
import their_stages
from arguments import positive
from tables import aligned

from facepipe.core.errors import FacepipeError
from facepipe.importers import load
from facepipe.rig import implausible
from facepipe.stage import open_face, save_parts
from facepipe.verbs.animate import read_performance

KINDS = [
    (family, kind)
    for family, module in (
        ("clips", their_clips),
        ("glTF", their_glbs),
        ("USD", their_stages),
        ("bodies", their_bodies),
    )
    for kind in module.KINDS
]
OUTCOMES = ("right", "named", "silently wrong")
# what a line must say of a difference, by its subject; of other subjects none may be
NAMES = {
    "animation": "shear|they follow|otherwise than an earlier|differently: the first is kept",
    "animation, slightly": "half precision|shear|they follow|otherwise than an earlier|differently: the first is kept",
    "between samples": "shear|there they are lines",
    "default weights": "otherwise than an earlier",
    "damaged": "left out",
    "specular": "specular colour is left out",
    "values": "turns up to|weights up to",
}


@dataclass(frozen=True)
class Verdict:
    """What became of an input."""

    number: int
    family: str
    kind: str
    outcome: str  # one of `OUTCOMES`
    differences: Sequence[tuple[str, str]]
    lines: Sequence[str]  # that facepipe said


def main() -> int:
    """Make, read and judge the inputs, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=positive, default=60, help="how many (default 60)")
    parser.add_argument("--seed", type=int, default=0, help="of all of them (default 0)")
    parser.add_argument("--only", type=int, metavar="NUMBER", help="this input alone")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the files here")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every verdict")
    arguments = parser.parse_args()
    numbers = range(arguments.inputs) if arguments.only is None else [arguments.only]
    verdicts = [judged(arguments.seed, number, arguments.keep) for number in numbers]
    print("\n".join(table(verdicts)))
    print(f"seed {arguments.seed}: {', '.join(f'{sum(v.outcome == one for v in verdicts)} {one}' for one in OUTCOMES)}")
    for verdict in verdicts:
        if verdict.outcome == OUTCOMES[2] or (verdict.differences and arguments.only is not None):
            what = "; ".join(f"{subject}: {figure}" for subject, figure in verdict.differences[:4])
            print(f"{verdict.outcome}: number {verdict.number} ({verdict.kind}): {what}")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(verdict) for verdict in verdicts], indent=1), encoding="utf-8")
    return int(any(verdict.outcome == OUTCOMES[2] for verdict in verdicts))


def judged(seed: int, number: int, keep: Path | None = None) -> Verdict:
    """Input `number` of a seed, read both ways."""
    family, kind = KINDS[number % len(KINDS)]
    rng = np.random.default_rng([seed, number])
    with _folder(keep, number) as folder:
        try:
            differences, lines = _compared(family, kind, rng, folder)
        except FacepipeError as error:
            return Verdict(number, family, kind, "named", [("refused", "the file")], [str(error)])
    said = "\n".join(lines)
    silent = [subject for subject, _ in differences if not re.search(NAMES.get(subject, "(?!)"), said)]
    outcome = OUTCOMES[2] if silent else OUTCOMES[1] if differences else OUTCOMES[0]
    return Verdict(number, family, kind, outcome, differences, lines)


def _compared(
    family: str, kind: str, rng: np.random.Generator, folder: Path
) -> tuple[list[tuple[str, str]], Sequence[str]]:
    """What differs, and what facepipe says of the file.

    :raises FacepipeError: it refuses the file
    """
    if family == "clips":
        clip = their_clips.KINDS[kind](rng, folder)
        performance = read_performance(clip.path)
        return clip.differences(performance), performance.warnings
    if family == "bodies":
        body = their_bodies.KINDS[kind](rng, folder)
        lines = implausible(load("gltf" if body.path.suffix == ".glb" else "usd", body.path).parts)
        return their_bodies.differences(body, lines), lines
    module, importer = (their_glbs, "gltf") if family == "glTF" else (their_stages, "usd")
    path = module.KINDS[kind](rng, folder)
    imported = load(importer, path)
    # by way of a stage, as every face is kept
    save_parts(imported.parts, folder / "imported.usdc")
    return module.differences(path, open_face(folder / "imported.usdc").parts()), imported.warnings


@contextmanager
def _folder(keep: Path | None, number: int) -> Iterator[Path]:
    if keep is not None:
        (keep / str(number)).mkdir(parents=True)
        yield keep / str(number)
        return
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def table(verdicts: Sequence[Verdict]) -> list[str]:
    """A row a kind."""
    rows = [("", "kind", "inputs", *OUTCOMES)]
    for family, kind in KINDS:
        counts = Counter(verdict.outcome for verdict in verdicts if verdict.kind == kind)
        if counts:
            rows.append((family, kind, str(counts.total()), *(str(counts[one] or "") for one in OUTCOMES)))
    return aligned(rows)


if __name__ == "__main__":
    raise SystemExit(main())
