"""What is in a face database, as a report and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.reports import Report, table

if TYPE_CHECKING:
    from facepipe.scanning.database.face_database import Entry, FaceDatabase, Update

_SHARES = (0.9, 0.95, 0.99)


@dataclass(frozen=True, kw_only=True)
class DatabaseReport(Report):
    """Everything in a database but its arrays."""

    version: int
    units: str = "mm"
    tolerance_mm: float
    topology: Mapping[str, Any]  # digest, points, meshes: name -> points
    identity: Mapping[str, Any]  # faces, components, deviations_mm (RMS over points), variance_explained (cumulated)
    expressions: Mapping[str, Any] | None  # faces, shapes, basis, core (its sizes), stored_error_mm of the worst face
    left_out: Mapping[str, Sequence[str]]  # shape -> entries that lack it
    entries: tuple[Entry, ...]
    history: tuple[Update, ...]

    def as_text(self, out: Path) -> str:
        """What is there, who, and how it came to be."""
        meshes, explained = len(self.topology["meshes"]), self.identity["variance_explained"]
        shares = [
            f"{one:.0%} of the variance in {1 + sum(have < one - 1e-12 for have in explained)}" for one in _SHARES
        ]
        lines = [
            f"{out}: version {self.version}, {len(self.entries)} faces of {self.topology['points']:,} points "
            f"in {meshes} mesh{'es' * (meshes != 1)}, {out.stat().st_size / 1e6:,.1f} MB",
            f"identity: {self.identity['components']} components, {', '.join(shares)}; first deviation "
            f"{self.identity['deviations_mm'][0]:.2f} mm RMS",
        ]
        if found := self.expressions:
            core, worst = " x ".join(map(str, found["core"])), found["stored_error_mm"]
            lines.append(
                f"expressions: {len(found['shapes'])} shapes of {found['faces']} faces, {found['basis']} directions, "
                f"core {core}; held to {self.tolerance_mm:g} mm RMS, "
                f"worst face {worst['rms_mm']:.3f} RMS, {worst['max_mm']:.2f} at most"
            )
        else:
            lines.append("expressions: none")
        if self.left_out:
            some = ", ".join(f"{shape} ({len(names)} lack it)" for shape, names in self.left_out.items())
            lines.append(f"shapes left out: {some}")
        rows: list[list[object]] = [["face", "from", "since version", "held to mm RMS", "surface mm", "coverage"]]
        for entry in self.entries:
            error = "no shapes" if entry.stored_error is None else f"{entry.stored_error.rms_mm:.3f}"
            quality = entry.quality
            measures = ["", ""] if quality is None else [f"{quality.surface_mean_mm:.3f}", f"{quality.coverage:.2f}"]
            rows.append([entry.name, entry.source, entry.version, error, *measures])
        lines.append(table(rows))
        for update in self.history:
            text = f"version {update.version}: {update.verb} {len(update.entries)} (facepipe {update.facepipe})"
            text += f"; dropped {', '.join(update.dropped)}" if update.dropped else ""
            lines.append(text + "".join(f"; ignored: {line}" for line in update.ignored))
        return "\n".join(lines)


def report_of(database: FaceDatabase, warnings: tuple[str, ...] = ()) -> DatabaseReport:
    """What is in a database."""
    identity, topology, model, expressions = database.identity, database.topology, database.expressions, None
    if model is not None:
        errors = [entry.stored_error for entry in database.entries if entry.stored_error is not None]
        kinds = ("rms_mm", "p95_mm", "max_mm")
        expressions = {
            "faces": model.count,
            "shapes": list(model.names),
            "basis": len(model.basis),
            "core": list(model.core.shape),
            "stored_error_mm": {kind: max(getattr(error, kind) for error in errors) for kind in kinds},
        }
    spread = identity.deviations**2
    return DatabaseReport(
        version=database.version,
        tolerance_mm=database.tolerance_mm,
        topology={
            "digest": topology.digest,
            "points": topology.point_count,
            "meshes": dict(zip(topology.names, topology.points, strict=True)),
        },
        identity={
            "faces": identity.count,
            "components": len(identity.deviations),
            "deviations_mm": (identity.deviations / len(identity.mean) ** 0.5).tolist(),
            "variance_explained": (spread.cumsum() / spread.sum()).tolist(),
        },
        expressions=expressions,
        left_out=database.left_out,
        entries=database.entries,
        history=database.history,
        warnings=warnings,
    )
