"""Bone coefficients as a compact payload (.fpb): what is sent to a device that has the face already."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.payload.codec import decode, encode, read_header
    from facepipe.payload.layout import (
        LARGEST,
        MAGIC,
        MAX_VALUES,
        VERSION,
        Encoded,
        Header,
        PayloadContent,
        Precision,
        as_stored,
        joints_hash,
    )
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "LARGEST",
    "MAGIC",
    "MAX_VALUES",
    "VERSION",
    "Encoded",
    "Header",
    "PayloadContent",
    "Precision",
    "as_stored",
    "decode",
    "encode",
    "joints_hash",
    "read_header",
]
