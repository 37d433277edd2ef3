"""An FBX file, read by ufbx in WebAssembly: flat tables, as samples/ufbx_tables.c lays them out.

ufbx takes ASCII and binary files of versions 3000 to 7700 as exporters really write them; here it can't crash, and has
a memory and a count of steps that the size of the file bounds.
"""

from __future__ import annotations

import atexit
import functools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from facepipe.core.arrays import FloatArray, IntArray
from facepipe.core.errors import InputError
from facepipe.core.policy.bounds import Budget
from facepipe.core.reading import read_bytes
from facepipe.core.webassembly import MOST_BYTES, Program, Run

NONE = 0xFFFFFFFF
MAPS = (  # of a material, in the order of the module's table
    *("base_factor", "base_color", "roughness", "metallic", "emission_factor", "emission_color", "opacity"),
    *("normal", "occlusion", "ior", "transparency_factor", "transparency_color", "bump", "glossiness"),
)
LARGEST = 1e18  # number that is believed: products of two still fit in float32, which files and engines hold
_MODULE = Path(__file__).with_name("ufbx.wasm")
_MOST_FILE_BYTES = 1 << 29
_FREE_BYTES, _PER_BYTE = 1 << 28, 64  # of memory: arrays are deflated, and texts are twice as long as their numbers
# 200 a byte are usual; a node that moves takes 10,000 a sample, however few keys say so: 15 minutes of 100 joints
_FREE_STEPS, _STEPS_PER_BYTE = 1 << 34, 1 << 14
_MOST_STEPS = 1 << 38  # some 40 seconds
_MOST_NOTES = 8  # kinds of what ufbx has mended
_LONGEST_NAME = 4096

Rows = npt.NDArray[np.void]


def _table(**fields: Any) -> np.dtype[np.void]:
    return np.dtype(
        [(name, *(kind if isinstance(kind, tuple) else (kind,))) for name, kind in fields.items()], align=True
    )


_SPAN = np.dtype([("at", "<u4"), ("count", "<u4")])
_MATRIX = ("<f8", 12)


def _spans(*names: str) -> dict[str, Any]:
    return dict.fromkeys(names, _SPAN)


_LISTS = ("points", "faces", "indices", "materials", "holes", "normals", "normal_indices", "uvs", "colors")
_UV = _table(name=_SPAN, values=_SPAN, indices=_SPAN)
_MAP = _table(value=("<f8", 4), texture="<u4", given="<u4")
_KEY = _table(shape="<u4", unused="<u4", weight="<f8")
_TABLES = {
    "nodes": _table(
        **_spans("name", "materials"),
        **dict.fromkeys(("parent", "mesh", "bone", "hidden"), "<u4"),
        **dict.fromkeys(("world", "geometry"), _MATRIX),
    ),
    "meshes": _table(**_spans("name", *_LISTS, "color_indices", "skins", "channels"), color_sets="<u4", unused="<u4"),
    "skins": _table(**_spans("clusters", "vertices", "weights"), method="<u4", most="<u4"),
    "clusters": _table(node="<u4", unused="<u4", geometry_to_bone=_MATRIX, bind_to_world=_MATRIX),
    "channels": _table(**_spans("name", "keys"), weight="<f8"),
    "shapes": _table(**_spans("name", "vertices", "offsets", "normals", "weights")),
    "materials": _table(name=_SPAN, maps=(_MAP, len(MAPS))),
    "textures": _table(
        **_spans("name", "relative", "absolute", "content", "uv_set"),
        **dict.fromkeys(("wrap_u", "wrap_v", "layers", "unused"), "<u4"),
        uv_to_texture=_MATRIX,
    ),
    "stacks": _table(
        **_spans("name", "times", "held", "moved", "other_owner", "other_property"),
        **dict.fromkeys(("others", "unused"), "<u4"),
        **dict.fromkeys(("begin", "end"), "<f8"),
    ),
    "warnings": _table(text=_SPAN, count="<u4", kind="<u4"),
}
_SCENE = _table(
    unit_meters="<f8",
    frames_per_second="<f8",
    axes=("<u4", 3),
    **dict.fromkeys(("version", "lights", "cameras", "constraints", "caches"), "<u4"),
    **_spans(*_TABLES),
)
SKIN_VERTEX = _table(begin="<u4", count="<u4", dual="<f8")
SKIN_WEIGHT = _table(cluster="<u4", unused="<u4", weight="<f8")


