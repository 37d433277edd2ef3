"""Captured clips as other programs write them, drawn by seed, each with what it means: names, times and values.

The values are those that stand in the file, rounded as it has them; nothing here knows how facepipe reads.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.verbs.animate import Performance

Array = np.ndarray[Any, np.dtype[Any]]
SHAPES = [
    "browDownLeft",
    "browDownRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "eyeBlinkLeft",
    "eyeBlinkRight",
    "eyeLookDownLeft",
    "eyeLookDownRight",
    "eyeLookInLeft",
    "eyeLookInRight",
    "eyeLookOutLeft",
    "eyeLookOutRight",
    "eyeLookUpLeft",
    "eyeLookUpRight",
    "eyeSquintLeft",
    "eyeSquintRight",
    "eyeWideLeft",
    "eyeWideRight",
    "jawForward",
    "jawLeft",
    "jawOpen",
    "jawRight",
    "mouthClose",
    "mouthDimpleLeft",
    "mouthDimpleRight",
    "mouthFrownLeft",
    "mouthFrownRight",
    "mouthFunnel",
    "mouthLeft",
    "mouthLowerDownLeft",
    "mouthLowerDownRight",
    "mouthPressLeft",
    "mouthPressRight",
    "mouthPucker",
    "mouthRight",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthStretchLeft",
    "mouthStretchRight",
    "mouthUpperUpLeft",
    "mouthUpperUpRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
]
HEAD = ["HeadYaw", "HeadPitch", "HeadRoll"]
TURNS = [*HEAD, *(f"{eye}Eye{angle}" for eye in ("Left", "Right") for angle in ("Yaw", "Pitch", "Roll"))]
# the order of Azure's 55 numbers, as Microsoft's page on visemes has it
AZURE = [
    "eyeBlinkLeft",
    "eyeLookDownLeft",
    "eyeLookInLeft",
    "eyeLookOutLeft",
    "eyeLookUpLeft",
    "eyeSquintLeft",
    "eyeWideLeft",
    "eyeBlinkRight",
    "eyeLookDownRight",
    "eyeLookInRight",
    "eyeLookOutRight",
    "eyeLookUpRight",
    "eyeSquintRight",
    "eyeWideRight",
    "jawForward",
    "jawLeft",
    "jawRight",
    "jawOpen",
    "mouthClose",
    "mouthFunnel",
    "mouthPucker",
    "mouthLeft",
    "mouthRight",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthFrownLeft",
    "mouthFrownRight",
    "mouthDimpleLeft",
    "mouthDimpleRight",
    "mouthStretchLeft",
    "mouthStretchRight",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "mouthPressLeft",
    "mouthPressRight",
    "mouthLowerDownLeft",
    "mouthLowerDownRight",
    "mouthUpperUpLeft",
    "mouthUpperUpRight",
    "browDownLeft",
    "browDownRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
    "HeadRoll",
    "LeftEyeRoll",
    "RightEyeRoll",
]
# which of Oculus's visemes Azure's ids sound like, after the phonemes of both pages; several where a sound is between
SOUNDS = """
sil | aa E | aa O | O aa | E U | RR | I | U | O U | aa U | O I
 | aa I | kk sil aa E | RR | nn DD | SS | CH | TH | FF | DD TH nn | kk | PP
