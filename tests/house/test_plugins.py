"""Plug-ins: an importer, an exporter and an action of others, installed in a folder and used as our own are."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import fresh_process
import numpy as np
import pytest
from faces import tiny_face
from fresh_process import End, commands
from typed_plugins import EXPORTERS, IMPORTERS

import facepipe
from facepipe import actions, registry
from facepipe.cli import commands_of
from facepipe.core.errors import InputError
from facepipe.stage import save_parts

# what the contract in facepipe/registry.py asks for, and nothing else
EXPORTER = """
from dataclasses import dataclass

from facepipe.core.reports import ExportReport, Finding
from facepipe.declare import option


@dataclass(frozen=True, kw_only=True)
class Options:
    decimals: int = option(6, "digits after the point", 0, 9)


def export(face, path, options):
    (mesh,) = face.parts().meshes
    points = [" ".join(f"{one:.{options.decimals}f}" for one in point) for point in mesh.points]
    triangles = [" ".join(map(str, row)) for row in mesh.face_vertex_indices.reshape(-1, 3).tolist()]
    path.write_text("\\n".join([str(len(points)), *points, *triangles]) + "\\n")
    return ExportReport(path=path, files=(path,), counts={"points": len(points)}, bytes=path.stat().st_size)


def validate(path):
    for number, line in enumerate(path.read_text().splitlines()[1:], start=2):
        if "nan" in line:
            yield Finding(check="xyz:Finite", severity="error", where=f"{path.name}:{number}", message="not finite")
"""
IMPORTER = """
from dataclasses import dataclass

import numpy as np

from facepipe.declare import option
from facepipe.parts import FaceParts, Mesh
from facepipe.stage.recipes import Imported


@dataclass(frozen=True, kw_only=True)
class Options:
    scale: float = option(1.0, "factor of the points", 0.001, 1000.0)


def read(source, options):
    first, *rows = source.read_text().splitlines()
    points = np.array([row.split() for row in rows[: int(first)]], dtype=np.float32) * options.scale
    triangles = np.array([row.split() for row in rows[int(first) :]], dtype=np.int32)
    counts = np.full(len(triangles), 3, np.int32)
    mesh = Mesh(name="Head", points=points, face_vertex_counts=counts, face_vertex_indices=triangles.ravel())
    return Imported(parts=FaceParts(meshes=(mesh,)), warnings=("xyz: has no joints",))
"""
ACTION = """
'''Move a face up.

example: facepipe lift head.usda --by-mm 5 -o up.usda
'''
from dataclasses import dataclass, replace
from pathlib import Path

from facepipe.core.reports import Report
from facepipe.declare import option, source
from facepipe.kinds import StageAction, action
from facepipe.stage.author_changes import author_changes


@dataclass(frozen=True, kw_only=True)
class LiftReport(Report):
    points: int


@action("lift", "move a face up")
@dataclass(frozen=True, kw_only=True)
class Lift(StageAction[LiftReport]):
    face: Path = source("face stage")
    by_mm: float = option(10.0, "how far", 0.0, 100.0, "mm")

    def author(self, face, job):
        recipe, parts = job.recipe(), face.parts()
        step = [0.0, self.by_mm / face.mm_per_unit, 0.0]
        meshes = tuple(replace(mesh, points=mesh.points + step) for mesh in parts.meshes)
        author_changes(face, replace(parts, meshes=meshes, recipe=recipe))
        return LiftReport(points=sum(len(mesh.points) for mesh in meshes))

    def text(self, report, out):
        return f"{out}: {report.points} points lifted"
"""
ENTRY_POINTS = """[facepipe.exporters]
xyz = xyz_plugin.write
broken = xyz_plugin.nothing
part = xyz_plugin.read

[facepipe.importers]
xyz = xyz_plugin.read

