"""Plug-ins: an importer and an exporter of others, installed in a folder and used by the command line."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
from typed_plugins import EXPORTERS, IMPORTERS

import facepipe
from facepipe import registry

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
from facepipe.stage.imported import Imported


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
ENTRY_POINTS = """[facepipe.exporters]
xyz = xyz_plugin.write
broken = xyz_plugin.nothing
part = xyz_plugin.read

[facepipe.importers]
xyz = xyz_plugin.read
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the plug-in installed as pip does it, and a face of two triangles in an .xyz file."""
    site = tmp_path / "site"
    (site / "xyz_plugin").mkdir(parents=True)
    for name, text in (("__init__", ""), ("write", EXPORTER), ("read", IMPORTER)):
        (site / "xyz_plugin" / f"{name}.py").write_text(text)
    info = site / "xyz_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: xyz-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    (tmp_path / "quad.xyz").write_text("4\n0 0 0\n1.25 0 0\n1.25 2.0625 0\n0 2 0.5\n0 1 2\n0 2 3\n")
    return tmp_path


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A command line in a process that finds the plug-in."""
    program = "import sys; from facepipe.cli import main; sys.exit(main(sys.argv[1:]))"
    path = os.pathsep.join([str(folder / "site"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True,
        text=True,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": path},
    )


def test_a_file_goes_through_the_importer_a_stage_and_the_exporter(folder: Path) -> None:
    done = run(folder, "import", "xyz", "quad.xyz", "quad.usda", "--scale", "2")
    assert (done.returncode, done.stderr) == (0, "facepipe: warning: xyz: has no joints\n")
    (mesh,) = facepipe.open(folder / "quad.usda").parts().meshes
    np.testing.assert_array_equal(mesh.points, [[0, 0, 0], [2.5, 0, 0], [2.5, 4.125, 0], [0, 4, 1]])

    done = run(folder, "export", "quad.usda", "-o", "head.xyz", "--decimals", "2")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("head.xyz: 74 bytes"), done.stdout
    assert (folder / "head.xyz").read_text().splitlines()[1:4] == ["0.00 0.00 0.00", "2.50 0.00 0.00", "2.50 4.12 0.00"]

    assert run(folder, "validate", "head.xyz").returncode == 0
    (folder / "head.xyz").write_text("1\nnan 0 0\n")
    done = run(folder, "validate", "head.xyz")
    assert done.returncode == 1
    assert done.stdout.startswith("error: xyz:Finite: head.xyz:2: not finite\n")


def test_help_lists_the_options_of_plug_ins(folder: Path) -> None:
    done = run(folder, "import", "--help")
    assert "--scale" in done.stdout, done.stderr
    assert "--weld" in done.stdout


@pytest.mark.parametrize(
    ("suffix", "line"),
    [
        ("broken", "plug-in broken (xyz_plugin.nothing): can't be loaded: No module named 'xyz_plugin.nothing'"),
        ("part", "plug-in part (xyz_plugin.read): has no export, expected Options, export, validate"),
    ],
)
def test_a_plug_in_that_breaks_the_contract_is_refused_in_one_line(folder: Path, suffix: str, line: str) -> None:
    done = run(folder, "export", "quad.usda", "-o", f"head.{suffix}")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"facepipe: {line}\n")


def test_our_own_plug_ins_are_those_that_types_are_checked_of() -> None:
    """`typed_plugins` holds them as what the protocols ask for, which mypy compares."""
    for group, modules in ((registry.EXPORTERS, EXPORTERS), (registry.IMPORTERS, IMPORTERS)):
        ours = {one.load() for one in entry_points(group=group) if one.value.startswith("facepipe_")}
        assert {*modules} == ours