""".replace("\n", "").split(" | ")


@dataclass
class Clip:
    """A file and what it means."""

    path: Path
    names: Sequence[str]
    seconds: Array  # (k,) of the rows, NaN rows included
    values: Array  # (k, names), NaN where nothing was tracked
    off: float = 1e-4  # seconds that a time of the file may be off by rounding
    rate: float = 30.0
    said: str = ""  # what a line must name, as it can't be read
    beside: Sequence[str] = ()  # columns that are no weights
    what: dict[str, Any] = field(default_factory=dict)  # what was drawn, for people

    def differences(self, read: Performance) -> list[tuple[str, str]]:
        """(subject, figure) of each thing that a performance has otherwise."""
        found = []
        if self.said and not any(self.said in line for line in read.warnings):
            found.append(("unsaid", self.said))
        columns = {_plain(name): column for name, column in zip(read.names, read.values.T, strict=True)}
        known = {_plain(name): name for name in self.names}
        some = [i for i in range(len(self.names)) if np.isfinite(self.values[:, i]).any()]
        lost = [self.names[i] for i in some if _plain(self.names[i]) not in columns and self.values[:, i].any()]
        beside = {_plain(name) for name in self.beside}
        more = [name for key, name in zip(columns, read.names, strict=True) if key not in {*known, *beside}]
        if lost:
            found.append(("names", f"{len(lost)} names lost: {' '.join(lost[:4])}"))
        if more:
            found.append(("names", f"{len(more)} names more: {' '.join(more[:4])}"))
        span = float(self.seconds[-1] - self.seconds[0])
        if abs(read.seconds[-1] - span) > 0.6 / self.rate + self.off:
            found.append(("time", f"{read.seconds[-1]:.4g} s long, expected {span:.4g}"))
        if read.fps < 0.7 * self.rate:
            found.append(("time", f"{read.fps:g} fps, expected {self.rate:g}"))
        worst = (0.0, "")
        at = self.seconds[0] + read.seconds
        for i in some:
            name, here = self.names[i], np.isfinite(self.values[:, i])
            column = columns.get(_plain(name))
            if column is None:
                continue
            turn = name in TURNS
            own = np.unwrap(self.values[here, i]) if turn else self.values[here, i]
            slope = np.abs(np.diff(own) / np.maximum(np.diff(self.seconds[here]), 1e-9)).max(initial=0.0)
            off = np.abs(column - np.interp(at, self.seconds[here], own))
            off = np.minimum(off, np.abs(2 * np.pi - off)) if turn else off
            over = float(off.max() - slope * self.off)
            worst = max(worst, (over, f"{name} at {read.seconds[int(off.argmax())]:.3f} s"))
        if worst[0] > 3e-4:
            found.append(("values", f"{worst[1]} off by {worst[0]:.3g}"))
        return found


def _plain(name: str) -> str:
    """A name whatever its case, and with its side as a word."""
    whole = re.sub(r"_([LR])$", lambda side: {"L": "left", "R": "right"}[side[1]], name)
    return re.sub(r"[^a-z0-9]", "", whole.casefold()).removeprefix("blendshapes")


def waves(rng: np.random.Generator, count: int, names: Sequence[str], fps: float) -> Array:
    """(count, names) smooth values of a clip: weights from 0 to 1, turns up to 0.5 rad."""
    at = np.arange(count)[:, None] / fps
    values = 0.5 + 0.5 * np.sin(at * rng.uniform(0.5, 5.0, len(names)) + rng.uniform(0, 6.28, len(names)))
    turning = np.array([name in TURNS for name in names])
    values[:, turning] = values[:, turning] - 0.5
    return values


def _any(rng: np.random.Generator, *choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _yes(rng: np.random.Generator, share: float = 0.5) -> bool:
    return bool(rng.random() < share)


def _shapes(rng: np.random.Generator) -> list[str]:
    """Most of ARKit's shapes in any order."""
    names = [SHAPES[i] for i in rng.permutation(len(SHAPES))] if _yes(rng) else list(SHAPES)
    return names[: int(rng.integers(40, 53))] if _yes(rng, 0.3) else names


def _spelt(rng: np.random.Generator, names: Sequence[str]) -> list[str]:
    way = rng.integers(3)
    if way == 0:
        return [name[0].upper() + name[1:] for name in names]
    if way == 1:
        return list(names)
    return [re.sub("(Left|Right)$", lambda side: f"_{side[0][0]}", n) if n not in TURNS else n for n in names]


def _write_table(
    rng: np.random.Generator,
    path: Path,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    delimiters: str = ",;\t|",
) -> dict[str, Any]:
    """Rows of texts as some program would write them: delimiter, decimal sign, quotes, ends of lines, encoding."""
    delimiter = _any(rng, *delimiters)
    comma = len(delimiters) > 1 and _yes(rng)
    quoted, trailing = (comma and delimiter == ",") or _yes(rng, 0.3), _yes(rng, 0.25)
    end, encoding = _any(rng, "\n", "\r\n"), _any(rng, "utf-8", "utf-8", "utf-8-sig", "utf-16")
    lines = []
    for number, cells in enumerate([header, *rows]):
        texts = [
            one.replace(".", ",") if comma and number and re.fullmatch(r"-?\d*\.\d+(e-?\d+)?", one) else one
            for one in cells
        ]
        texts = [f'"{one}"' for one in texts] if quoted else list(texts)
        lines.append(delimiter.join(texts) + (delimiter if trailing else ""))
    text = end.join(lines) + (end if _yes(rng, 0.7) else "")
    path.write_bytes(text.encode(encoding))
    return {"delimiter": delimiter, "comma": comma, "quoted": quoted, "trailing": trailing, "encoding": encoding}


def _with_gaps(rng: np.random.Generator, count: int) -> Array:
    """Numbers of the frames that were kept: the first and last and most between."""
    kept = np.ones(count, bool)
    for _ in range(int(rng.integers(1, 4))):
        start = int(rng.integers(5, count - 20))
        kept[start : start + int(rng.integers(1, 12))] = False
    return np.flatnonzero(kept)


def _lost(rng: np.random.Generator, values: Array, *, edges: bool = True) -> None:
    """Frames without a face: within, sometimes at an end."""
    start = int(rng.integers(2, len(values) - 12))
    values[start : start + int(rng.integers(1, 8))] = np.nan
    if edges and _yes(rng, 0.4):
        values[: int(rng.integers(1, 9))] = np.nan


