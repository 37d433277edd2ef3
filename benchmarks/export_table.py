"""The table of export_gltf.py."""

from __future__ import annotations

from typing import Any

from tables import aligned, mib, ms, times

Json = dict[str, Any]
Row = tuple[str, str, str, str, str]

_TIMES = (
    ("load_s", "open and read the stage"),
    ("load_export_s", "read and export, same settings"),
)
_EXPORT = (
    ("export_s", "first of the process"),
    ("export_cpu_s", "first, processor time"),
    ("again_s", "warm"),
    ("again_cpu_s", "warm, processor time"),
)
_SETTINGS = (
    ("facepipe", "blender", "export call, same settings"),  # no normals in targets on either side
    ("facepipe_normals", "blender_normals", "export call, both with normals in targets"),
    ("facepipe", "blender_defaults", "export call, Blender's defaults"),  # with normals in targets, only Blender's
)
_MEMORY = (
    ("peak_bytes", "peak memory of read and export"),
    ("own_bytes", "  the same over the memory after imports"),
)
_COUNTS = ("meshes", "vertices", "triangles", "targets", "shapes", "joints")


def table(result: Json) -> str:
    """One table for people: a row a figure, the ratio always Blender / facepipe; what was skipped below."""
    theirs = next((face["median"]["blender"]["version"] for face in result["faces"] if "ratios" in face), "")
    rows: list[Row] = [("face", "figure", "facepipe", f"Blender {theirs}".strip(), "ratio")]
    for face in result["faces"]:
        rows += _rows(face)
    lines = aligned(rows) if result["faces"] else []
    lines += [f"skipped: {name}: {reason}" for name, reason in result["skipped"].items()]
    aim = result["aim"]["export_speedup"]
    runs = result["runs"]
    return "\n".join(
        [*lines, f"median of {runs} run{'s' * (runs > 1)}, ratio = Blender / facepipe, aim {aim:g} for exports"]
    )


def _rows(face: Json) -> list[Row]:
    name = face["name"]
    median, ratios = face["median"], face.get("ratios", {})
    ours, theirs = median["facepipe"], median.get("blender", {})
    matched = ratios.get("blender", {})
    rows = [
        (name, "import: source to arrays", ms(median["import"]["read_s"]), "", ""),
        (name, "import: arrays to a saved stage", ms(median["import"]["save_s"]), "", ""),
        (name, "peak memory of the import", mib(median["import"]["peak_bytes"]), "", ""),
    ]
    rows += [(name, text, ms(ours[key]), ms(theirs.get(key)), times(matched.get(key))) for key, text in _TIMES]
    for own, side, settings in _SETTINGS:
        other, ratio = median.get(side, {}), ratios.get(side, {})
        if other or side != "blender_defaults":
            rows += [
                (name, f"{settings}: {text}", ms(median[own][key]), ms(other.get(key)), times(ratio.get(key)))
                for key, text in _EXPORT
            ]
    rows += [(name, text, mib(ours[key]), mib(theirs.get(key)), times(matched.get(key))) for key, text in _MEMORY]
    return rows + _sizes(face) + _evidence(face)


def _sizes(face: Json) -> list[Row]:
    name, ours, theirs = face["name"], face["sizes"]["facepipe"], face["sizes"].get("blender", {})
    rows = [
        (name, f"GLB {key}{note}", _bytes(ours[key]), _bytes(theirs.get(key)), _over(theirs.get(key), ours[key]))
        for key, note in (("dense", " (facepipe's computed)"), ("sparse", ""), ("quantised", ""))
    ]
    errors = [(key, ours["error_mm"][key]) for key in ("sparse", "quantised")]
    return rows + [(name, f"  error it states, {key}", f"{mm:.4f} mm", "", "") for key, mm in errors if mm is not None]


def _evidence(face: Json) -> list[Row]:
    """What both files hold: figures are worth something where it is the same."""
    name, ours, theirs = face["name"], face["content"]["facepipe"], face["content"].get("blender")
    rows = [(name, f"holds {key}", f"{ours[key]:,}", f"{theirs[key]:,}" if theirs else "", "") for key in _COUNTS]
    if theirs is None:
        return rows
    unlike = face["differences"]
    rows.append(
        (name, "same mesh by mesh, target by target", "no: " + "; ".join(unlike[:2]) if unlike else "yes", "", "")
    )
    off = face["target_reach_difference_mm"]
    if off is not None:
        rows.append((name, "largest difference of a target's reach", f"{off:.6f} mm", "", ""))
    return rows


def _bytes(count: int | None) -> str:
    return "" if count is None else f"{count:,} B"


def _over(theirs: float | None, ours: float) -> str:
    return times(None if theirs is None else theirs / ours)
