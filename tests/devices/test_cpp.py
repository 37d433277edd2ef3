"""samples/cpp rebuilds persons as Python does, and gives the same verdicts on damaged ones; it needs g++."""

from __future__ import annotations

from pathlib import Path

import person_corpus
import pytest
from device_readers import SANITIZED, corpus_disagreements, cpp_driver, run
from rebuilt_people import HEADS, PEOPLE, assert_lids_as_python, assert_rebuilt_as_python

pytestmark = pytest.mark.slow  # compilers take seconds


@pytest.mark.gate
@pytest.mark.parametrize("name", PEOPLE)
def test_points_and_joints_are_pythons(name: str, tmp_path: Path) -> None:
    assert_rebuilt_as_python(cpp_driver(), name, tmp_path)


@pytest.mark.gate
def test_verdicts_are_pythons(tmp_path: Path) -> None:
    person_corpus.write(tmp_path, 400, seed=1)
    assert corpus_disagreements(cpp_driver(), tmp_path) == []


@pytest.mark.gate
@pytest.mark.parametrize("name", HEADS)
def test_blinks_and_looks_are_pythons(name: str, tmp_path: Path) -> None:
    assert_lids_as_python(cpp_driver(), name, tmp_path)


def test_no_case_of_20_000_goes_out_of_bounds_or_is_judged_otherwise(corpus_of_20_000: Path) -> None:
    assert corpus_disagreements(cpp_driver(*SANITIZED), corpus_of_20_000) == []


@pytest.mark.gate
def test_bone_coefficients_get_the_verdicts_of_python(tmp_path: Path) -> None:
    person_corpus.write_poses(tmp_path, 3000)
    lines = run([*cpp_driver(*SANITIZED), "poses", str(tmp_path / "poses.cases")]).splitlines()
    assert person_corpus.disagreements(tmp_path, "poses", lines) == []
    assert 500 < sum(line.startswith("ok") for line in lines) < 2500