def live_link(rng: np.random.Generator, folder: Path) -> Clip:
    """A recording of Live Link Face whose timecodes count frames."""
    fps = int(_any(rng, 24, 25, 30, 50, 60, 60))
    step = 2 if fps in (50, 60) and _yes(rng, 0.25) else 1
    count = int(rng.integers(2 * fps, 4 * fps)) // step
    names = [*_shapes(rng), *_any(rng, TURNS, HEAD, [], TURNS)]
    values = np.round(waves(rng, count, names, fps / step), 5)
    kept = _with_gaps(rng, count) if _yes(rng, 0.4) else np.arange(count)
    values = values[kept]
    empty = _any(rng, None, "cells", "count")
    if empty:
        _lost(rng, values)
    first = int(rng.integers(0, 86400 * fps - 1)) if _yes(rng, 0.7) else 86400 * fps - count // 2
    sub = _any(rng, "", ".000", ".250", ".5")
    rows = []
    for place, number in enumerate(kept):
        second, frame = divmod(first + int(number) * step, fps)
        second %= 86400
        code = f"{second // 3600:02}:{second // 60 % 60:02}:{second % 60:02}:{frame:02}{sub}"
        gone = bool(np.isnan(values[place]).all())
        cells = ["" if np.isnan(v) else f"{v:.5f}" for v in values[place]]
        if gone and empty == "count":
            cells = ["0.00000"] * len(names) if _yes(rng) else cells
        rows.append([code, "0" if gone and empty == "count" else str(len(names)), *cells])
    header = ["Timecode", "BlendShapeCount", *_spelt(rng, names)]
    what = _write_table(rng, folder / "take.csv", header, rows, ",")
    what |= {"fps": fps, "step": step, "empty": empty, "first": first}
    return Clip(folder / "take.csv", names, kept * step / fps, values, 0.02 / fps, fps / step, what=what)


def drop_frame(rng: np.random.Generator, folder: Path) -> Clip:
    """More than ten minutes of drop frame timecode; the labels are counted up one by one, as SMPTE ST 12-1 says."""
    nominal = int(_any(rng, 30, 60))
    names = list(rng.choice(SHAPES, 3, replace=False))
    hour, minute, second, frame = int(rng.integers(0, 24)), int(rng.integers(0, 60)), int(rng.integers(0, 60)), 5
    labels = []
    for _ in range(nominal * int(rng.integers(605, 700))):
        labels.append(f"{hour:02}:{minute:02}:{second:02};{frame:02}")
        frame += 1
        if frame == nominal:
            frame, second = 0, second + 1
        if second == 60:
            second, minute = 0, minute + 1
            frame = 0 if minute % 10 == 0 else nominal // 15
        if minute == 60:
            minute, hour = 0, (hour + 1) % 24
    values = np.round(waves(rng, len(labels), names, nominal), 4)
    rows = [[code, "52", *(f"{v:.4f}" for v in row)] for code, row in zip(labels, values, strict=True)]
    what = _write_table(rng, folder / "take.csv", ["Timecode", "BlendShapeCount", *names], rows, ",")
    rate = nominal * 1000 / 1001
    return Clip(
        folder / "take.csv",
        names,
        np.arange(len(labels)) / rate,
        values,
        0.02 / rate,
        rate,
        what=what | {"of": nominal},
    )


def timecode_times(rng: np.random.Generator, folder: Path) -> Clip:
    """Timecodes that end in milliseconds, or in a fraction of a second."""
    fps = float(_any(rng, 24, 25, 30, 60))
    count = int(rng.integers(60, 200))
    names = [*_shapes(rng), *_any(rng, TURNS, [])]
    values = np.round(waves(rng, count, names, fps), 5)
    fraction = _yes(rng)
    start = int(rng.integers(0, 80000)) + float(rng.random())
    rows = []
    for i in range(count):
        milli = int(np.floor((start + i / fps) * 1000 + 1e-6))
        second, milli = divmod(milli, 1000)
        code = f"{second // 3600:02}:{second // 60 % 60:02}:{second % 60:02}"
        code += f".{milli:03}" if fraction else f":{milli:03}" + _any(rng, "", ".125")
        rows.append([code, str(len(names)), *(f"{v:.5f}" for v in values[i])])
    what = _write_table(rng, folder / "take.csv", ["Timecode", "BlendShapeCount", *_spelt(rng, names)], rows, ",")
    return Clip(
        folder / "take.csv", names, np.arange(count) / fps, values, 2.2e-3, fps, what=what | {"fraction": fraction}
    )


