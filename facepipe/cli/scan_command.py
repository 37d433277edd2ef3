"""Make a scan of photos: a coloured mesh of a face from 5 or more photos around it, taken at one moment.

Needs `pip install 'facepipe[scan]'`. Where the cameras stood and what lenses they have is found from the photos, in a
unit that nothing tells; --cameras gives what a calibrated rig knows (the photos' names, intrinsics and extrinsics), and
the scan then has its unit and coordinates. --save-cameras writes them, for the other expressions of a rig that did
not move. Neighbouring photos should show much the same, some 15 degrees apart; sharp, in even light that moves with
nobody. --masks, white where the person is, help where the backdrop has a pattern of its own.

Landmarks go into OUT's name with .landmarks.json: markers painted on the actor, which --markers tells the pixels of in
two or more photos ({"photos": {"front.jpg": {"chin": [2011, 3020], ...}, ...}}), and of the 68 landmarks those inside
the face, where the extra [train] is there. --marker-distance A B MM, what lies straight between two markers, gives
the scan its scale. Rebuild finds the scale of a scan without.

examples:
  facepipe scan neutral/ -o neutral.ply
  facepipe scan neutral/ --markers markers.json --marker-distance chin brow 118.5 -o neutral.ply --save-cameras rig.json
  facepipe scan smile/ --cameras rig.json -o smile.ply
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress, warn
from facepipe.core.errors import InputError
from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.processors.scan_photos import PhotoScan, ScanPhotosReport
    from facepipe.processors.scan_photos.scan import Step


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    from facepipe.processors.scan_photos import ScanPhotosOptions

    parser.add_argument("photos", type=Path, metavar="PHOTOS", help="folder of 5 or more photos of one expression")
    add_output(parser, "scan to write: .ply")
    parser.add_argument("--cameras", type=Path, metavar="JSON", help="where the cameras stand and what they see")
    parser.add_argument("--save-cameras", type=Path, metavar="JSON", help="write the cameras that were used")
    parser.add_argument("--masks", type=Path, metavar="FOLDER", help="a PNG for each photo, white where the person is")
    parser.add_argument("--markers", type=Path, metavar="JSON", help="pixels of markers in the photos")
    parser.add_argument(
        "--marker-distance", nargs=3, metavar=("A", "B", "MM"), help="two markers and what lies straight between them"
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    add_options(parser, ScanPhotosOptions, "how to scan")


def run(arguments: argparse.Namespace) -> int:
    """Read, scan, write, report."""
    from facepipe.core.atomic import discard_stale, together
    from facepipe.importers.scan_landmarks import write_scan_landmarks
    from facepipe.importers.scan_ply import write_ply
    from facepipe.processors.scan_photos import write_cameras

    out = _output(arguments)
    landmark_file = out.with_name(f"{out.stem}.landmarks.json")
    cameras = _beside(arguments.save_cameras, arguments)
    _beside(landmark_file, arguments)
    with _bars() as step:
        made = _processor(arguments)(arguments.photos, step)
    written = [out]
    with together(out):
        write_ply(made.scan, out)
        if made.landmarks.known.any() or made.landmarks.markers:
            write_scan_landmarks(made.landmarks, landmark_file)
            written.append(landmark_file)
        else:
            discard_stale(landmark_file)
        if cameras is not None:
            write_cameras(cameras, made.cameras)
            written.append(cameras)
    warn(made.report.warnings)
    emit(made.report, _text(made, written), as_json=arguments.json)
    return 0


def _inputs(arguments: argparse.Namespace) -> list[Path]:
    return [one for one in (arguments.cameras, arguments.markers) if one is not None]


def _output(arguments: argparse.Namespace) -> Path:
    out = output_of(arguments, _inputs(arguments))
    if out.suffix.lower() != ".ply":
        raise InputError(out, f"suffix '{out.suffix}', expected .ply")
    return out


def _beside(path: Path | None, arguments: argparse.Namespace) -> Path | None:
    """Another file that is written, checked before any work."""
    if path is None:
        return None
    return output_of(argparse.Namespace(output=path, force=arguments.force), [*_inputs(arguments), arguments.output])


def _processor(arguments: argparse.Namespace) -> Any:
    from facepipe.processors.scan_photos import ScanPhotos, ScanPhotosOptions, read_cameras, read_markers

    return ScanPhotos(
        options=options_from(arguments, ScanPhotosOptions),
        cameras=None if arguments.cameras is None else read_cameras(arguments.cameras),
        markers={} if arguments.markers is None else read_markers(arguments.markers),
        marker_distance=None if arguments.marker_distance is None else _distance(*arguments.marker_distance),
        masks=arguments.masks,
    )


def _distance(first: str, second: str, text: str) -> tuple[str, str, float]:
    try:
        return first, second, float(text)
    except ValueError:
        raise InputError(f"--marker-distance {first} {second}", f"{text[:40]!r}, expected millimetres") from None


@contextmanager
def _bars() -> Iterator[Step]:
    """A bar for each kind of work, one after the other."""
    with ExitStack() as stack:
        shown: dict[str, Any] = {}

        def step(name: str, total: int) -> None:
            if name not in shown:
                stack.close()
                shown[name] = stack.enter_context(progress(name, total))
            shown[name].update()

        yield step


def _text(made: PhotoScan, written: list[Path]) -> str:
    report: ScanPhotosReport = made.report
    unit = report.unit or "(unknown unit)"
    rows = [
        ("photos", f"{len(report.photos_used)} used, {len(report.photos_unused)} not"),
        ("cameras", f"{report.cameras}; matched points are {report.reprojection_px:.2f} pixels off"),
        ("dense points", f"{report.dense_points}, {report.spacing:.3g} {unit} apart"),
        ("agreement of photos", f"{report.consistency:.3g} {unit}, {report.consistency_px:.2f} pixels (median)"),
        ("scan", f"{report.points} points, {report.triangles} triangles"),
        ("landmarks", f"{report.landmarks} of 68, {report.markers} markers"),
    ]
    return "\n".join([*map(str, written), table(rows)])
