"""Programs in WebAssembly: they reach their own memory, which has a cap, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError

MOST_BYTES = 1 << 31  # of memory: addresses beyond are negative numbers
_RESERVED_BYTES = 1 << 28  # of addresses: wasmtime's own 4 GiB fail in a process with limits; beyond, growth copies


class Program:
    """A module, compiled. `wasmtime` is loaded where it is made or run, and nowhere else."""

    def __init__(self, path: Path, extra: str, *, bounded: bool) -> None:
        """:param extra: of facepipe, that brings wasmtime

        :param bounded: for data of others: steps are counted, and few addresses are reserved; a third slower
        :raises InputError: wasmtime is not there
        """
        wasmtime = _wasmtime(extra)
        config = wasmtime.Config()
        config.consume_fuel = bounded
        if bounded:
            config.memory_reservation = _RESERVED_BYTES
            # traps by signals end the process where a host has put back its own handlers: `faulthandler.disable` does
            config.signals_based_traps = False
        self.name, self.extra, self.bounded = path.stem, extra, bounded
        self.engine = wasmtime.Engine(config)
        self.module = wasmtime.Module.from_file(self.engine, str(path))


class Run:
    """An instance of a program with a memory of its own."""

    def __init__(
        self,
        program: Program,
        memory: str,
        *,
        most_bytes: int = MOST_BYTES,
        most_steps: int = 0,
        imports: Sequence[Callable[..., Any]] = (),
    ) -> None:
        """:param memory: name of the memory that the program exports

        :param most_bytes: that it may grow to
        :param most_steps: instructions, more or less, that all calls may take together, where the program is bounded
            (a clock would stop the same data at other places on every machine)
        :param imports: what the program calls, in its order: functions of the caller and the arguments, which raise
            `ValueError`
        :raises InputError: wasmtime is not there, or there is not enough memory
        """
        self._wasmtime = _wasmtime(program.extra)
        self._program, self._most_steps = program, most_steps
        self._store = self._wasmtime.Store(program.engine)
        self._store.set_limits(memory_size=most_bytes)
        if program.bounded:
            self._store.set_fuel(most_steps)
        functions = [
            self._wasmtime.Func(self._store, one.type, function, access_caller=True)
            for one, function in zip(program.module.imports, imports, strict=True)
        ]
        try:
            instance = self._wasmtime.Instance(self._store, program.module, functions)
        except self._wasmtime.WasmtimeError as error:
            raise self._error(error) from None
        self._exports = instance.exports(self._store)
        self._memory = self._exports[memory]

    @property
    def steps(self) -> int:
        """Taken so far, where the program is bounded."""
        return self._most_steps - int(self._store.get_fuel()) if self._program.bounded else 0

    def call(self, name: str, *arguments: float) -> int:
        """What a function of the program gives, 0 for nothing.

        :raises InputError: it ran out of steps or memory, or did what it must not
        """
        try:
            return int(self._exports[name](self._store, *arguments) or 0)
        except (self._wasmtime.Trap, self._wasmtime.WasmtimeError, ValueError) as error:
            if self._program.bounded and self._store.get_fuel() == 0:
                raise self._error("takes too long") from None
            raise self._error(error) from None

    def write(self, address: int, data: bytes) -> None:
        """Put bytes at an address of its memory.

        :raises InputError: they don't lie in it
        """
        self._check(address, len(data))
        self._memory.write(self._store, data, address)

    def read(self, address: int, size: int) -> bytes:
        """The bytes at an address of its memory.

        :raises InputError: they don't lie in it
        """
        self._check(address, size)
        return bytes(self._memory.read(self._store, address, address + size))

    def _check(self, address: int, size: int) -> None:
        # what allocates gives 0 or -1 where there is no memory left
        if not 0 < address <= self._memory.data_len(self._store) - size:
            raise self._error("needs more memory than it may have")

    def _error(self, reason: object) -> InputError:
        return InputError(self._program.name, str(reason).strip().splitlines()[-1].strip()[:100])


def _wasmtime(extra: str) -> Any:
    try:
        import wasmtime
    except ImportError as error:
        raise InputError("wasmtime", f"is not installed, expected `pip install 'facepipe[{extra}]'`") from error
    return wasmtime