def table(rng: np.random.Generator, folder: Path) -> Clip:
    """Any table: units of time, of weights and of turns, jitter, gaps."""
    fps = float(_any(rng, 15, 24, 25, 30, 30, 60, 120))
    count = int(rng.integers(60, 240))
    names = [*_shapes(rng), *_any(rng, TURNS, HEAD, [])]
    values = waves(rng, count, names, fps)
    seconds = np.arange(count) / fps
    jitter = _yes(rng, 0.4)
    if jitter:
        seconds = seconds + rng.uniform(-0.3, 0.3, count) / fps
    if _yes(rng, 0.3):
        kept = _with_gaps(rng, count)
        values, seconds = values[kept], seconds[kept]
    unit = _any(rng, "s", "ms", "us", "ns")
    since = float(_any(rng, 0.0, 12.0, 1.7e9 + int(rng.integers(1e6))))
    header = {
        "s": _any(rng, "Time", "timestamp", "seconds", "time (s)"),
        "ms": _any(rng, "timestamp_ms", "time", "Timestamp", "time_ms"),
        "us": _any(rng, "timestamp_us", "timestamp", "time"),
        "ns": _any(rng, "timestamp_ns", "timestamp", "time"),
    }[unit]
    scale = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    seconds = seconds - seconds[0]
    clocks = [
        f"{since + t:.6f}" if unit == "s" else str(int(since) * int(scale) + int(np.floor(t * scale))) for t in seconds
    ]
    percent, degrees = _yes(rng, 0.3), _yes(rng, 0.3)
    turning = np.array([name in TURNS for name in names])
    stored = values.copy()
    if percent:
        stored[:, ~turning] *= 100
    if degrees:
        small = 0.08 if _yes(rng, 0.3) else 1.0  # so small that they might be radians
        stored[:, turning] = np.degrees(small * stored[:, turning])
    stored = np.round(stored, 5)
    values = stored.copy()
    if percent:
        values[:, ~turning] /= 100
    if degrees:
        values[:, turning] = np.radians(values[:, turning])
    rows = [[clock, *(f"{v:.5f}" for v in row)] for clock, row in zip(clocks, stored, strict=True)]
    columns = [header, *_spelt(rng, names)]
    if _yes(rng, 0.3):
        columns, rows = ["frame", *columns], [[str(i), *row] for i, row in enumerate(rows)]
    beside = {"fps": "25", "confidence": "0.9", "faceId": "0", "quality": "88"} if _yes(rng, 0.3) else {}
    columns, rows = [*columns, *beside], [[*row, *beside.values()] for row in rows]
    path = folder / _any(rng, "take.csv", "take.tsv", "take.txt")
    what = _write_table(rng, path, columns, rows)
    what |= {
        "unit": unit,
        "header": header,
        "since": since,
        "jitter": jitter,
        "percent": percent,
        "degrees": degrees,
        "fps": fps,
    }
    # floats of seconds since 1970 hold microseconds
    off = 2.2e-3 if unit == "ms" else max(2e-6, 0.022 / fps if not jitter else 0.011 / fps)
    return Clip(path, names, seconds, values, off, fps, beside=[*beside], what=what)


def audio2face_table(rng: np.random.Generator, folder: Path) -> Clip:
    """`animation_frames.csv` of Audio2Face's client."""
    fps, count = float(_any(rng, 30, 60)), int(rng.integers(40, 150))
    names = _shapes(rng)
    values = np.round(waves(rng, count, names, fps), 6)
    header = ["", "timeCode", *(f"blendShapes.{name[0].upper() + name[1:]}" for name in names)]
    start = float(_any(rng, 0.0, 1.5))
    rows = [[str(i), f"{start + i / fps:.9g}", *(f"{v:.6f}" for v in row)] for i, row in enumerate(values)]
    what = _write_table(rng, folder / "take.csv", header, rows, ",")
    return Clip(folder / "take.csv", names, np.arange(count) / fps, values, 0.02 / fps, fps, what=what)


def media_pipe_table(rng: np.random.Generator, folder: Path) -> Clip:
    """A web page's log of MediaPipe: whole milliseconds of a webcam, frames without a face."""
    fps, count = float(_any(rng, 24, 30)), int(rng.integers(60, 200))
    names = _shapes(rng)
    values = np.round(waves(rng, count, names, fps), 6)
    seconds = np.arange(count) / fps + rng.uniform(-0.008, 0.008, count) * _yes(rng)
    milli = np.rint((seconds - seconds[0]) * 1000).astype(int) + int(_any(rng, 0, 48211))
    if _yes(rng):
        _lost(rng, values, edges=False)
    rows = [
        [str(i), str(at), *("" if np.isnan(v) else f"{v:.6f}" for v in row)]
        for i, (at, row) in enumerate(zip(milli, values, strict=True))
    ]
    what = _write_table(rng, folder / "take.csv", ["frame", "timestamp_ms", *names], rows, ",")
    return Clip(folder / "take.csv", names, (milli - milli[0]) / 1000, values, 1.3e-3, fps, what=what)


