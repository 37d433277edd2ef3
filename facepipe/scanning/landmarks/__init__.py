"""The landmarks of a scanned face, found by facepipe's own network in pictures of the scan."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.scanning.landmarks.find import FindScanLandmarks
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = ["FindScanLandmarks"]
