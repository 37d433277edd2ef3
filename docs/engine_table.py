"""Writes the table of engines.md: `python docs/engine_table.py`. Needs all engines, ../shared/data and two minutes."""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests" / "support"))

from engine_faces import FACES, LAYOUTS, Case, cases  # noqa: E402
from engines import RUNNERS, Piece, versions  # noqa: E402
from facepipe_gltf.options import ENGINES  # noqa: E402

PAGE = HERE / "engines.md"
TABLE = re.compile(r"(?<=<!-- docs/engine_table.py -->\n).*?(?=<!-- end -->)", re.DOTALL)


def cell(engine: str, layout: str, case: Case, pieces: list[Piece]) -> str:
    """A figure, or why there is none."""
    limit = case.limit(engine, layout)
    return limit or f"{case.worst(pieces):.1e}".replace("e-0", "e-")


def main() -> None:
    """Run the matrix."""
    rows = [f"| engine | face | {' | '.join(LAYOUTS)} |", "|---" * (2 + len(LAYOUTS)) + "|"]
    lines: dict[tuple[str, str], str] = {}
    for name, title in FACES.items():
        with tempfile.TemporaryDirectory() as folder:
            made = cases(name, Path(folder))
            for engine, run in RUNNERS.items():
                found = run([one.file for one in made.values()], Path(folder))
                own = zip(made.items(), found, strict=True)
                lines[engine, title] = " | ".join(cell(engine, key, one, pieces) for (key, one), pieces in own)
    stated = versions()
    for engine in RUNNERS:
        own = engine if engine == "assimp" else ENGINES[engine].title
        rows += [f"| {own} {stated[engine]} | {title} | {lines[engine, title]} |" for title in FACES.values()]
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(TABLE.sub("\n" + "\n".join(rows) + "\n\n", page), encoding="utf-8")


if __name__ == "__main__":
    main()
