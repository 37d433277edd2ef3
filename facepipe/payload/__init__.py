"""Payloads: what travels to a device that has the rig, as bytes and back."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.payload.coefficients import (
        MAX_VALUES,
        PayloadContent,
        Precision,
        as_stored,
        decode,
        encode,
        joints_hash,
        read_header,
    )
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "MAX_VALUES",
    "PayloadContent",
    "Precision",
    "as_stored",
    "decode",
    "encode",
    "joints_hash",
    "read_header",
]
