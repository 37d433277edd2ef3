"""The report of a rebuild: what its pictures show, and that the folder is there whole or not at all."""

from __future__ import annotations

import contextlib
import io
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import scan_domes
from command_line import exit_code, failed
from PIL import Image
from places import names
from rebuild_project import put

from facepipe.core.atomic import replacing_folder
from facepipe.core.errors import InputError
from facepipe.pictures.face_picture import PictureOptions, picture, pictures
from facepipe.pictures.overlay import HeatMap
from facepipe.scanning.database import save_database
from facepipe.scanning.rebuild import Rebuild, Rebuilt, Template, read_project
from facepipe.scanning.rebuild.rebuild_report import report_steps, shapes_table, write_report
from facepipe.scanning.rebuild_pictures import changed_pictures, most_changed, stacked, turntable
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import open_face, save_parts

PERSON = 9  # none of the database's
SIZE = 96  # pixels of a picture of a scan
FILES = ["expressions", "expressions/open.png", "neutral.png", "report.html", "report.json"]


def _open(weight: float) -> tuple[Scan, ScanLandmarks]:
    """The person with the jaw open, somewhere, with landmarks."""
    head = scan_domes.face(PERSON).meshes[0]
    points, shape = head.points.copy(), head.blendshapes[0]
    points[shape.point_indices] += weight * 1.3 * shape.offsets
    placed = scan_domes.POSE.apply(10.0 * points)
    triangles = head.face_vertex_indices.reshape(-1, 3)
    marks = placed[head.landmarks["multipie68"].indices]
    return Scan(name="open", points=placed, triangles=triangles), ScanLandmarks(points=marks)


@dataclass(frozen=True)
class Made:
    """A project, and the report of its first run."""

    folder: Path
    result: dict[str, object]
    json: str

    def words(self, *more: object) -> tuple[object, ...]:
        return ("rebuild", self.folder / "p.toml", "-o", self.folder / "out.usda", "--force", *more)

    def rebuilt(self) -> Rebuilt:
        """From the stages' results."""
        project = read_project(self.folder / "p.toml")
        template = Template.of(open_face(project.template).parts(), "head.usda")
        with mock.patch("facepipe.scanning.rebuild.rebuild.landmarks_of", side_effect=AssertionError):
            return Rebuild(project, template)()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("rebuild")
    save_parts(scan_domes.face(), folder / "head.usda")
    save_database(scan_domes.database(), folder / "faces.fpdb")
    put(folder, "neutral", *scan_domes.scan(PERSON))
    put(folder, "open", *_open(0.8))
    lines = ['template = "head.usda"', 'database = "faces.fpdb"', "[neutral]", 'scan = "neutral.ply"']
    lines += ["[expressions.open]", 'scan = "open.ply"', "weights = { jawOpen = 0.8 }"]
    (folder / "p.toml").write_text("\n".join(lines), encoding="utf-8")
    former = folder / "report"  # of an expression that is in the project no more
    (former / "expressions").mkdir(parents=True)
    (former / "report.json").write_text("{}", encoding="utf-8")
    (former / "expressions" / "gone.png").write_bytes(b"old")
    words = Made(folder, {}, "").words("--json", "--report", former)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert exit_code(*words) in (0, 1)
    return Made(folder, json.loads(out.getvalue()), out.getvalue())


def test_all_files_are_there_and_none_of_a_former_report(made: Made) -> None:
    assert names(made.folder / "report") == FILES


def test_the_report_is_what_the_command_prints(made: Made) -> None:
    assert (made.folder / "report" / "report.json").read_text(encoding="utf-8") == made.json
    assert made.result["report"] == str(made.folder / "report")


def test_rows_and_columns_of_a_turntable(made: Made) -> None:
    """Scan and registered face look alike; distances have the colours of a heat map alone, from violet."""
    pixels = np.asarray(Image.open(made.folder / "report" / "expressions" / "open.png").convert("RGB")).astype(int)
    violet = (pixels[..., 2] - pixels[..., 1] > 25) & (pixels[..., 0] - pixels[..., 1] > 10)
    scan, face, heat = np.array_split(violet, 3)
    assert max(scan.mean(axis=1).max(), face[:-8].mean(axis=1).max()) < 0.02
    assert heat.mean(axis=1).max() > 0.1
    assert min(third.mean() for third in np.array_split(heat, 3, axis=1)) > 0.03


