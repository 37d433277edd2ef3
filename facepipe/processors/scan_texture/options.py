"""What of a scan's colours goes to the textures of a face."""

from __future__ import annotations

from dataclasses import dataclass

from facepipe.declare import Ranged, option


@dataclass(frozen=True, kw_only=True)
class BakeScanOptions(Ranged):
    """How the colours of a scan are baked.

    :raises InputError: an option out of range
    """

    colors: bool = option(True, "give the skin's textures the scan's colours, where both have some")
    even: float = option(1.0, "how much of the light in the scan's colours is taken out; 0: as scanned", 0.0, 1.0)
    relief: bool = option(True, "give the skin's normal maps the scan's detail, where it is finer than the mesh")
    texture_size: int | None = option(
        None, "size of the skin's textures (default that of the template's)", 64, 4096, "texels"
    )