@functools.cache
def _program() -> Program:
    return Program(_MODULE, "fbx", bounded=True)


atexit.register(_program.cache_clear)  # wasmtime can't free what is left once Python takes its modules down


@dataclass
class Scene:
    """What a file holds, as tables whose texts and arrays lie in the module's memory. `warnings` grows."""

    path: Path
    strict: bool
    run: Run
    settings: Rows
    tables: dict[str, Rows]
    budget: Budget
    warnings: dict[str, None] = field(default_factory=dict)  # in their order
    files: list[Path] = field(default_factory=list)

    @property
    def where(self) -> str:
        """The file, for messages."""
        return self.path.name

    def error(self, what: str) -> InputError:
        """An error of the file as a whole."""
        return InputError(self.where, what)

    def warn(self, name: str, what: str) -> None:
        """Note something that could not be brought over, once.

        :param name: of the node, mesh or the like; empty: the file
        """
        line = f"{self.where} -> {ascii(name)[1:-1][:80]}: {what}" if name else f"{self.where}: {what}"
        self.warnings[line] = None

    def text(self, span: Rows) -> str:
        """The text of a span: UTF-8, which ufbx has checked, without what no file of ours may hold."""
        count = min(int(span["count"]), _LONGEST_NAME)
        return self.run.read(int(span["at"]), count).decode("utf-8", "replace") if count else ""

    def array(self, span: Rows, dtype: npt.DTypeLike, width: int = 1) -> npt.NDArray[Any]:
        """The (n,) or (n, width) values or rows of a span, finite where they are numbers.

        :raises InputError: NaN, infinity or numbers beyond belief
        """
        kind, count = np.dtype(dtype), int(span["count"])
        size = kind.itemsize * width * count
        self.budget.spend(size, self.error)
        data = self.run.read(int(span["at"]), size) if size else b""
        values = np.frombuffer(data, kind)
        if kind.kind == "f" and not (np.abs(values) <= LARGEST).all():
            raise self.error(f"holds NaN, infinity or numbers over {LARGEST:g}, expected finite ones")
        return values if width == 1 else values.reshape(count, width)

    def places(self, runs: Rows, count: int, what: str) -> IntArray:
        """The places in a list of `count` that runs of it (begin, count) cover, one after another.

        :raises InputError: beyond the list
        """
        counts = runs["count"].astype(np.int64)
        if int((runs["begin"] + counts).max(initial=0)) > count:
            raise self.error(f"{what} beyond a list of {count}")
        self.budget.spend(24 * int(counts.sum()), self.error)
        starts = np.repeat(runs["begin"] - (np.cumsum(counts) - counts), counts)
        return np.asarray(np.arange(len(starts)) + starts)

    def ids(self, span: Rows) -> list[int]:
        """Numbers of rows; `NONE` for none."""
        return list(self.array(span, "<u4").tolist())

    def uv_sets(self, mesh: Rows) -> Rows:
        """The rows of a mesh's UV sets: name, values, indices."""
        return self.array(mesh["uvs"], _UV)

    def keys(self, channel: Rows) -> Rows:
        """The rows of a channel's target shapes: shape, weight."""
        return self.array(channel["keys"], _KEY)

    def samples(self, stack: int, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """World matrices (t, nodes, 4, 4) and weights (t, channels) of an animation.

        :raises InputError: too many, or values that aren't finite
        """
        nodes, channels = len(self.tables["nodes"]), len(self.tables["channels"])
        width = 12 * nodes + channels
        self.budget.spend(8 * width * len(times), self.error)
        try:
            at = _allocated(self.run, np.ascontiguousarray(times, "<f8").tobytes())
            found = self.run.call("sample", stack, at, len(times))
            data = self.run.read(found, 8 * width * len(times)) if width and len(times) else b""
        except InputError as error:
            raise _told(self.path, error) from None
        values = np.frombuffer(data, "<f8").reshape(len(times), width)
        if not (np.abs(values) <= LARGEST).all():
            raise self.error("an animation with NaN, infinity or numbers beyond belief, expected finite ones")
        return matrices(values[:, : 12 * nodes].reshape(len(times), nodes, 12)), values[:, 12 * nodes :]


def matrices(values: npt.NDArray[Any]) -> FloatArray:
    """(..., 4, 4) matrices of (..., 12) numbers, column after column."""
    result = np.zeros((*values.shape[:-1], 4, 4))
    result[..., :3, :] = values.reshape(*values.shape[:-1], 4, 3).swapaxes(-1, -2)
    result[..., 3, 3] = 1.0
    return result


def open_scene(source: Path, *, strict: bool = False) -> Scene:
    """Read a file.

    :raises InputError: no FBX, a damaged file, or one that asks for far more memory or steps than its size allows;
        wasmtime is not there
    """
    program = _program()
    try:
        data = read_bytes(source, _MOST_FILE_BYTES)
    except InputError as error:
        raise InputError(source.name, error.what) from None
    most = min(MOST_BYTES, _FREE_BYTES + _PER_BYTE * len(data))
    budget = Budget(2 * most)
    steps = min(_FREE_STEPS + _STEPS_PER_BYTE * len(data), _MOST_STEPS)
    try:
        run = Run(program, "memory", most_bytes=most, most_steps=steps)
        run.call("_initialize")
        at = run.call("load", _allocated(run, data), len(data))
        if not at:
            failure = np.frombuffer(run.read(run.call("failed"), _SPAN.itemsize), _SPAN)[0]
            said = run.read(int(failure["at"]), min(int(failure["count"]), 80)).decode("ascii", "replace")
            raise InputError(_MODULE.stem, said)
        settings = np.frombuffer(run.read(at, _SCENE.itemsize), _SCENE)[0]
        scene = Scene(source, strict, run, settings, {}, budget, files=[source])
        scene.tables = {name: scene.array(settings[name], dtype) for name, dtype in _TABLES.items()}
    except InputError as error:
        raise _told(source, error) from None
    for one in scene.tables["warnings"][:_MOST_NOTES]:
        times = f", {one['count']} times" if one["count"] > 1 else ""
        scene.warn("", f"{scene.text(one['text'])}{times}")
    return scene


def _told(source: Path, error: InputError) -> InputError:
    """What the module said, of the file."""
    if error.where != _MODULE.stem:
        return error
    what = {
        "Failed to load": "damaged, or not as its version has it",
        "Out of memory": "asks for far more memory than its size allows",
    }.get(error.what, "asks for far more memory than its size allows" if "unreachable" in error.what else error.what)
    return InputError(source.name, f"can't be read as FBX: {what}")


def _allocated(run: Run, data: bytes) -> int:
    at = run.call("allocate", len(data))
    run.write(at, data)
    return at


Axis = Literal["Y", "Z"]


def turn_of(scene: Scene) -> tuple[FloatArray, Axis]:
    """(4, 4) world of the file -> world of the face, and the axis that points up there.

    Both are exact: right-handed files with Y up and Z to the front, or Z up and -Y to the front, stay as they are; the
    axes of others are swapped.
    """
    right, up, front = (int(axis) for axis in scene.settings["axes"])
    if len({right // 2, up // 2, front // 2}) < 3 or max(right, up, front) > 5:
        scene.warn("", "its axes are not known: taken for Y up")
        return np.eye(4), "Y"
    if (right, up, front) == (0, 4, 3):
        return np.eye(4), "Z"
    turn = np.zeros((4, 4))
    for row, axis in enumerate((right, up, front)):
        turn[row, axis // 2] = -1.0 if axis % 2 else 1.0
    turn[3, 3] = 1.0
    if np.linalg.det(turn) < 0:
        scene.warn("", "its axes are left-handed: mirrored to right-handed ones")
    return turn, "Y"