def test_the_page_has_each_scan_and_shape(made: Made) -> None:
    page = (made.folder / "report" / "report.html").read_text(encoding="utf-8")
    for words in ("neutral.ply", "open.ply", "shown by the scans", "jawOpen", "slid along the surface: brows"):
        assert words in page
    assert re.search(r"jawOpen \d\.\d\d", page)  # the weight found
    assert "outliers" not in page  # there are none
    assert page.count("<img ") >= 6 + 1  # three rows a scan, and shapes that changed
    assert not re.search(r'(src|href)="(?!data:)', page)  # no other file


def test_the_table_names_each_shape_once(made: Made) -> None:
    rebuilt = made.rebuilt()
    report = rebuilt.reports["shapes"]
    table = "".join(shapes_table(report, rebuilt.shapes))
    assert [table.count(f">{name}<") for name in rebuilt.shapes] == [1] * len(rebuilt.shapes)
    assert re.findall("<li>(.*?)</li>", table) == ["smile"]
    assert report["shapes"]["jawOpen"]["scans"] == ["open"]
    assert report["shapes"]["jawOpen"]["gain"] > 1.05  # this person opens the mouth wider than the template does
    by_hand = "".join(shapes_table(report, rebuilt.shapes, ["shapes/smile"]))
    assert "<td>corrected by hand</td>" in by_hand
    assert "<li>" not in by_hand


