"""Find the 68 landmarks of a scanned face; OUT is the JSON file that rebuilding takes, to be mended by hand.

SCAN is a mesh or point cloud in any pose and unit, with colours or without: .ply .obj .stl .off .glb .gltf or USD.
facepipe's own network searches pictures of it from all around; landmarks are in the coordinates of SCAN, null
where views disagree. It needs `pip install 'facepipe[train]'`. Exit code 1: done, but some landmarks are null.

example: facepipe scan-landmarks neutral.ply -o neutral.landmarks.json --picture neutral.png
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.cli.parser import add_output, output_of, picture_of
from facepipe.cli.show import emit, progress, warn

if TYPE_CHECKING:
    from facepipe.processors.scan_landmarks import FoundScanLandmarks

_SIZE = 640  # pixels a side of each picture of the sheet
_TURNS = (0.0, 0.7, -0.7)  # radians


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("scan", type=Path, metavar="SCAN", help="mesh or point cloud")
    add_output(parser, "landmark file to write: .json")
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="draw the scan with its landmarks, from three sides"
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Read, search, write."""
    from facepipe.core.atomic import together
    from facepipe.importers.scan_file import read_scan
    from facepipe.importers.scan_landmarks import write_scan_landmarks
    from facepipe.pictures.surface_view import draw_surface
    from facepipe.processors.scan_landmarks import FindScanLandmarks

    out = output_of(arguments, [arguments.scan])
    picture = None
    if arguments.picture is not None:
        picture = picture_of(arguments.picture, arguments, [arguments.scan], out)
    with progress("scan-landmarks", 2) as bar:
        scan = read_scan(arguments.scan)
        bar.update()
        found = FindScanLandmarks(draw=draw_surface)(scan)
        bar.update()
    with together(out):
        write_scan_landmarks(found.landmarks, out)
        if picture is not None:
            _draw(found, picture)
    report = found.report
    warn([*scan.warnings, *report.warnings])
    text = f"{out}: {report.found} landmarks, presence {report.presence:.3f}, spread {report.spread:.1%} of the eyes'"
    emit({"path": str(out), **json.loads(report.to_json())}, f"{text} distance", as_json=arguments.json)
    return 0 if report.found == len(found.landmarks.points) else 1


def _draw(found: FoundScanLandmarks, path: Path) -> None:
    from facepipe.pictures import save_png
    from facepipe.pictures.scan_sheet import scan_sheet

    views = [found.frame.view(yaw, 0.0, _SIZE, 1.4) for yaw in _TURNS]
    save_png(scan_sheet(found.look, views, found.landmarks.points), path)
