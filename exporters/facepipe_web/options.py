"""Options of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.core.errors import InputError
from facepipe.declare import option

_PORTS = (0, 65535)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the viewer."""

    port: int = option(0, "port on 127.0.0.1, 0 to 65535; 0 takes one that is free", *_PORTS)
    pose: str = option("set", "the person at rest: set (as FACE is set), rest (the template), or an animation")

    def check(self) -> None:
        """Check the values.

        :raises InputError: a value out of range
        """
        if not _PORTS[0] <= self.port <= _PORTS[1]:
            raise InputError("--port", f"is {self.port}, expected a number from {_PORTS[0]} to {_PORTS[1]}")
