"""Textures from scans: their colours, without their light, on a face that was fitted to them."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.scanning.texture.scan_baking import (
        BakeScanReport,
        ScanTextures,
        author_scan_textures,
        bake_scan,
        lay_on,
    )
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["BakeScanReport", "ScanTextures", "author_scan_textures", "bake_scan", "lay_on"]
