"""List the regions of a face; with --map author them from a picture painted over its UV layout.

The map is a PNG, the legend a JSON object {"#ff0000": "eyes", ...} or {"regions": {"eyes": "#ff0000", ...}}. Beside the
colours a legend may have "outside": the region of points that the map does not cover (without it they keep the regions
they have), "meshes": {"Eye*": "eyes"}: regions of other meshes, whole, and "background": a colour that means unpainted.
A map covers the UV tile 0 to 1 unless --tile says otherwise. OUT is an override layer over FACE.

examples:
  facepipe regions head.usda --picture regions.png
  facepipe regions head.usda --map map.png --legend legend.json -o head.regions.usda
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.declare import beside, option, source
from facepipe.geometry.map_sampling import MapSampling
from facepipe.kinds import Job, StageAction, action

if TYPE_CHECKING:
    from facepipe.stage import Face
    from facepipe.verbs.regions import RegionsReport


@action("regions", "list regions, or author them from a painted map")
@dataclass(frozen=True, kw_only=True)
class AuthorRegions(MapSampling, StageAction["RegionsReport"]):
    """The action."""

    face: Path = source("face stage")
    map: Path = source("regions painted over the UV layout, a colour each", flag="--map", metavar="PNG")
    legend: Path = source("a JSON file that says which colour is which region", flag="--legend", metavar="JSON")
    mesh: str | None = option(None, "meshes the map covers, globs (default: that of most points)", metavar="NAMES")
    uv_set: str | None = option(None, "UV set that it was painted over (default: st, or the first)", metavar="NAME")
    picture: Path | None = beside("draw the regions on the face", ".png", "draw")

    def author(self, face: Face, job: Job) -> RegionsReport:
        from facepipe.core.images import read_png
        from facepipe.stage.skeleton import author_recipe
        from facepipe.verbs.regions import SetRegions, read_legend

        recipe = job.recipe()
        set_regions = SetRegions(
            image=read_png(self.map),
            legend=read_legend(self.legend),
            mesh=self.mesh,
            uv_set=self.uv_set,
            where=str(self.map),
            sampling=self,
        )
        report = set_regions(face)
        author_recipe(face.prim, recipe)
        return report

    def draw(self, face: Face, report: RegionsReport, path: Path) -> None:
        """The picture of the regions."""
        from facepipe.verbs.regions import draw_regions

        draw_regions(face, path)

    def text(self, report: RegionsReport, out: Path) -> str:
        from facepipe.verbs.regions import region_table

        lines = []
        for mesh in report.meshes:
            counts = ((mesh.outside, "outside the map"), (mesh.kept, "kept"))
            facts = [f"{mesh.points} points", *(f"{count} {what}" for count, what in counts if count)]
            if not mesh.covered:
                facts += [f"all in {name}" for name, count in mesh.regions.items() if count.points]
            facts += [f"removed: {', '.join(mesh.removed)}"] if mesh.removed and mesh.covered else []
            lines.append(f"{out} -> {mesh.mesh}: {', '.join(facts)}")
            lines += [region_table(mesh.regions)] if mesh.covered else []
        return "\n".join(lines)
