"""The table of rebuild.py."""

from __future__ import annotations

from typing import Any

from tables import aligned, mib, times

Json = dict[str, Any]
Row = tuple[str, ...]
_HEADER = (
    "person",
    "side",
    "points",
    "processor",
    "ratio",
    "wall",
    "mean",
    "ratio",
    "p95",
    "narrow",
    "p95",
    "off scan",
    "memory",
)


def table(result: Json) -> str:
    """One table for people: a row a side, ratios always side / facepipe; what was skipped below."""
    rows: list[Row] = [_HEADER]
    for person in result["people"]:
        rows += _rows(str(person["seed"]), person["best"], {})
    rows += _rows("mean", result["means"], result["ratios"])
    skipped = [f"skipped: {name}: {reason}" for name, reason in result["skipped"].items()]
    legend = "true errors and distances in mm, ratio = side / facepipe"
    runs = result["runs"]
    return "\n".join([*aligned(rows), *_aims(result), *skipped, f"best of {runs} run{'s' * (runs > 1)}; {legend}"])


def _rows(name: str, sides: Json, ratios: Json) -> list[Row]:
    rows = []
    for side, one in sides.items():
        ratio = ratios.get(side, {})
        rows.append(
            (
                name,
                side,
                f"{one['points']:,.0f}",
                f"{one['processor_s']:,.1f} s",
                times(ratio.get("processor_s")),
                f"{one['wall_s']:,.1f} s",
                f"{one['mean_mm']:.3f}",
                times(ratio.get("mean_mm")),
                f"{one['p95_mm']:.2f}",
                f"{one['narrow_mean_mm']:.3f}",
                f"{one['narrow_p95_mm']:.2f}",
                f"{one['surface_mm']:.3f}",
                mib(one.get("peak_bytes")),
            )
        )
    return rows


def _aims(result: Json) -> list[str]:
    """Which peers are met by what they should be."""
    lines = []
    for key, text in (("processor_s", "time"), ("mean_mm", "mean error")):
        peers = {side: ratio[key] for side, ratio in result["ratios"].items() if side.startswith("nricp")}
        missed = [f"{side} {ratio:.1f}x" for side, ratio in peers.items() if ratio < result["aims"][key]]
        if peers:
            verdict = f"missed against {', '.join(missed)}" if missed else "met"
            lines.append(f"aim, {text} of peers {result['aims'][key]:g}x ours or more: {verdict}")
    return lines
