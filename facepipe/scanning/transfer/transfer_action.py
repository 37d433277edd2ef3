"""Give a head of others the shapes of a template, on its own mesh: ARKit's 52, with visemes, regions and landmarks.

HEAD is a head or a body of any tool (.glb .gltf .vrm .fbx .obj .ply .stl .off or USD), of any pose and unit. All that
it has stays as it is: points, texture coordinates, materials, joints, skin, clips, shapes. A shape that it has by any
usual name is not made again, unless --replace is given. Without --from the shapes are those of the built-in head; a
FACE of another topology gets how people differ by a fit of the built-in head to it first, for 10 to 20 s more.

Landmarks (multipie68, in HEAD's own coordinates) are read from --landmarks, else from HEAD's name with .landmarks.json,
else they are those of HEAD itself, else they are found on it.

OUT is an override layer over HEAD where that is a stage; --flatten, --cut-mouth and any other HEAD give a standalone
one. What can't be made is named, shape by shape: blinks of painted eyes, a tongue that is not there. Exit code 1: done,
but some shape that was asked for could not be made, or the head is so far from all people that shapes need a look.
--json has a row a shape: verdict, largest_mm, flips (triangles of the skin, seen in the neutral, that turn over) and,
of blinks, lids (gaps, and depths in the eyeball, mm); --report makes a page of it.

examples:
  facepipe transfer head.glb -o head_arkit.glb --picture shapes.png
  facepipe transfer head.usdc -o head_arkit.usdc --from our_hero.usdc --shapes jawOpen eyeBlinkLeft eyeBlinkRight
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.declare import beside, option, source
from facepipe.kinds import Job, StageAction, action
from facepipe.scanning.rebuild.declared import landmark_file

if TYPE_CHECKING:
    from facepipe.parts import FaceParts
    from facepipe.scanning.transfer.transfer import TransferReport
    from facepipe.stage import Face

_NAMES = r"index\.html|report\.json|shapes\.png"  # in the folder of the report
_STEPS = 70  # of the fit, at most 17, and one a shape


@action("transfer", "give a head of others the shapes of a template", remote=True)
@dataclass(frozen=True, kw_only=True)
class TransferAction(StageAction["TransferReport"]):
    """The action."""

    head: Path = source("head or body: .glb .gltf .vrm .fbx .obj .ply .stl .off or USD")
    template: Path | None = source(
        "face of any topology with shapes; landmarks that it lacks are found on it (default the built-in head)",
        default=None,
        flag="--from",
        metavar="FACE",
    )
    landmarks: Path | None = source(
        "landmarks of the head (default HEAD's .landmarks.json)", default=None, flag="--landmarks", metavar="JSON"
    )
    shapes: tuple[str, ...] = option(
        (), "shapes of the template to bring (default ARKit's 52; all: every one)", parse=tuple, words=True
    )
    only: tuple[str, ...] = option(
        (), "bring these alone", choices=("shapes", "regions", "landmarks", "sliders"), parse=tuple, words=True
    )
    joints: bool = option(False, "bring joints with weights too, to a head that has none")
    cut_mouth: bool = option(False, "open a mouth that triangles seal, along edges between the lips")
    replace: bool = option(False, "make shapes, regions, landmarks and sliders that the head has anew")
    picture: Path | None = beside("draw all shapes from the front and from between front and side", ".png", "draw")
    report: Path | None = beside("folder to make: figures of each shape, pictures", "", "write_report", holds=_NAMES)

    @classmethod
    def replaced(cls, arguments: Any) -> Collection[str]:
        """Landmarks of a head in whose place the line gives another."""
        return ["landmarks"] if getattr(arguments, "head", None) else []

    def __post_init__(self) -> None:
        object.__setattr__(self, "landmarks", landmark_file(self.head, self.landmarks))

    def check(self) -> None:
        super().check()
        if self.shapes and self.only and "shapes" not in self.only:
            raise InputError("--shapes", "given with --only without shapes, expected one or the other")

    def made_base(self) -> tuple[FaceParts, tuple[str, ...]] | None:
        from facepipe.scanning.transfer.head import Head, made_head, read_head

        if not self.cut_mouth:
            return made_head(Path(self.head))
        from facepipe.scanning.transfer.cut import with_cut_mouth

        parts, warnings = read_head(Path(self.head))
        return with_cut_mouth(Head.of(parts, str(self.head), self.landmarks)), warnings

    def author(self, face: Face, job: Job) -> TransferReport:
        from facepipe.scanning.transfer.transfer import transfer

        with job.watch("transfer", _STEPS) as bar:
            return transfer(
                face,
                job.recipe(),
                bar.update,
                template=self.template,
                landmarks=self.landmarks,
                shapes=self.shapes,
                only=self.only,
                joints=self.joints,
                anew=self.replace,
            )

    def missed(self, report: TransferReport) -> bool:
        return bool(report.not_made or report.missed)

    def draw(self, face: Face, report: TransferReport, path: Path) -> None:
        """The picture of all shapes."""
        from facepipe.pictures import save_png
        from facepipe.scanning.transfer.pictures import shape_sheet

        save_png(shape_sheet(face.parts(), report.shapes, report.shown, report.place, report.framing), path)

    def write_report(self, face: Face, report: TransferReport, path: Path) -> None:
        """The folder of the report."""
        from facepipe.scanning.transfer.report_page import write_report

        write_report(path, face.parts(), report)
