"""Connections that may not keep still: who sends no whole request head in time, or reads nothing, is shut out."""

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
        self._left = 0  # bytes that the other side had still to take
        self.loop.call_later(PATIENCE, self._look)

    def _look(self) -> None:
        transport: Any = self.transport
        if transport.is_closing() or not isinstance(transport, asyncio.Transport):
            return
        if transport.get_protocol() is not self:  # a websocket has taken it over
            return
        cycle = self.cycle
        idle = cycle is None or cycle.response_complete
        left = transport.get_write_buffer_size()
        if left and left == self._left:  # an end in good order would wait for it to be read
            transport.abort()
            return
        if idle and (cycle is None or cycle is self._last):
            transport.close()
            return
        self._last, self._left = cycle if idle else None, left
        self.loop.call_later(PATIENCE, self._look)
