"""The page of a transfer: every shape has a row with its figures, and what can't be made says why."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import scan_domes
from PIL import Image

from facepipe.geometry.similarity import Similarity
from facepipe.scanning.transfer.lids import LidFigures
from facepipe.scanning.transfer.report_page import write_report
from facepipe.scanning.transfer.transfer import TransferReport

_HOME = Similarity(rotation=np.eye(3), translation=np.zeros(3))
_LIPS = {"gap_mean": 0.04, "gap_most": 0.18, "over_most": 0.3, "half_most": 0.1, "lip_flips": 0}
_LIDS = LidFigures(gap_mean=0.02, gap_most=0.31, in_ball=0.14, in_ball_neutral=0.12, lid_flips=0)


def _report() -> TransferReport:
    parts = scan_domes.face(3)
    made, blink, not_made = parts.shapes[0], parts.shapes[1], "not made: eyes are <b>paint</b>"
    return TransferReport(
        landmarks="found on the head",
        fit_mean_mm=0.23,
        fit_p95_mm=0.91,
        fit_coverage=0.98,
        beyond_mm=1.2,
        shapes={
            made: {"verdict": "made as carried: lips are sealed", "largest_mm": 12.34, "flips": 7},
            blink: {"verdict": "made", "largest_mm": 9.87, "flips": 0, "lids": vars(_LIDS)},
            "eyeWideLeft": {"verdict": not_made},
            "mouthClose": {"verdict": "made", "largest_mm": 20.0, "flips": 1, "lips": _LIPS},
        },
        not_made={"eyeWideLeft": "eyes are <b>paint</b>"},
        kept={"tongueOut": "Tongue & Out"},
        still=("Hat", "Hair"),
        warnings=("left eye: eyes are paint",),
        shown=np.ones(sum(len(mesh.points) for mesh in parts.meshes), bool),
        place=_HOME,
        framing=scan_domes.scan(3, 5, _HOME)[1].points,
    )


def _rows(page: str) -> list[list[str]]:
    rows = re.findall("<tr>(.*?)</tr>", page)
    return [re.findall("<t[dh][^>]*>(.*?)</t[dh]>", row) for row in rows]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TransferReport]:
    """The folder of a report."""
    folder, report = tmp_path_factory.mktemp("report"), _report()
    write_report(folder, scan_domes.face(3), report, size=24)
    return folder, report


def test_each_shape_has_a_row_and_text_is_escaped(written: tuple[Path, TransferReport]) -> None:
    folder, report = written
    assert {one.name for one in folder.iterdir()} == {"index.html", "report.json", "shapes.png"}
    page = (folder / "index.html").read_text(encoding="utf-8")
    made, blink = list(report.shapes)[:2]
    assert _rows(page)[1:] == [
        [made, "made as carried: lips are sealed", "12.3", "7", *[""] * 3],
        [blink, "made", "9.9", "0", "0.02", "0.31", "0.12 to 0.14"],
        ["eyeWideLeft", "not made: eyes are &lt;b&gt;paint&lt;/b&gt;", *[""] * 5],
        ["mouthClose", "made", "20.0", "1", *[""] * 3],
        ["tongueOut", "the head&#x27;s own: Tongue &amp; Out", *[""] * 5],
    ]
    assert "mean gap 0.04 mm, largest 0.18" in page
    assert "left eye: eyes are paint" in page
    assert "moved by no shape: Hat, Hair" in page
    assert "3 made, 1 can&#x27;t be made, 1 the head&#x27;s own" in page


def test_the_picture_has_a_cell_for_each_shape_that_is_made_and_the_neutral(
    written: tuple[Path, TransferReport],
) -> None:
    with Image.open(written[0] / "shapes.png") as sheet:
        assert 3 * 2 * 24 <= sheet.width < 4 * 2 * 24


def test_the_json_is_the_report(written: tuple[Path, TransferReport]) -> None:
    folder, report = written
    read = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert read == json.loads(report.to_json())
    assert "shown" not in read
