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
        meshes = len(self.topology["meshes"])
        lines = [
            f"{out}: version {self.version}, {len(self.entries)} faces of {self.topology['points']:,} points "
            f"in {meshes} mesh{'es' * (meshes != 1)}, {out.stat().st_size / 1e6:,.1f} MB",
            _identity(self.identity),
            _expressions(self.expressions, self.tolerance_mm),
        ]
        if self.left_out:
            some = ", ".join(f"{shape} ({len(names)} lack it)" for shape, names in self.left_out.items())
            lines.append(f"shapes left out: {some}")
        rows: list[list[object]] = [["face", "from", "since version", "held to mm RMS", "surface mm", "coverage"]]
        for entry in self.entries:
            error = "no shapes" if entry.stored_error is None else f"{entry.stored_error.rms_mm:.3f}"
            quality = entry.quality
            measures = ["", ""] if quality is None else [f"{quality.surface_mean_mm:.3f}", f"{quality.coverage:.2f}"]
            rows.append([entry.name, entry.source, entry.version, error, *measures])
        return "\n".join([*lines, table(rows), *map(_update, self.history)])


def report_of(database: FaceDatabase, warnings: tuple[str, ...] = ()) -> DatabaseReport:
    """What is in a database."""
    identity, topology = database.identity, database.topology
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
        expressions=_expressions_of(database),
        left_out=database.left_out,
        entries=database.entries,
        history=database.history,
        warnings=warnings,
    )


def _expressions_of(database: FaceDatabase) -> dict[str, Any] | None:
    model = database.expressions
    if model is None:
        return None
    errors = [entry.stored_error for entry in database.entries if entry.stored_error is not None]
    return {
        "faces": model.count,
        "shapes": list(model.names),
        "basis": len(model.basis),
        "core": list(model.core.shape),
        "stored_error_mm": {
            name: max(getattr(error, name) for error in errors) for name in ("rms_mm", "p95_mm", "max_mm")
        },
    }


def _identity(identity: Mapping[str, Any]) -> str:
    shares = [
        f"{share:.0%} of the variance in {1 + sum(one < share - 1e-12 for one in identity['variance_explained'])}"
        for share in _SHARES
    ]
    return f"identity: {identity['components']} components, {', '.join(shares)}; first deviation " + (
        f"{identity['deviations_mm'][0]:.2f} mm RMS"
    )


def _expressions(expressions: Mapping[str, Any] | None, tolerance: float) -> str:
    if expressions is None:
        return "expressions: none"
    core, error = " x ".join(map(str, expressions["core"])), expressions["stored_error_mm"]
    return (
        f"expressions: {len(expressions['shapes'])} shapes of {expressions['faces']} faces, "
        f"{expressions['basis']} directions, core {core}; held to {tolerance:g} mm RMS, "
        f"worst face {error['rms_mm']:.3f} RMS, {error['max_mm']:.2f} at most"
    )


def _update(update: Update) -> str:
    text = f"version {update.version}: {update.verb} {len(update.entries)} (facepipe {update.facepipe})"
    if update.dropped:
        text += f"; dropped {', '.join(update.dropped)}"
    return text + "".join(f"; ignored: {line}" for line in update.ignored)
