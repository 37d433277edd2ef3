"""samples/csharp rebuilds persons as Python does, and gives the same verdicts on damaged ones; it needs mono."""

from __future__ import annotations

from pathlib import Path

import pytest
from device_readers import corpus_disagreements, csharp_driver
from rebuilt_people import HEADS, PEOPLE, assert_lids_as_python, assert_rebuilt_as_python

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", PEOPLE)
def test_points_and_joints_are_pythons(name: str, tmp_path: Path) -> None:
    assert_rebuilt_as_python(csharp_driver(), name, tmp_path)


@pytest.mark.parametrize("name", HEADS)
def test_blinks_and_looks_are_pythons(name: str, tmp_path: Path) -> None:
    assert_lids_as_python(csharp_driver(), name, tmp_path)


def test_no_case_of_20_000_is_judged_otherwise(corpus_of_20_000: Path) -> None:
    assert corpus_disagreements(csharp_driver(), corpus_of_20_000) == []
