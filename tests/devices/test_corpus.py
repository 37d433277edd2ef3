"""The corpus of persons finds readers that differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import person_corpus


def test_disagreements_are_found(tmp_path: Path) -> None:
    """Of figures, and of verdicts."""
    person_corpus.write(tmp_path, 40)
    lines = (tmp_path / "studio.verdicts").read_text().splitlines()
    number = next(i for i, line in enumerate(lines) if line.startswith("ok"))
    figures = np.array(lines[number].split()[1:], float)
    for wrong in ("no", f"ok {figures[0] + 0.001} {' '.join(map(str, figures[1:]))}", "ok nan nan nan nan"):
        changed = [*lines[:number], wrong, *lines[number + 1 :]]
        assert len(person_corpus.disagreements(tmp_path, "studio", changed)) == 1
    assert person_corpus.disagreements(tmp_path, "studio", lines) == []