[facepipe.processors]
lift = xyz_plugin.lift:Lift
sink = xyz_plugin.nothing:Sink
drop = xyz_plugin.lift:Lift
burst = xyz_plugin.burst:Burst
skin = xyz_plugin.lift:Lift
demo = xyz_plugin.lift:Lift
database = xyz_plugin.lift:Lift
studio lift = xyz_plugin.studio:Lift
plain = xyz_plugin.plain:Lift
clash = xyz_plugin.clash:Lift
empty = xyz_plugin.empty:Lift
"""
POINTS = sum(len(mesh.points) for mesh in tiny_face().meshes)


def changed(verb: str, *changes: tuple[str, str]) -> str:
    """The action under another verb, with parts of its text replaced."""
    text = ACTION.replace('"lift"', f'"{verb}"')
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


MODULES = {
    "__init__": "",
    "write": EXPORTER,
    "read": IMPORTER,
    "lift": ACTION,
    "studio": changed(
        "studio lift",
        ('a face up"', 'a face up by 1%"'),
        ('"face stage"', '"face stage, 100%"'),
        ("    by_mm", '    more_mm: tuple[float, ...] = option((), "more", 0.0, 100.0, "mm")\n    by_mm'),
        ("self.by_mm /", "(self.by_mm + sum(self.more_mm)) /"),
    ),
    "plain": changed("plain", ("@dataclass(frozen=True, kw_only=True)\nclass Lift(", "class Lift(")),
    "clash": changed("clash", ("by_mm", "output")),
    "empty": changed("empty", ('    face: Path = source("face stage")\n', "")),
    "burst": "raise OSError('no\\nlicence')",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the plug-in installed as pip does it, and a face of two triangles in an .xyz file."""
    site = tmp_path / "site"
    (site / "xyz_plugin").mkdir(parents=True)
    for name, text in MODULES.items():
        (site / "xyz_plugin" / f"{name}.py").write_text(text)
    info = site / "xyz_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: xyz-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (tmp_path / "quad.xyz").write_text("4\n0 0 0\n1.25 0 0\n1.25 2.0625 0\n0 2 0.5\n0 1 2\n0 2 3\n")
    return tmp_path


def run(folder: Path, *lines: str) -> list[End]:
    """Command lines in a process that finds the plug-in."""
    return commands(folder, folder / "site", *lines)


def python(folder: Path, program: str) -> End:
    """A program in a process that finds the plug-in."""
    return fresh_process.python(folder, folder / "site", "-c", program)


def test_a_file_goes_through_the_importer_a_stage_and_the_exporter(folder: Path) -> None:
    imported, exported, checked = run(
        folder,
        "import xyz quad.xyz quad.usda --scale 2",
        "export quad.usda -o head.xyz --decimals 2",
        "validate head.xyz",
    )
    assert (imported.returncode, imported.stderr) == (0, "facepipe: warning: xyz: has no joints\n")
    (mesh,) = facepipe.open(folder / "quad.usda").parts().meshes
    np.testing.assert_array_equal(mesh.points, [[0, 0, 0], [2.5, 0, 0], [2.5, 4.125, 0], [0, 4, 1]])

    assert exported.returncode == 0, exported.stderr
    assert exported.stdout.startswith("head.xyz: 74 bytes"), exported.stdout
    assert (folder / "head.xyz").read_text().splitlines()[1:4] == ["0.00 0.00 0.00", "2.50 0.00 0.00", "2.50 4.12 0.00"]

    assert checked.returncode == 0
    (folder / "head.xyz").write_text("1\nnan 0 0\n")
    (done,) = run(folder, "validate head.xyz")
    assert done.returncode == 1
    assert done.stdout.startswith("error: xyz:Finite: head.xyz:2: not finite\n")


def test_help_lists_the_options_of_plug_ins(folder: Path) -> None:
    (done,) = run(folder, "import --help")
    assert "--scale" in done.stdout, done.stderr
    assert "--weld" in done.stdout


def test_a_plug_in_that_breaks_the_contract_is_refused_in_one_line(folder: Path) -> None:
    expected = {
        "broken": "plug-in broken (xyz_plugin.nothing): can't be loaded: No module named 'xyz_plugin.nothing'",
        "part": "plug-in part (xyz_plugin.read): has no export, expected Options, export, validate",
    }
    ends = run(folder, *(f"export quad.usda -o head.{suffix}" for suffix in expected))
    assert ends == [(2, "", f"facepipe: {line}\n") for line in expected.values()]