def turn_matrix(yaw: float, pitch: float, roll: float) -> Array:
    """Yaw to the person's own right, pitch down, roll to the left shoulder, each about the axes turned before; Y up."""

    def about(axis: int, angle: float) -> Array:
        c, s, a, b = np.cos(angle), np.sin(angle), (axis + 1) % 3, (axis + 2) % 3
        made = np.eye(3)
        made[a, a] = made[b, b] = c
        made[b, a], made[a, b] = s, -s
        return made

    return about(1, -yaw) @ about(0, pitch) @ about(2, -roll)


def media_pipe(rng: np.random.Generator, folder: Path) -> Clip:
    """FaceLandmarkerResults in JSON: of the web or of Python, faces beside, matrices by rows or columns."""
    fps, count = float(_any(rng, 25, 30)), int(rng.integers(40, 120))
    python, times, turning = _yes(rng), _yes(rng, 0.7), _yes(rng, 0.7)
    names = [*SHAPES, *(HEAD if turning else [])]
    values = waves(rng, count, names, fps)
    by_columns, size = _yes(rng), float(rng.uniform(0.8, 1.3))
    seconds = np.arange(count) / (fps if times else 30.0)
    if times and _yes(rng):
        seconds = np.sort(seconds + rng.uniform(-0.008, 0.008, count))
    milli = np.rint((seconds - seconds[0]) * 1000).astype(int)
    gone = set(rng.choice(np.arange(1, count - 1), int(rng.integers(0, 5)), replace=False).tolist())
    several = _yes(rng, 0.4)
    frames = []
    for i in range(count):
        placed = np.eye(4)
        if turning:
            placed[:3, :3] = size * turn_matrix(*values[i, 52:55])
        placed[:3, 3] = rng.normal(size=3) * 20
        flat = (placed.T if by_columns else placed).ravel().tolist()
        faces = [[*zip(SHAPES, values[i, :52].tolist(), strict=True)]] if i not in gone else []
        faces += [[(name, float(rng.random())) for name in SHAPES]] if several and i % 3 == 0 and faces else []
        # a second face of which only the first is the person: MediaPipe keeps the order of its faces
        held: list[Any] = []
        for number, face in enumerate(faces):
            key = ("category_name", "categoryName")[not python]
            entries = [{"index": j, "score": v, key: n} for j, (n, v) in enumerate([("_neutral", 1e-6), *face])]
            held.append(entries if python else {"categories": entries, "headIndex": number})
        frame: dict[str, Any] = {("faceBlendshapes", "face_blendshapes")[python]: held}
        if turning:
            own = placed.tolist() if python else {"rows": 4, "columns": 4, "data": flat}
            second = np.eye(4).tolist() if python else {"rows": 4, "columns": 4, "data": np.eye(4).ravel().tolist()}
            key = ("facialTransformationMatrixes", "facial_transformation_matrixes")[python]
            frame[key] = [own, second][: len(faces)]
        if times:
            frame[_time_key(python)] = int(milli[i]) + 3000
        frames.append(frame)
        if i in gone:
            values[i] = np.nan
    path = folder / "take.json"
    if _yes(rng, 0.4):
        path = folder / "take.jsonl"
        path.write_text("\n".join(map(json.dumps, frames)) + "\n")
    else:
        path.write_text(json.dumps(frames if _yes(rng) else {"results": frames}))
    what = {"python": python, "columns": by_columns, "times": times, "gone": sorted(gone), "several": several}
    return Clip(
        path,
        names,
        milli / 1000 if times else seconds,
        values,
        2.3e-3 if times else 1e-4,
        fps if times else 30.0,
        what=what,
    )


def _time_key(python: bool) -> str:
    return "timestamp_ms" if python else "timestampMs"


def audio2face(rng: np.random.Generator, folder: Path) -> Clip:
    """What Audio2Face exports as JSON."""
    fps, count = float(_any(rng, 24, 30, 60)), int(rng.integers(30, 100))
    names = _shapes(rng)
    values = np.round(waves(rng, count, names, fps), 6)
    whole = {"exportFps": fps, "trackPath": "C:/a.wav", "numPoses": len(names), "numFrames": count, "facsNames": names,
             "weightMat": values.tolist()}  # fmt: skip
    (folder / "take.json").write_text(json.dumps(whole))
    return Clip(folder / "take.json", names, np.arange(count) / fps, values, 1e-4, fps)


