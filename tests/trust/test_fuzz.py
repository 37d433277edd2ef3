"""Damaged and hostile files of every kind: one line on stderr and exit 2, or success; and whole files or none."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz_formats import FORMATS
from fuzzing import fuzz

QUICK = "ledgers"
GATE = ("usda", "usdc", "usdz", "recipes", "photos", "project files")  # the rest is slow
MARKS = (pytest.mark.gate, pytest.mark.slow)
SLOW = 60  # cases
PASSED_OVER = ("caches", "remains")  # what is damaged there


@pytest.mark.parametrize("name", [QUICK, *(pytest.param(name, marks=MARKS) for name in GATE)])
def test_damaged_files_are_read_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    check(name, 1, 20, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ("ict", "rebuild stages", "long recipes")])
def test_many_damaged_files(name: str, tmp_path: Path) -> None:
    check(name, 2, SLOW, tmp_path)


def check(name: str, seed: int, cases: int, folder: Path) -> None:
    found = fuzz(name, seed, cases, folder, stages=FORMATS[name].stages)
    assert not found.failures, "\n".join(found.failures)
    assert found.counts["cases"] == cases
    assert found.counts["refused"] or name in PASSED_OVER
    assert found.counts["accepted"], "nothing was ever read: the damage is too coarse to show anything"
    assert found.counts["killed in USD"] <= 1 + cases * 0.02