def test_an_existing_folder_is_refused(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    """Without --force always; with it where it holds what no report has."""
    folder = made.folder / "again"
    folder.mkdir()
    (folder / "report.json").write_text("{}", encoding="utf-8")
    words = [word for word in made.words("--report", folder) if word != "--force"]
    words[words.index("-o") + 1] = made.folder / "other.usda"
    for more, file, text in (
        ((), "report.json", "exists, expected a new folder"),
        (("--force",), "notes.txt", "holds"),
    ):
        (folder / file).write_text("mine", encoding="utf-8")
        assert text in failed(capsys, *words, *more, folder=made.folder)


@pytest.mark.parametrize(
    ("place", "why"),
    [
        (".", "holds p.toml, which is read or written too"),
        ("p", "holds corrections, expected an empty folder"),
        ("p/corrections", "holds corrections, which is read or written too"),
        ("none/report", "the folder around it does not exist"),
        ("p.toml", "is a file, expected a folder"),
    ],
)
def test_no_folder_that_is_in_use(made: Made, capsys: pytest.CaptureFixture[str], place: str, why: str) -> None:
    assert why in failed(capsys, *made.words("--report", made.folder / place), folder=made.folder)


def test_nothing_is_left_of_a_report_that_fails(made: Made) -> None:
    rebuilt = made.rebuilt()
    scans = tuple(
        replace(expression, scan=expression.scan.with_name("gone.ply")) for expression in rebuilt.project.expressions
    )
    broken = replace(rebuilt, project=replace(rebuilt.project, expressions=scans))
    before = names(made.folder)
    with pytest.raises(InputError, match=r"gone\.ply"), replacing_folder(made.folder / "broken") as folder:
        write_report(broken, folder, {}, size=SIZE)
    assert names(made.folder) == before


def test_a_neutral_alone_has_no_pictures_of_shapes(made: Made, tmp_path: Path) -> None:
    rebuilt = made.rebuilt()
    alone = replace(
        rebuilt,
        project=replace(rebuilt.project, expressions=()),
        shapes=rebuilt.personal,
        composites={},
        reports={"neutral": rebuilt.reports["neutral"]},
    )
    steps: list[None] = []
    write_report(alone, tmp_path, {}, lambda: steps.append(None), SIZE)
    assert names(tmp_path) == ["neutral.png", "report.html", "report.json"]
    assert "changed most" not in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert len(steps) == report_steps(alone)


def test_the_same_pictures_again(made: Made, tmp_path: Path) -> None:
    for folder in (tmp_path / "one", tmp_path / "other"):
        folder.mkdir()
        write_report(made.rebuilt(), folder, made.result, size=SIZE)
    for name in FILES[1:]:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes(), name


def _shown(distances: np.ndarray) -> np.ndarray:
    """The pixels of the row of distances, (h, w, 3)."""
    parts = scan_domes.face()
    mesh = replace(parts.meshes[0], points=10.0 * parts.meshes[0].points)
    parts = replace(parts, meshes=(mesh,), meters_per_unit=0.001, materials=())
    scan = Scan(name="scan", points=mesh.points, triangles=mesh.face_vertex_indices.reshape(-1, 3))
    images = turntable(parts, scan, distances, 1.0, mesh.points, SIZE)
    return np.asarray(images["distance from the scan"]).astype(float)


def test_no_distance_is_one_colour() -> None:
    """The hue of violet wherever the face is, and no other; where distances differ there are others."""
    count = len(scan_domes.face().meshes[0].points)

    def greenest(pixels: np.ndarray) -> float:
        dark = pixels.max(axis=2) < 140  # the face, not what is behind
        assert dark.sum() > 500
        return float((pixels[..., 1] - pixels[..., 2])[dark].max())

    assert greenest(_shown(np.zeros(count))) < 0.0
    assert greenest(_shown(np.linspace(0.0, 0.7, count))) > 0.0


def test_several_pictures_are_those_of_one_after_another() -> None:
    parts = scan_domes.face()
    heat = HeatMap(values=np.zeros(sum(len(mesh.points) for mesh in parts.meshes)))
    several = [PictureOptions(size=128, view=view, heatmap=heat, samples=1) for view in ("front", "three-quarter")]
    several.append(replace(several[0], bar=False))
    found = [np.asarray(image) for image in pictures(parts, None, several)]
    for image, options in zip(found, several, strict=True):
        np.testing.assert_array_equal(image, np.asarray(picture(parts, None, options)))
    yellow = [((image[..., 0] > 200) & (image[..., 2] < 90)).any() for image in found]
    assert yellow == [True, True, False]  # the upper end of the bar, where there is one


def test_the_most_changed_shapes_are_drawn() -> None:
    """The largest change first, none that has not changed, at most so many; the same change has the same colour."""
    far = {"s0": 0.0, "s1": 0.5, "s2": 0.0, "s4": 2.0, "s5": 1.0}
    assert list(most_changed(far).items()) == [("s4", 2.0), ("s5", 1.0), ("s1", 0.5)]
    assert list(most_changed(far, most=2)) == ["s4", "s5"]
    assert most_changed({"s0": 0.0}) == {}
    parts = scan_domes.face()
    mesh = replace(parts.meshes[0], points=10.0 * parts.meshes[0].points)
    parts, count = replace(parts, meshes=(mesh,), meters_per_unit=0.001), len(mesh.points)
    moved = (mesh.points + np.array([0.0, 0.0, 1.0]), np.ones(count))
    images, limits = changed_pictures(parts, {"s0": moved, "s1": moved}, np.arange(count), mesh.points, size=128)
    np.testing.assert_array_equal(np.asarray(images["s0"]), np.asarray(images["s1"]))
    assert limits == (0.0, 1.0)


def _shape(observed: float, change_mm: float = 0.1, alike: tuple[str, ...] = ()) -> dict[str, object]:
    return {"observed": observed, "gain": 1.0, "change_mm": change_mm, "scans": ["one"], "alike": alike}


def _table(shapes: dict[str, dict[str, object]], *unseen: str) -> str:
    return "".join(shapes_table({"shapes": shapes, "unseen": unseen, "undecided": ()}, shapes))


def test_the_table_of_shapes_shows_what_changed_most_first() -> None:
    table = _table({"a": _shape(0.5), "b": _shape(0.25, 0.2), "<c>": _shape(1.0)}, "<c>")
    assert table.index("<td>b</td>") < table.index("<td>a</td>")
    assert [float(width) for width in re.findall(r'width="([\d.]+)" height="8" fill="var\(--above\)', table)] == [
        25,
        50,
    ]
    assert "2 of 3 shown by the scans" in table
    assert "<li>&lt;c&gt;</li>" in table


def test_the_table_of_shapes_says_what_scans_do_not_tell_apart() -> None:
    table = _table({"a": _shape(0.0, alike=("c",)), "b": _shape(0.0, alike=("c",)), "d": _shape(0.0)}, "b", "d")
    assert "<td>c</td>" in table
    assert table.index("Not shown by the scans") < table.index("<li>d</li>")
    assert table.index("<li>d</li>") < table.index("Not distinguished by the scans") < table.index("<li>b</li>")


def test_pictures_of_one_size_stand_on_top_of_each_other() -> None:
    tall = stacked([Image.new("RGB", (8, 5), color) for color in ("red", "blue")])
    assert (tall.width, tall.getpixel((0, 0)), tall.getpixel((7, tall.height - 1))) == (8, (255, 0, 0), (0, 0, 255))
