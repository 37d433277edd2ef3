"""What `benchmarks/house.py` counts, on a house of a few lines."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from places import REPOSITORY

LONG = "\n".join(f"    points = points + {number}" for number in range(20))
FILES = {
    "facepipe/__init__.py": "from facepipe.rig.pose import posed",
    "facepipe/rig/__init__.py": "from facepipe.rig.pose import posed",
    "facepipe/rig/pose.py": """
from facepipe.rig.turn import turned

HOME = "facepipe.farm.batch:run"

def posed(points):
    return _moved(turned(points))

def _moved(points):
    return points

class Pose:
    def _once(self):
        return 1

    def twice(self):
        return self._once()
""",
    "facepipe/rig/turn.py": f"""
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from facepipe.rig.pose import Pose

def turned(points):
{LONG}
    return points

def said(points):
{LONG}
    return points  # radians
""",
    "facepipe/farm/batch.py": "from facepipe.neural.train import train",
    "facepipe/neural/train.py": "from facepipe import posed\n\ndef train():\n" + 60 * "    posed(0)\n",
    "exporters/facepipe_gltf/writer.py": "import facepipe.rig.pose",
    "schemas/generate.py": "",
}


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("house")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("core-to-wing", ["facepipe.rig.pose -> facepipe.farm.batch"]),
        ("wing-to-wing", ["facepipe.farm.batch -> facepipe.neural.train"]),
        ("circles", ["facepipe.rig.pose, facepipe.rig.turn"]),
        ("beside", ["facepipe.rig.turn (51) -> facepipe.rig.pose (17)"]),
        ("used-once", ["facepipe.rig.pose: _moved", "facepipe.rig.pose: _once"]),
        ("longest", ["facepipe.neural.train: train (61)"]),
        ("uncommented", ["facepipe.neural.train: train (61)", "facepipe.rig.turn: turned (22)"]),
    ],
)
def test_a_list_has_what_a_row_counts(checkout: Path, name: str, expected: list[str]) -> None:
    words = [sys.executable, str(REPOSITORY / "benchmarks" / "house.py"), "--of", str(checkout), "--list", name]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == expected
