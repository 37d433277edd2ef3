"""meshoptimizer's simplifier, as its WebAssembly module: it has no wheels, and wasmtime, which runs it, has them.

Vertices collapse onto others along edges, so that those left are vertices of the mesh, with all that they have. Seams
(vertices at one place) collapse along themselves. Source of the method: Garland and Heckbert, "Surface simplification
using quadric error metrics", SIGGRAPH 1997; with attributes Hoppe, "New quadric metric for simplifying meshes with
appearance attributes", IEEE Visualization 1999. `samples/meshopt_wasm.py` unpacks the module from npm's meshoptimizer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import BoolArray, FloatArray, IntArray
from facepipe.core.errors import InputError

MOST_ATTRIBUTES = 32  # that the module takes
_MODULE = Path(__file__).with_name("meshopt_simplifier.wasm")
_ALIGNMENT = 16
_ANY_ERROR = 1e30


class Simplifier:
    """The module, compiled."""

    def __init__(self) -> None:
        """:raises InputError: wasmtime is not there"""
        try:
            from wasmtime import Engine, Module
        except ImportError as error:
            raise InputError("wasmtime", "is not installed, expected `pip install 'facepipe[lod]'`") from error
        self._engine = Engine()
        self._module = Module.from_file(self._engine, str(_MODULE))

    def __call__(
        self, points: FloatArray, attributes: FloatArray, triangles: IntArray, fixed: BoolArray, count: int
    ) -> IntArray:
        """(t, 3) at most `count` triangles of the vertices, or what can be reached.

        :param points: (v, 3) of all vertices, also of those that no triangle uses
        :param attributes: (v, k) in the unit of the points; their error counts like that of points
        :param fixed: (v,) vertices that stay
        """
        calls = _Calls(self._engine, self._module)
        extent = float(np.ptp(points, axis=0).max()) or 1.0  # the module scales points, and not attributes, by it
        result, error = calls.room(triangles.size, np.uint32), calls.room(1, np.float32)
        length = calls.simplify(
            *(result, calls.put(triangles, np.uint32), triangles.size),
            *(calls.put(points, np.float32), len(points), 3 * 4),
            *(calls.put(attributes, np.float32), 4 * attributes.shape[1]),
            *(calls.put(np.full(attributes.shape[1], 1.0 / extent), np.float32), attributes.shape[1]),
            *(calls.put(fixed, np.uint8), 3 * count, _ANY_ERROR, 0, error),
        )
        return calls.indices(result, length).reshape(-1, 3)


class _Calls:
    """A fresh instance of the module and its memory."""

    def __init__(self, engine: Any, module: Any) -> None:
        from wasmtime import Instance, Store

        self._store = Store(engine)
        self._exports = Instance(self._store, module, []).exports(self._store)
        self._exports["__wasm_call_ctors"](self._store)

    def room(self, count: int, kind: Any) -> int:
        """The address of memory for `count` values."""
        size = count * np.dtype(kind).itemsize
        return int(self._exports["sbrk"](self._store, -(-size // _ALIGNMENT) * _ALIGNMENT))

    def put(self, values: Any, kind: Any) -> int:
        """The address of values that were put there."""
        data = np.ascontiguousarray(values, kind)
        address = self.room(data.size, kind)
        self._exports["memory"].write(self._store, data.tobytes(), address)
        return address

    def indices(self, address: int, count: int) -> IntArray:
        """(count,) indices at an address."""
        data = self._exports["memory"].read(self._store, address, address + 4 * count)
        return np.frombuffer(data, np.uint32).astype(np.int64)

    def simplify(self, *arguments: Any) -> int:
        """How many indices the simplifier wrote."""
        return int(self._exports["meshopt_simplifyWithAttributes"](self._store, *arguments))
