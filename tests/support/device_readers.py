"""Readers of persons in other languages, compiled from samples/ with drivers of tests/support/devices."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from person_corpus import SHARES, disagreements
from places import REPOSITORY, SUPPORT

WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Werror")
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-D_GLIBCXX_ASSERTIONS")


@cache
def compiled(source: Path, *flags: str) -> list[str]:
    """The command of a program of C++17, compiled once in this process.

    Skips the test where there is no g++; fails it where the program has a warning.
    """
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++ on the PATH")
    out = Path(mkdtemp(prefix="facepipe-device-")) / source.stem
    run([compiler, "-std=c++17", *WARNINGS, *(flags or ("-O2",)), "-o", str(out), str(source)])
    return [str(out)]


def cpp_driver(*flags: str) -> list[str]:
    """The command of the driver of samples/cpp/facepipe.hpp."""
    return compiled(SUPPORT / "devices" / "corpus.cpp", *flags)


def cpp_person(*flags: str) -> list[str]:
    """The command of samples/cpp/person.cpp."""
    return compiled(REPOSITORY / "samples" / "cpp" / "person.cpp", *flags)


@cache
def csharp_driver() -> list[str]:
    """The command of the driver of samples/csharp/Facepipe.cs, by mono.

    Skips the test where there is no mono.
    """
    compiler, runtime = shutil.which("mcs"), shutil.which("mono")
    if compiler is None or runtime is None:
        pytest.skip("needs mcs and mono on the PATH (Debian: mono-mcs, mono-runtime)")
    out = Path(mkdtemp(prefix="facepipe-device-")) / "corpus.exe"
    sources = (REPOSITORY / "samples" / "csharp" / "Facepipe.cs", SUPPORT / "devices" / "Corpus.cs")
    # 7.2 is the newest that mono's compiler knows: what it takes is C# 7.3
    run([compiler, "-langversion:7.2", "-optimize+", "-warnaserror+", "-warn:4", f"-out:{out}", *map(str, sources)])
    return [runtime, str(out)]


def run(words: Sequence[str]) -> str:
    """What a program prints; its errors fail the test."""
    done = subprocess.run(words, capture_output=True, text=True, encoding="utf-8", check=False)
    if done.returncode:
        pytest.fail(f"{Path(words[0]).name} ended with {done.returncode}: {done.stderr[-2000:]}")
    return done.stdout


def rebuilt(driver: Sequence[str], basis: Path, person: Path, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) points of a person; in rows of 3 places of joints in millimetres, their turns, and that of shapes."""
    out = person.with_suffix(".bin")
    run([*driver, "points", str(basis), str(person), str(out)])
    values = np.fromfile(out, "<f8").reshape(-1, 3)
    return values[:count], values[count:]


def lids(driver: Sequence[str], basis: Path, person: Path) -> tuple[list[tuple[str, float]], np.ndarray]:
    """Names and weights of the shapes of a person's lids, and their offsets (s, k, 3) in millimetres."""
    out = person.with_suffix(".bin")
    rows = [line.split() for line in run([*driver, "lids", str(basis), str(person), str(out)]).splitlines()]
    return [(name, float(weight)) for name, weight in rows], np.fromfile(out, "<f8").reshape(len(rows), -1, 3)


def corpus_disagreements(driver: Sequence[str], folder: Path) -> list[str]:
    """Where a driver's verdicts on the corpora that `person_corpus.write` made are not Python's."""
    found = []
    for name in SHARES:
        words = ["bases"] if name == "bases" else ["persons", str(folder / f"{name}.fpbasis")]
        lines = run([*driver, *words, str(folder / f"{name}.cases")]).splitlines()
        found += disagreements(folder, name, lines)
    return found