def azure(rng: np.random.Generator, folder: Path) -> Clip:
    """Chunks of 55 numbers at 60 fps in any order, some of them missing."""
    count = int(rng.integers(60, 200))
    values = np.round(waves(rng, count, AZURE, 60.0), 4)
    cuts = np.unique([0, *rng.integers(1, count, 5).tolist(), count])
    chunks = [*zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)]
    kept = np.ones(count, bool)
    if _yes(rng, 0.3) and len(chunks) > 3:
        a, b = chunks.pop(1)
        kept[a:b] = False
    order = rng.permutation(len(chunks)) if _yes(rng, 0.6) else np.arange(len(chunks))
    text = _yes(rng)
    events: list[Any] = []
    for i in order:
        a, b = chunks[i]
        chunk: Any = {"FrameIndex": a, "BlendShapes": values[a:b].tolist()}
        events.append({"audioOffset": a * 166667, "visemeId": 0, "animation": json.dumps(chunk)} if text else chunk)
        if text and _yes(rng, 0.5):
            events.append({"audioOffset": a * 166667, "visemeId": int(rng.integers(22)), "animation": ""})
    path = folder / "take.json"
    if _yes(rng, 0.3):
        path = folder / "take.jsonl"
        path.write_text("\n".join(map(json.dumps, events)))
    else:
        path.write_text(json.dumps(events))
    return Clip(
        path, AZURE, np.flatnonzero(kept) / 60, values[kept], 1e-4, 60.0, what={"text": text, "chunks": len(chunks)}
    )


def talking_head(rng: np.random.Generator, folder: Path) -> Clip:
    """Keys of TalkingHead: even as frames are, or far apart."""
    count, even = int(rng.integers(8, 60)), _yes(rng)
    names = list(rng.choice(SHAPES, 8, replace=False))
    steps = np.full(count, int(_any(rng, 33, 40))) if even else rng.integers(20, 400, count)
    if even and _yes(rng):
        steps = np.where(np.arange(count) % 3 == 0, 34, 33)
    values = np.round(rng.random((count, len(names))), 4)
    whole: dict[str, Any] = {"dt": steps.tolist(), "vs": dict(zip(names, values.T.tolist(), strict=True))}
    whole = {"name": "wave", **whole} if _yes(rng) else whole
    (folder / "take.json").write_text(json.dumps(whole))
    seconds = np.cumsum(steps) / 1000
    return Clip(folder / "take.json", names, seconds, values, 1.1e-3, 25.0 if even else 2.0, what={"even": even})


def arkit(rng: np.random.Generator, folder: Path) -> Clip:
    """ARKit's weights in JSON, with times, a rate, or neither."""
    fps, count = float(_any(rng, 24, 30, 60)), int(rng.integers(40, 120))
    names = [*_shapes(rng), *_any(rng, HEAD, [])]
    values = np.round(waves(rng, count, names, fps), 5)
    clock = _any(rng, "fps", "time", "timestamp_ms", "timestamp since 1970", "timecode", "none")
    fps = 60.0 if clock == "none" else fps
    beside = _yes(rng, 0.3)
    since, way, lost = 1.7e12 + int(rng.integers(1e6)), int(rng.integers(3)), _yes(rng, 0.3)
    frames = []
    for i, row in enumerate(values):
        own = {n: float(v) for n, v in zip(names, row, strict=True)}
        weights = {n: v for n, v in own.items() if n not in TURNS}
        turns = {n: v for n, v in own.items() if n in TURNS}
        frame: dict[str, Any] = {
            0: {"blendShapes": weights, **turns},
            1: {"weights": [{"categoryName": n, "score": v} for n, v in weights.items()], **turns},
            2: own,
        }[way]
        if clock == "time":
            frame["time"] = round(i / fps, 6)
        elif clock == "timestamp_ms":
            frame["timestamp_ms"] = round(i * 1000 / fps)
        elif clock == "timestamp since 1970":
            frame["timestamp"] = since + round(i * 1000 / fps)
        elif clock == "timecode":
            second, number = divmod(i, int(fps))
            frame["timecode"] = f"10:00:{second:02}:{number:02}"
        if beside and way != 2:  # ARKit's own matrices, and what people log
            frame |= {"leftEyeTransform": np.eye(4).ravel().tolist(), "tracked": True}
        frames.append(frame)
    if lost and way != 1:
        for name in names[:5]:
            frames[7][name if way == 2 or name in TURNS else "blendShapes"] = (
                None if way == 2 or name in TURNS else frames[7]["blendShapes"] | {name: None}
            )
            values[7, names.index(name)] = np.nan
    whole: Any = {"fps": fps, "frames": frames} if clock == "fps" else frames
    (folder / "take.json").write_text(json.dumps(whole))
    off = 1.2e-3 if "stamp" in clock else 0.02 / fps
    said = "leftEyeTransform" if beside and way != 2 else ""
    what = {"clock": clock, "way": way}
    return Clip(folder / "take.json", names, np.arange(count) / fps, values, off, fps, said, what)


