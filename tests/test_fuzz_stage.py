"""Damaged and hostile stages are read or refused in one line, by every reader."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

FUZZER = Path(__file__).parent / "stage_fuzzer.py"


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FUZZER), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=900, check=False)


def usd_alone_dies(path: Path) -> bool:
    """Whether USD's own reader dies of the file, without any of our code.

    What overwrites USD's memory ends now in a signal, now in an exit code of the loader (127), now in nothing at all.
    """
    return any(run("usd", path).returncode != 0 for _ in range(8))


def fuzz(mode: str, suffix: str, seed: int, count: int, folder: Path) -> Counter[str]:
    """How often each reader read or refused a damaged stage.

    A damaged .usdc can overwrite USD's own memory (seen in usd-core 26.11: SIGSEGV in CrateFile::_UnpackValue, one in
    about a thousand), and the program may fail some files later. So what failed is read first in a fresh program,
    and passed over where a program without our code dies of the same file.
    """
    counts: Counter[str] = Counter()
    first = 0
    while first < count:
        done = run(mode, suffix, seed, first, count - first, folder)
        lines = done.stdout.splitlines()
        failures = [line for line in lines if line.startswith("FAILED")]
        if done.returncode == 0 and not failures:
            counts.update(json.loads(lines[-1].removeprefix("DONE ")))
            break
        last = failures[0] if failures else next((line for line in reversed(lines) if line.startswith("at ")), "")
        assert last, f"the fuzzer did not start: {done.stderr[-2000:]}"
        assert failures or done.returncode != 1, f"{last}: the fuzzer itself failed: {done.stderr[-2000:]}"
        name = last.split()[1]
        number = int(name.removeprefix("case").removesuffix(suffix))
        if number == first:
            assert not failures, "\n".join(failures)
            assert usd_alone_dies(folder / name), f"{last}: died with {done.returncode}, but USD alone reads it"
        counts["killed in USD"] += number == first
        counts["restarts"] += 1
        first = number + (number == first)
    assert counts["killed in USD"] <= count * 0.02
    return counts


CASES = [("bytes", ".usda", 100), ("bytes", ".usdc", 100), ("bytes", ".usdz", 50), ("values", ".usda", 150)]


@pytest.mark.parametrize(("mode", "suffix", "count"), CASES)
def test_damaged_stages_are_read_or_refused_in_one_line(mode: str, suffix: str, count: int, tmp_path: Path) -> None:
    counts = fuzz(mode, suffix, 1, count, tmp_path)
    if not counts["restarts"]:
        for reader in ("open", "import", "validate"):
            assert counts[f"{reader} read"] + counts[f"{reader} refused"] == count
            assert counts[f"{reader} read"], "nothing was ever read: the damage is too coarse to show anything"
    assert [one.name for one in tmp_path.iterdir() if one.name.startswith(".")] == []


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "suffix", "count"), CASES)
def test_many_damaged_stages(mode: str, suffix: str, count: int, tmp_path: Path) -> None:
    for seed in range(2, 8):
        fuzz(mode, suffix, seed, count, tmp_path)
