"""The table of blend.py."""

from __future__ import annotations

from typing import Any

from tables import aligned, mib, ms, times

Json = dict[str, Any]
Row = tuple[str, str, str, str, str, str, str]

_TIMES = (
    ("session_s", "session: read, pair, factor the neutral"),
    ("first_s", "first solve of everything"),
    ("cold_s", "cold: both"),
    ("factor_s", "  of it in factors"),
    ("neutral_s", "warm neutral"),
    ("shapes_s", "warm neutral and all shapes"),
)
_RIGHT_SIDES = (
    ("neutral_rhs_s", "a right-hand side of the neutral"),
    ("shape_rhs_s", "a right-hand side of a shape"),
)
_MEMORY = (
    ("peak_bytes", "peak memory of the cold solve"),
    ("own_bytes", "  the same over the memory after imports"),
)
_WHOLE = (
    ("open_s", "facepipe blend: open and read"),
    ("solve_s", "facepipe blend: session and solve"),
    ("author_s", "facepipe blend: measure and author"),
    ("save_s", "facepipe blend: save"),
    ("whole_s", "facepipe blend, all of it"),
)


def table(result: Json) -> str:
    """One table for people: a row a figure, the ratio always splu / facepipe; what was skipped below."""
    rows: list[Row] = [("faces", "figure", "facepipe", "splu", "ratio", "splu default", "aim")]
    for face in result["faces"]:
        rows += _rows(face, result["aims"])
    skipped = [f"skipped: {name}: {reason}" for name, reason in result["skipped"].items()]
    runs = result["runs"]
    return "\n".join([*aligned(rows), *skipped, f"best of {runs} run{'s' * (runs > 1)}, ratio = splu / facepipe"])


def _rows(face: Json, aims: Json) -> list[Row]:
    name, best, met = face["name"], face["best"], face["within_aims"]
    rows: list[Row] = []
    for key, text in (*_TIMES, *_RIGHT_SIDES, *_MEMORY):
        show = mib if (key, text) in _MEMORY else _ms2 if (key, text) in _RIGHT_SIDES else ms
        own, peer, recorded = (show(best[side][key]) for side in ("cholespy", "splu", "splu-default"))
        rows.append((name, text, own, peer, times(face["ratios"].get(key)), recorded, _aim(key, aims, met)))
    whole = best["whole"]
    rows += [_single(name, text, ms(whole[key])) for key, text in _WHOLE]
    rows += [
        _single(name, "facepipe blend: peak memory", mib(whole["peak_bytes"])),
        _single(name, "largest step at a border of moving points", f"{whole['border_step_mm']:.4f} mm"),
    ]
    if whole["jaw_open_step_mm"] is not None:
        rows.append(_single(name, "  of jawOpen", f"{whole['jaw_open_step_mm']:.4f} mm"))
    rows += [
        _single(name, f"largest difference of the solvers' {key}", f"{off:.1e} mm")
        for key, off in face["difference_mm"].items()
    ]
    ours = best["cholespy"]
    return [*rows, *(_single(name, f"holds {key}", f"{ours[key]:,.0f}") for key in ("points", "shapes"))]


def _single(name: str, text: str, value: str) -> Row:
    return name, text, value, "", "", "", ""


def _ms2(seconds: float) -> str:
    return f"{seconds * 1000:,.3f} ms"


def _aim(key: str, aims: Json, met: Json) -> str:
    """What a figure should reach, and whether it does."""
    if met.get(key) is None:
        return ""
    if key in ("neutral_rhs_s", "shape_rhs_s"):
        text = f"{aims['rhs_speedup']:g}x"
    else:
        text = f"{aims[key] / 1e6:g} MB" if key == "peak_bytes" else ms(aims[key])
    return text if met[key] else f"{text}: missed"