def test_an_action_of_others_is_a_command_with_recipe_edit_and_cook(folder: Path) -> None:
    save_parts(tiny_face(), folder / "face.usda")

    def lifted() -> list[float]:
        """How far all points of up.usda are above those of face.usda, in mm."""
        low, up = (facepipe.open(folder / name) for name in ("face.usda", "up.usda"))
        moved = (up.evaluate() - low.evaluate()) * low.mm_per_unit
        np.testing.assert_allclose(moved, np.tile(moved[0], (POINTS, 1)), atol=1e-3)
        return [round(float(one), 3) for one in moved[0]]

    help, done, far = run(
        folder,
        "lift --help",
        "lift face.usda --by-mm 5 -o up.usda",
        "lift face.usda --by-mm 101 -o far.usda",
    )
    assert "Move a face up.\n\nexample: facepipe lift head.usda" in help.stdout
    assert "--by-mm BY_MM    how far [mm] (default 10.0)" in re.sub(" {5,}", "    ", help.stdout)
    assert done == (0, f"up.usda: {POINTS} points lifted\n", "")
    assert lifted() == [0, 5, 0]
    assert far == (2, "", "facepipe: option by_mm: is 101.0, expected a number from 0 to 100\n")

    (done,) = run(folder, "lift --edit up.usda --by-mm 7 --force --json")
    assert json.loads(done.stdout) == {"path": "up.usda", "points": POINTS, "warnings": []}, done.stderr
    assert lifted() == [0, 7, 0]
    made = (folder / "up.usda").read_bytes()

    save_parts(replace(tiny_face(), meters_per_unit=0.02), folder / "face.usda")
    done, again = run(folder, "cook up.usda", "cook up.usda")
    assert "up.usda: lift: cooked" in done.stdout, done.stderr
    assert (folder / "up.usda").read_bytes() != made
    assert lifted() == [0, 7, 0]
    assert "1 up to date" in again.stdout


def test_an_action_of_others_is_done_in_python(folder: Path) -> None:
    save_parts(tiny_face(), folder / "face.usda")
    program = "import facepipe; print(facepipe.lift('face.usda', by_mm=5.0, out='up.usda').points)"
    done = python(folder, program)
    assert done.stdout == f"{POINTS}\n", done.stderr
    assert [end.returncode for end in run(folder, "lift face.usda --by-mm 5 -o same.usda")] == [0]
    assert (folder / "up.usda").read_bytes() == (folder / "same.usda").read_bytes()


def test_a_verb_of_two_words_is_a_command_of_a_group(folder: Path) -> None:
    save_parts(tiny_face(), folder / "face.usda")
    line = "studio lift face.usda --by-mm 5 --more-mm 1 --more-mm 0.5"
    help, options, done, kept, far = run(
        folder,
        "studio --help",
        "studio lift --help",
        f"{line} -o up.usda",
        "cook up.usda",
        f"{line} --more-mm 200 -o far.usda",
    )
    assert re.search(r"^    lift +move a face up by 1%$", help.stdout, re.MULTILINE)
    assert "face stage, 100%" in options.stdout
    assert (done.returncode, done.stderr) == (0, "")
    moved = facepipe.open(folder / "up.usda").evaluate() - facepipe.open(folder / "face.usda").evaluate()
    np.testing.assert_allclose(moved, np.tile([0.0, 0.65, 0.0], (POINTS, 1)), atol=1e-4)
    assert "up.usda: studio lift: up to date" in kept.stdout
    assert far.stderr == "facepipe: option more_mm: is 200.0, expected a number from 0 to 100\n"

    program = "import facepipe; facepipe.studio_lift('face.usda', by_mm=5.0, more_mm=(1.0, 0.5), out='same.usda')"
    assert python(folder, program).returncode == 0
    assert (folder / "up.usda").read_bytes() == (folder / "same.usda").read_bytes()


