"""Blender as a Python module with the add-on, for scripts that tests run. Import this before anything of USD."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy
import facepipe_blender

facepipe_blender.register()
bpy.ops.wm.read_factory_settings(use_empty=True)

import numpy as np  # noqa: E402  (Blender's own, once it has shown where that is)
from mathutils import Matrix, Quaternion, Vector  # noqa: E402, F401

ARGUMENTS: list[Any] = [json.loads(one) for one in sys.argv[1:]]


def world_points(obj: Any) -> np.ndarray:
    """(n, 3) points of a mesh object as Blender shows them, in its world."""
    bpy.context.view_layer.update()
    shown = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    found = np.empty(3 * len(shown.data.vertices), np.float32)
    shown.data.vertices.foreach_get("co", found)
    matrix = np.array(obj.matrix_world, np.float64)
    return found.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def answer(**values: Any) -> None:
    """Hand arrays and texts to the test: in the file that the last argument names."""
    np.savez(Path(ARGUMENTS[-1]), **values)
