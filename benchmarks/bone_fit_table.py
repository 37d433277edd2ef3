"""The table of bone_fit.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tables import aligned, ms, times

Json = dict[str, Any]
Row = tuple[str, ...]

_PEER, _DEFAULT = "dem-bones", "dem-bones-default"
_HEAD = ("bones", "figure", "facepipe", "evened", "py-dem-bones", "its defaults", "scipy", "ratio", "evened", "aim")
_BOUNDS = {
    "bones": "9 DOF, least squares",
    "bones-mean": "9 DOF, least mean",
    "affine": "free affine bones, least squares",
    "affine-mean": "free affine bones, least mean",
}
_BOUND_HEAD = ("bones", "how near they come", "mean", "RMS", "largest", "mean / py-dem-bones", "largest / py-dem-bones")


def table(result: Json) -> str:
    """One table for people: a row a figure, ratios always facepipe / py-dem-bones; what was skipped below."""
    rows: list[Row] = [_HEAD]
    for task in result["tasks"]:
        rows += _rows(task, result["aims"])
    bounds = [row for task in result["tasks"] if task["bound"] is not None for row in _bounds(task)]
    skipped = [f"skipped: {name}: {reason}" for name, reason in result["skipped"].items()]
    made, runs = result["tasks"][0], result["runs"]
    note = f"{result['face']}: {made['points']} points, {made['targets']} targets, {made['influences']} influences"
    lines = [*aligned(rows), *skipped]
    lines.append(f"{note}; best of {runs} run{'s' * (runs > 1)}, processor time, ratio = facepipe / py-dem-bones")
    return "\n".join([*lines, "", *aligned([_BOUND_HEAD, *bounds])] if bounds else lines)


def _rows(task: Json, aims: Json) -> list[Row]:
    name = f"{task['joints']} joints, {task['dof']} DOF"
    nine, single = task["dof"] == 9, task["joints"] <= 60  # whom the aims are for
    error, whole_aim = (aims["error"], aims["set"]) if nine else (None, None)
    cold, warm = (aims["cold_s"], aims["warm_s"]) if single else (None, None)
    errors = [
        _row(name, "mean error", "mean_mm", task, mm, error),
        _row(name, "largest error", "max_mm", task, mm, error),
        _row(name, "  of a target, mean", "mean_of_max_mm", task, mm, None),
    ]
    whole = [
        _row(name, f"all {task['targets']} targets", "set_s", task, ms, whole_aim),
        _row(name, "  wall time", "set_wall_s", task, ms, None),
    ]
    singles = [
        _single(name, "a fit from rest, median", "cold_s", task, cold),
        _single(name, "  slowest", "cold_slowest_s", task, None),
        _single(name, "a fit from the frame before, median", "warm_s", task, warm),
        _single(name, "  slowest", "warm_slowest_s", task, None),
    ]
    return [*errors, *whole, *singles, *_scipy(name, task, aims)]


def _row(name: str, text: str, key: str, task: Json, show: Callable[[float | None], str], aim: float | None) -> Row:
    """A figure that the peer has too."""
    best, ratios = task["best"], task["ratios"].get(_PEER)
    cells = [show(best.get(side, {}).get(key)) for side in ("plain", "even", _PEER, _DEFAULT)]
    own = [None if ratios is None else ratios[side].get(key) for side in ("plain", "even")]
    known = [one for one in own if one is not None]
    met = "" if aim is None or not known else f"{aim:g}x" + ("" if min(known) <= aim else ": missed")
    scipy = "" if key != "set_s" or task["scipy"] is None else f"({show(task['scipy'][key])})"
    return name, text, *cells, scipy, *(times(one) for one in own), met


def _single(name: str, text: str, key: str, task: Json, aim: float | None) -> Row:
    best = task["best"]
    own = best["plain"][key]
    met = "" if aim is None else ms(aim) + ("" if own <= aim else ": missed")
    return name, text, ms(own), ms(best["even"].get(key)), "", "", "", "", "", met


def _scipy(name: str, task: Json, aims: Json) -> list[Row]:
    scipy = task["scipy"]
    if scipy is None:
        return []
    ratios, count = task["ratios"]["scipy"], scipy["targets"]
    met = f"{aims['scipy']:g}x"
    rows: list[Row] = []
    for text, own, key in (
        (f"the {count} hardest targets, from rest: scipy / facepipe", scipy["ours_cold_s"], "cold"),
        ("one boxed linear system: scipy / facepipe", task["linear_s"], "linear"),
    ):
        missed = "" if ratios[key] >= aims["scipy"] else ": missed"
        rows.append((name, text, ms(own), "", "", "", ms(scipy[f"{key}_s"]), times(ratios[key]), "", met + missed))
    rms = (mm(scipy["ours"]["rms_mm"]), "", "", "", mm(scipy["rms_mm"]))
    return [*rows, (name, "  RMS error of these targets", *rms, "", "", "")]


def _bounds(task: Json) -> list[Row]:
    bound, peer, name = task["bound"], task["best"].get(_PEER), f"{task['joints']} joints"
    rows = []
    for side, text in _BOUNDS.items():
        errors = bound["sides"][side]
        ratios = [None if peer is None else errors[key] / peer[key] for key in ("mean_mm", "max_mm")]
        rows.append((name, text, *(mm(errors[f"{key}_mm"]) for key in ("mean", "rms", "max")), *map(times, ratios)))
    least = bound["least_mean_mm"]
    ratio = None if peer is None else least / peer["mean_mm"]
    return [*rows, (name, "no bones go below", mm(least), "", "", times(ratio), "")]


def mm(value: float | None) -> str:
    """Millimetres."""
    return "" if value is None else f"{value:.4f} mm"