def test_functions_of_actions_that_cannot_be_used_are_no_attributes(folder: Path) -> None:
    assert python(folder, "import facepipe; print(hasattr(facepipe, 'burst'))").stdout == "False\n"
    done = python(folder, "import facepipe; facepipe.burst")
    line = "AttributeError: facepipe.burst: plug-in burst (xyz_plugin.burst:Burst): can't be loaded: no licence\n"
    assert done.stderr.endswith(line)


def test_actions_that_break_the_contract_are_refused_in_one_line_and_nothing_else_breaks(folder: Path) -> None:
    wrong = {
        "sink": "(xyz_plugin.nothing:Sink): can't be loaded: No module named 'xyz_plugin.nothing'",
        "drop": "(xyz_plugin.lift:Lift): is no action of that verb, expected one",
        "burst": "(xyz_plugin.burst:Burst): can't be loaded: no licence",
        "plain": "(xyz_plugin.plain:Lift): has fields that can't be read, expected a dataclass: must be called with a "
        "dataclass type or instance",
        "clash": "(xyz_plugin.clash:Lift) -> output: has the name of what every command has, expected another",
        "empty": "(xyz_plugin.empty:Lift): has no source, expected one",
    }
    save_parts(tiny_face(), folder / "face.usda")
    listing, skin, database, inspected, lifted, *refused = run(
        folder,
        "--help",
        "skin --help",
        "database --help",
        "inspect face.usda",
        "lift face.usda -o up.usda",
        *(f"{verb} face.usda -o no.usda" for verb in wrong),
    )
    assert listing.returncode == 0, listing.stderr
    commands = listing.stdout.partition("commands:\n")[2].partition("\n\n")[0]
    listed = dict(line.split(maxsplit=1) for line in commands.splitlines())
    broken = {verb: f"(plug-in {verb} {line})" for verb, line in wrong.items()}
    own = {**commands_of(), "lift": "move a face up", "studio": "actions of plug-ins"}
    assert listed == {**own, **broken}  # skin, demo and database are ours

    assert refused == [(2, "", f"facepipe: plug-in {verb} {line}\n") for verb, line in wrong.items()]
    assert "skeleton" in skin.stdout
    assert "add" in database.stdout
    assert (inspected.returncode, lifted.returncode) == (0, 0)

    other = (folder / "up.usda").read_text().replace('recipe:verb = "lift"', 'recipe:verb = "fly"')
    (folder / "up.usda").write_text(other)
    (folder / "burst.usda").write_text(other.replace('"fly"', '"burst"'))
    unknown, broken_one = run(folder, "cook up.usda", "cook burst.usda")
    assert unknown.stderr.startswith("facepipe: up.usda -> recipe: is of 'fly', expected one of animate, ")
    assert " lift, " in unknown.stderr
    assert broken_one.stderr == f"facepipe: burst.usda -> recipe -> plug-in burst {wrong['burst']}\n"


def test_our_own_plug_ins_are_those_that_types_are_checked_of() -> None:
    """`typed_plugins` holds them as what the protocols ask for, which mypy compares."""
    for group, modules in ((registry.EXPORTERS, EXPORTERS), (registry.IMPORTERS, IMPORTERS)):
        ours = {one.load() for one in entry_points(group=group) if one.value.startswith("facepipe_")}
        assert {*modules} == ours


def test_an_action_that_does_nothing_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its kind asks for a method that it has not."""
    text = "from facepipe.kinds import StageAction, action\n@action('idle', 'rest')\nclass Idle(StageAction): pass\n"
    (tmp_path / "idle_plugin.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    entry = EntryPoint(name="idle", value="idle_plugin:Idle", group=actions.GROUP)
    monkeypatch.setattr(actions, "entries", lambda _: (entry,))
    with pytest.raises(InputError, match=r"plug-in idle \(idle_plugin:Idle\): has no author, expected"):
        actions.find_action("idle")