@dataclass
class Cues:
    """A file of visemes, and when each is said."""

    path: Path
    cues: Sequence[tuple[float, float, set[str]]]  # begin, end, names of Oculus one of which it must be mostly

    def differences(self, read: Performance) -> list[tuple[str, str]]:
        """(subject, figure) of each cue that a performance has otherwise; its time 0 is that of the audio."""
        found = []
        names = [name.casefold().removeprefix("viseme_") for name in read.names]
        for begin, end, sounds in self.cues:
            if end - begin < 0.05:
                continue
            middle = (begin + end) / 2
            now = np.array([np.interp(middle, read.seconds, column) for column in read.values.T])
            loudest = names[int(now.argmax())] if now.max(initial=0.0) > 0.3 else "sil"
            if loudest not in {one.casefold() for one in sounds}:
                found.append(("values", f"{loudest} at {middle:.3f} s, expected one of {sorted(sounds)}"))
        last = max(end for _, end, _ in self.cues)
        if not last - 0.1 < read.seconds[-1] < last + 0.3:
            found.append(("time", f"{read.seconds[-1]:.3f} s long, expected {last:.3f}"))
        return found[:1]


def azure_ids(rng: np.random.Generator, folder: Path) -> Cues:
    """Azure's viseme ids with ticks of 100 ns from the start of the audio."""
    starts = np.cumsum(rng.uniform(0.08, 0.3, int(rng.integers(5, 30)))) + float(_any(rng, 0.0, 1.0))
    ids = rng.integers(0, 22, len(starts)).tolist()
    events = [{"audioOffset": int(at * 1e7), "visemeId": kind} for at, kind in zip(starts, ids, strict=True)]
    events = [events[i] for i in rng.permutation(len(events))] if _yes(rng, 0.3) else events
    (folder / "take.json").write_text(json.dumps(events))
    ends = [*starts[1:], starts[-1] + 0.08]
    return Cues(folder / "take.json", [(a, b, {*SOUNDS[k].split()}) for a, b, k in zip(starts, ends, ids, strict=True)])


def oculus(rng: np.random.Generator, folder: Path) -> Cues:
    """Oculus's visemes with times in milliseconds, as TalkingHead takes them."""
    sounds = ["sil", "PP", "FF", "TH", "DD", "kk", "CH", "SS", "nn", "RR", "aa", "E", "I", "O", "U"]
    names = [str(one) for one in rng.choice(sounds, int(rng.integers(4, 25)))]
    lasting = rng.integers(60, 300, len(names))
    starts = np.concatenate([[0], np.cumsum(lasting)[:-1]]) + int(_any(rng, 0, 400))
    written = [f"viseme_{one}" for one in names] if _yes(rng) else names
    whole = {"visemes": written, "vtimes": starts.tolist(), "vdurations": lasting.tolist()}
    (folder / "take.json").write_text(json.dumps(whole))
    spans = zip(starts / 1000, (starts + lasting) / 1000, names, strict=True)
    return Cues(folder / "take.json", [(a, b, {name}) for a, b, name in spans])


def stage_clip(rng: np.random.Generator, folder: Path) -> Clip:
    """A SkelAnimation alone, as Audio2Face exports it; also of another unit of time, or with the head's joint."""
    fps, count = float(_any(rng, 24, 30, 60)), int(rng.integers(30, 90))
    turning, z_up = _yes(rng), _yes(rng)
    boned = turning and _yes(rng)
    names = [*_shapes(rng), *(HEAD if turning else [])]
    values = waves(rng, count, names, fps).astype(np.float32).astype(float)
    rests = [turn_matrix(*rng.uniform(-1, 1, 3)) if boned else np.eye(3) for _ in range(2)]  # neck, head
    if turning and not boned:  # rest is its first sample then
        values[0, [i for i, n in enumerate(names) if n in TURNS]] = 0.0
    shapes = [n for n in names if n not in TURNS]
    per, first = float(_any(rng, fps, 1.0, 24.0)), float(_any(rng, 0.0, 101.0))
    lines = [
        f'#usda 1.0\n(\n    timeCodesPerSecond = {per:g}\n    upAxis = "{"ZY"[not z_up]}"\n)',
        'def SkelAnimation "World"\n{',
    ]
    lines.append(f"    uniform token[] blendShapes = {json.dumps(shapes)}")
    codes = [f"{first + i * per / fps:.9g}" for i in range(count)]
    weights = [
        f"{c}: [{', '.join(f'{v:.9g}' for v in row[: len(shapes)])}]" for c, row in zip(codes, values, strict=True)
    ]
    lines.append(f"    float[] blendShapeWeights.timeSamples = {{ {', '.join(weights)} }}")
    lines.append(f"    uniform token[] joints = {json.dumps(['neck', 'neck/head'] if turning else [])}")
    if turning:
        turned = []
        for code, row in zip(codes, values, strict=True):
            matrix = turn_matrix(*row[len(shapes) :])
            if z_up:  # what is (x, y, z) with Y up is (x, -z, y)
                axes = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
                matrix = axes @ matrix @ axes.T
            pair = [_quaternion(rests[0]), _quaternion(rests[0].T @ matrix @ rests[0] @ rests[1])]
            turned.append(f"{code}: [{', '.join('(' + ', '.join(f'{v:.9g}' for v in one) + ')' for one in pair)}]")
        lines.append(f"    quatf[] rotations.timeSamples = {{ {', '.join(turned)} }}")
        lines.append(
            "    float3[] translations = [(0, 0, 0), (0, 0.1, 0)]\n    half3[] scales = [(1, 1, 1), (1, 1, 1)]"
        )
    if boned:
        rows = [np.block([[rest.T, np.zeros((3, 1))], [np.array([[0, 0.1, 0, 1]])]]) for rest in rests]
        places = ", ".join(
            "( " + ", ".join(f"({', '.join(f'{v:.9g}' for v in row)})" for row in one) + " )" for one in rows
        )
        lines.append('}\ndef Skeleton "Bones" (prepend apiSchemas = ["SkelBindingAPI"])\n{')
        lines.append("    rel skel:animationSource = </World>")
        lines.append('    uniform token[] joints = ["neck", "neck/head"]')
        lines += [f"    uniform matrix4d[] {kind}Transforms = [{places}]" for kind in ("rest", "bind")]
    path = folder / "take.usda"
    path.write_text("\n".join([*lines, "}\n"]))
    what = {"turning": turning, "z_up": z_up, "per": per, "first": first}
    return Clip(path, names, np.arange(count) / fps, values, 0.02 / fps, fps, what=what)


