"""What is in a face database, as JSON and as text."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.texts import table

if TYPE_CHECKING:
    from facepipe.processors.database import FaceDatabase

_SHARES = (0.9, 0.95, 0.99)


def as_json(path: Path, database: FaceDatabase) -> dict[str, Any]:
    """Everything but the arrays."""
    identity, model = database.identity, database.expressions
    spread = identity.deviations**2
    shares = (spread.cumsum() / spread.sum()).tolist()
    return {
        "path": str(path),
        "bytes": path.stat().st_size,
        "version": database.version,
        "units": "mm",
        "tolerance_mm": database.tolerance_mm,
        "topology": {
            "digest": database.topology.digest,
            "points": database.topology.point_count,
            "meshes": dict(zip(database.topology.names, database.topology.points, strict=True)),
        },
        "identity": {
            "faces": identity.count,
            "components": len(identity.deviations),
            "deviations_mm": (identity.deviations / len(identity.mean) ** 0.5).tolist(),  # RMS over points
            "variance_explained": shares,
        },
        "expressions": None
        if model is None
        else {
            "faces": model.count,
            "shapes": list(model.names),
            "basis": len(model.basis),
            "core": list(model.core.shape),
            "stored_error_mm": _worst(database),
        },
        "left_out": {shape: list(names) for shape, names in database.left_out.items()},
        "entries": [asdict(entry) for entry in database.entries],
        "history": [asdict(update) for update in database.history],
    }


def as_text(path: Path, database: FaceDatabase) -> str:
    """What is there, who, and how it came to be."""
    found = as_json(path, database)
    points, meshes = database.topology.point_count, len(database.topology.names)
    lines = [
        f"{path}: version {database.version}, {len(database.entries)} faces of {points:,} points "
        f"in {meshes} mesh{'es' * (meshes != 1)}, {found['bytes'] / 1e6:,.1f} MB",
        _identity(found["identity"]),
        _expressions(found["expressions"], database.tolerance_mm),
    ]
    if found["left_out"]:
        some = ", ".join(f"{shape} ({len(names)} lack it)" for shape, names in found["left_out"].items())
        lines.append(f"shapes left out: {some}")
    lines += [table(_rows(database)), *(_update(update) for update in found["history"])]
    return "\n".join(lines)


def _identity(found: dict[str, Any]) -> str:
    shares = [
        f"{share:.0%} of the variance in {1 + sum(one < share - 1e-12 for one in found['variance_explained'])}"
        for share in _SHARES
    ]
    return f"identity: {found['components']} components, {', '.join(shares)}; first deviation " + (
        f"{found['deviations_mm'][0]:.2f} mm RMS"
    )


def _expressions(found: dict[str, Any] | None, tolerance: float) -> str:
    if found is None:
        return "expressions: none"
    core, error = " x ".join(map(str, found["core"])), found["stored_error_mm"]
    return (
        f"expressions: {len(found['shapes'])} shapes of {found['faces']} faces, {found['basis']} directions, "
        f"core {core}; held to {tolerance:g} mm RMS, "
        f"worst face {error['rms_mm']:.3f} RMS, {error['max_mm']:.2f} at most"
    )


def _worst(database: FaceDatabase) -> dict[str, float]:
    errors = [entry.stored_error for entry in database.entries if entry.stored_error is not None]
    return {
        "rms_mm": max(error.rms_mm for error in errors),
        "p95_mm": max(error.p95_mm for error in errors),
        "max_mm": max(error.max_mm for error in errors),
    }


def _rows(database: FaceDatabase) -> list[list[object]]:
    rows: list[list[object]] = [["face", "from", "since version", "held to mm RMS", "surface mm", "coverage"]]
    for entry in database.entries:
        error = "no shapes" if entry.stored_error is None else f"{entry.stored_error.rms_mm:.3f}"
        quality = entry.quality
        measures = ["", ""] if quality is None else [f"{quality.surface_mean_mm:.3f}", f"{quality.coverage:.2f}"]
        rows.append([entry.name, entry.source, entry.version, error, *measures])
    return rows


def _update(update: dict[str, Any]) -> str:
    text = f"version {update['version']}: {update['verb']} {len(update['entries'])} (facepipe {update['facepipe']})"
    if update["dropped"]:
        text += f"; dropped {', '.join(update['dropped'])}"
    return text + "".join(f"; ignored: {line}" for line in update["ignored"])
