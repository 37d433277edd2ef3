"""The landmarks of a scanned face, found by facepipe's own network in pictures of the scan."""

from facepipe.processors.scan_landmarks.find import FindScanLandmarks, FoundScanLandmarks, ScanLandmarksReport

__all__ = ["FindScanLandmarks", "FoundScanLandmarks", "ScanLandmarksReport"]
