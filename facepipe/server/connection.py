"""Connections that may not keep still: who sends no whole request head in time is shut out."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

PATIENCE = 30.0  # seconds


class Connection(H11Protocol):
    """uvicorn's, which ends a connection that waits after an answer, but waits for ever for a first request."""

    def connection_made(self, transport: Any) -> None:
        """Begin to look at the clock."""
        super().connection_made(transport)
        self._last: object = None
        self.loop.call_later(PATIENCE, self._look)

    def _look(self) -> None:
        transport: Any = self.transport
        if transport.is_closing() or not isinstance(transport, asyncio.Transport):
            return
        if transport.get_protocol() is not self:  # a websocket has taken it over
            return
        cycle = self.cycle
        idle = cycle is None or cycle.response_complete
        if idle and (cycle is None or cycle is self._last):
            transport.close()
            return
        self._last = cycle if idle else None
        self.loop.call_later(PATIENCE, self._look)