def _quaternion(matrix: Array) -> list[float]:
    """w x y z of a rotation of less than half a turn."""
    w = np.sqrt(max(1 + np.trace(matrix), 1e-12)) / 2
    x, y, z = (matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1])
    return [w, x / (4 * w), y / (4 * w), z / (4 * w)]


def file_clip(rng: np.random.Generator, folder: Path) -> Clip:
    """A glTF file of another face with its clip: weights, and the turns of its head and neck."""
    fps, count = float(_any(rng, 24, 30, 60)), int(rng.integers(30, 90))
    names = [*_shapes(rng), *HEAD]
    values = waves(rng, count, names, fps).astype(np.float32).astype(float)
    shapes = names[:-3]
    seconds = (np.arange(count) / fps).astype("<f4")
    turns = np.array([np.roll(_quaternion(turn_matrix(*row[-3:])), -1) for row in values]).astype("<f4")
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    arrays = [points, np.ones((3, 3), "<f4"), seconds, values[:, :-3].astype("<f4").reshape(-1), turns]
    views, data = [], b""
    for one in arrays:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": one.nbytes})
        data += one.tobytes()
    kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    accessors = [
        {"bufferView": i, "componentType": 5126, "count": len(a), "type": kinds[a.shape[1] if a.ndim == 2 else 1]}
        for i, a in enumerate(arrays)
    ]
    targets = [{"POSITION": 1}] * len(shapes)
    channels = [
        {"sampler": 0, "target": {"node": 2, "path": "weights"}},
        {"sampler": 1, "target": {"node": 1, "path": "rotation"}},
    ]
    document = {
        "asset": {"version": "2.0"},
        "buffers": [
            {"byteLength": len(data), "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode()}
        ],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0}, "targets": targets}], "extras": {"targetNames": shapes}}
        ],
        "nodes": [
            {"name": "Root", "children": [1], "rotation": [0, 0, 0, 1]},
            {"name": "Head", "children": [2], "translation": [0, 1.5, 0]},
            {"name": "Face", "mesh": 0},
        ],
        "scenes": [{"nodes": [0]}],
        "animations": [
            {
                "samplers": [{"input": 2, "output": 3}, {"input": 2, "output": 4}],
                "channels": channels,
            }
        ],
    }
    path = folder / "take.gltf"
    path.write_text(json.dumps(document))
    return Clip(path, names, np.arange(count) / fps, values, 0.02 / fps, fps)


KINDS: dict[str, Callable[[np.random.Generator, Path], Clip | Cues]] = {
    "Live Link Face": live_link,
    "drop frame": drop_frame,
    "timecodes as times": timecode_times,
    "table": table,
    "table of Audio2Face": audio2face_table,
    "table of MediaPipe": media_pipe_table,
    "MediaPipe": media_pipe,
    "Audio2Face": audio2face,
    "Azure": azure,
    "Azure's ids": azure_ids,
    "TalkingHead": talking_head,
    "visemes": oculus,
    "ARKit": arkit,
    "clip in a stage": stage_clip,
    "clip in glTF": file_clip,
}
