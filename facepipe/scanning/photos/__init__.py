"""Scans from photos: cameras and matches by COLMAP, depth by OpenCV, a surface by Poisson reconstruction."""

from typing import TYPE_CHECKING

from facepipe.core.loading import lazy

if TYPE_CHECKING:
    from facepipe.scanning.photos.cameras import (
        Cameras,
        PhotoCamera,
        read_cameras,
        read_markers,
        triangulate,
        write_cameras,
    )
    from facepipe.scanning.photos.options import ScanPhotosOptions
    from facepipe.scanning.photos.photos import photo_files
    from facepipe.scanning.photos.scan import PhotoScan, ScanPhotos, ScanPhotosReport, bars
else:
    __getattr__, __dir__ = lazy(__name__)

__all__ = [
    "Cameras",
    "PhotoCamera",
    "PhotoScan",
    "ScanPhotos",
    "ScanPhotosOptions",
    "ScanPhotosReport",
    "bars",
    "photo_files",
    "read_cameras",
    "read_markers",
    "triangulate",
    "write_cameras",
]
