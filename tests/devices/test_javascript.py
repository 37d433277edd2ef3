"""The browser runtime rebuilds persons as Python does, in node, and gives the same verdicts on damaged ones."""

from __future__ import annotations

from pathlib import Path

import browser
import person_corpus
import pytest
from device_readers import corpus_disagreements, run
from places import SUPPORT
from rebuilt_people import HEADS, PEOPLE, assert_lids_as_python, assert_rebuilt_as_python

pytestmark = pytest.mark.slow  # the runtime is built


@pytest.fixture(scope="module")
def driver() -> list[str]:
    return ["node", str(SUPPORT / "devices" / "corpus.mjs"), str(browser.built() / "person.js")]


@pytest.mark.gate
@pytest.mark.parametrize("name", PEOPLE)
def test_points_and_joints_are_pythons(driver: list[str], name: str, tmp_path: Path) -> None:
    assert_rebuilt_as_python(driver, name, tmp_path)


@pytest.mark.gate
def test_verdicts_are_pythons(driver: list[str], tmp_path: Path) -> None:
    person_corpus.write(tmp_path, 400, seed=1)
    assert corpus_disagreements(driver, tmp_path) == []


@pytest.mark.gate
@pytest.mark.parametrize("name", HEADS)
def test_blinks_and_looks_are_pythons(driver: list[str], name: str, tmp_path: Path) -> None:
    assert_lids_as_python(driver, name, tmp_path)


def test_no_case_of_20_000_is_judged_otherwise(driver: list[str], corpus_of_20_000: Path) -> None:
    assert corpus_disagreements(driver, corpus_of_20_000) == []


@pytest.mark.gate
def test_bone_coefficients_get_the_verdicts_of_python(driver: list[str], tmp_path: Path) -> None:
    person_corpus.write_poses(tmp_path, 3000)
    lines = run([*driver, "poses", str(tmp_path / "poses.cases")]).splitlines()
    assert person_corpus.disagreements(tmp_path, "poses", lines) == []
