"""Looks in 23 bytes, for payloads of persons: who has the same head has the same pictures.

How they look is in docs/files.md, "A person (.fpb)".
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Collection
from typing import Any

from facepipe.core.errors import InputError
from facepipe.heads.people import BEARDS, BROWS, HAIR, IRIS, STYLES, TONES, Look

_CODE = struct.Struct("<I9B5H")
_SHARES = ("redness", "lips", "age", "feminine", "freckles", "beard", "brows", "grey")
_NAMES: dict[str, Collection[str]] = {
    "brow_shape": BROWS,
    "eyes": IRIS,
    "hair": HAIR,
    "style": STYLES,
    "whiskers": BEARDS,
}
_FULL = 255
_MOST = {"lips": 2.0}  # of a share that goes beyond 1


def encode_look(look: Look) -> bytes:
    """The bytes of a look."""
    tone = round(_FULL * (look.tone - 1) / (TONES - 1))
    shares = (round(_FULL * min(max(getattr(look, name) / _MOST.get(name, 1.0), 0.0), 1.0)) for name in _SHARES)
    return _CODE.pack(look.seed % (1 << 32), tone, *shares, *(_short(getattr(look, name)) for name in _NAMES))


def decode_look(data: bytes, where: str) -> tuple[Look, tuple[str, ...]]:
    """The look of bytes, and what of it this head does not have, which is as a plain look has it.

    :raises InputError: another number of bytes
    """
    if len(data) != _CODE.size:
        raise InputError(where, f"{len(data)} bytes, expected {_CODE.size}")
    seed, tone, *rest = _CODE.unpack(data)
    shares = {name: value * _MOST.get(name, 1.0) / _FULL for name, value in zip(_SHARES, rest, strict=False)}
    pairs = zip(_NAMES.items(), rest[len(_SHARES) :], strict=True)
    names = {name: _named(known, short) for (name, known), short in pairs}
    had: dict[str, Any] = {name: found for name, found in names.items() if found is not None}
    look = Look(seed=seed, tone=1 + tone * (TONES - 1) / _FULL, **shares, **had)
    return look, tuple(name for name in names if name not in had)


def _short(name: str) -> int:
    """Two bytes that differ between the names of a table."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:2], "little")


def _named(known: Collection[str], short: int) -> str | None:
    return next((name for name in known if _short(name) == short), None)
