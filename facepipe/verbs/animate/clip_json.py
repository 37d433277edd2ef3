"""Clips in JSON, in the forms that trackers, speech services and web avatars write.

    [{"time": 0.0, "blendShapes": {"jawOpen": 0.2, ...}, "HeadYaw": 0.1}, ...]     or {"frames": [...], "fps": 60}
    [{"faceBlendshapes": [{"categories": [{"categoryName", "score"}]}], "facialTransformationMatrixes": [...]}, ...]
    {"exportFps": 60, "facsNames": ["eyeBlinkLeft", ...], "weightMat": [[0.0, ...], ...]}     Audio2Face
    {"FrameIndex": 0, "BlendShapes": [[55 numbers], ...]}, or a list of these                 Azure
    [{"audioOffset": 500000, "visemeId": 19}, ...]                                            Azure
    {"dt": [33, ...], "vs": {"jawOpen": [0.0, ...]}}                                          TalkingHead
    {"visemes": ["aa", ...], "vtimes": [0, ...], "vdurations": [80, ...]}                     TalkingHead

In frames, weights are an object, or a list of {"categoryName" | "name", "score" | "value"}; they may also stand in the
frame itself. Seconds are "time", "timestamp" or "seconds", a timecode "timecode"; else a frame follows the other.
Sources: MediaPipe's FaceLandmarkerResult (ai.google.dev/edge/mediapipe), Azure's viseme page
(learn.microsoft.com/azure/ai-services/speech-service/how-to-speech-synthesis-viseme), TalkingHead's README.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.core.names import first_names
from facepipe.core.reading import check_values, read_bytes, read_json
from facepipe.rig.visemes import AZURE_BLENDSHAPES, AZURE_VISEMES, OCULUS_VISEMES
from facepipe.verbs.animate.performance import (
    FPS,
    LARGEST,
    LATEST,
    MOST_FRAMES,
    MOST_VALUES,
    RATES,
    Take,
    angle_of,
    check_count,
    clock_seconds,
    read_timecodes,
    turn_angles,
)

_WEIGHTS = ("blendshapes", "faceblendshapes", "weights", "shapes")
_MATRICES = ("facialtransformationmatrixes", "facialtransformationmatrices", "facialtransformationmatrix")
_TIMES = ("timestampms", "timems", "time", "timestamp", "seconds", "timestampus", "timestampns")
_RATES = ("fps", "exportfps", "framerate")
_NAMES = ("facsnames", "names", "blendshapenames")
_MATRIX = ("weightmat", "values")
_LISTS = ("frames", "results", "data")
_EXPECTED = "a list of frames, or an object with frames, or with facsNames and weightMat"
_VISEME_FADE = 0.08  # seconds from one viseme to the next at most: about half a short vowel
_MOST_SECONDS = MOST_FRAMES / FPS


def read_clip_json(path: Path, most: int, fps: float | None) -> Take:
    """:raises InputError: not JSON, another form, other names in some frames, or values that are no numbers"""
    content = _content(path, most)
    if isinstance(content, Mapping) and "animation" in _keyed(content) and len(content) <= 3:
        content = _keyed(content)["animation"]
    top = _keyed(content) if isinstance(content, Mapping) else {}
    if "dt" in top and "vs" in top:
        return _talking_head(path, top)
    if "visemes" in top and "vtimes" in top:
        return _viseme_cues(path, top)
    own = _first(top, _RATES)
    rate = None if own is None else _number(f"{path} -> fps", own)
    if rate is not None and not RATES[0] <= rate <= RATES[1]:
        raise InputError(f"{path} -> fps", f"{rate:g}, expected 1 to 1000")
    names, rows = _first(top, _NAMES), _first(top, _MATRIX)
    if names is not None and rows is not None:
        if not isinstance(names, list) or not isinstance(rows, list):
            raise InputError(path, f"another form, expected {_EXPECTED}")
        for number, row in enumerate(rows, 1):
            if not isinstance(row, list) or len(row) != len(names):
                found = f"{len(row)} weights" if isinstance(row, list) else "no list"
                raise InputError(f"{path} -> frame {number}", f"{found}, expected {len(names)} weights")
        frames: Any = [{"weights": dict(zip(map(str, names), row, strict=True))} for row in rows]
        take = _frames_take(path, frames, fps or rate)
        take.form = "Audio2Face" if "facsnames" in top else "matrix of weights"
        take.rate = rate
        return take
    frames = content if isinstance(content, list) else [top] if "frameindex" in top else _first(top, _LISTS)
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, Mapping) for frame in frames):
        raise InputError(path, f"another form, expected {_EXPECTED}")
    keyed = [_keyed(frame) for frame in frames]
    if any("visemeid" in frame for frame in keyed) or "frameindex" in keyed[0]:
        return _azure(path, keyed)
    take = _frames_take(path, frames, fps or rate)
    if take.frames is None and rate is not None:  # timecodes are counted at a rate already
        take.rate = rate
    return take


def _content(path: Path, most: int) -> object:
    """What the file holds; of JSON lines a list of them."""
    if path.suffix.lower() == ".json":
        return read_json(path, most)
    data = read_bytes(path, most)
    check_values(path, data)
    try:
        content = [json.loads(line) for line in data.decode("utf-8-sig").splitlines() if line.strip()]
        if b"\\u" in data:  # an escape can be half a surrogate pair
            json.dumps(content, ensure_ascii=False).encode()
        return content
    except UnicodeEncodeError:
        raise InputError(path, "text with half a surrogate pair, expected Unicode") from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is not JSON lines ({str(error)[:120]})") from None


def _frames_take(path: Path, frames: list[Any], fps: float | None) -> Take:
    """A take of frames with names and numbers."""
    where = [f"{path} -> frame {number}" for number in range(1, len(frames) + 1)]
    keyed = [_keyed(frame) for frame in frames]
    tracked: list[dict[str, float] | None] = []
    tracker = False
    more = 0
    unread: dict[str, None] = {}
    skipped = (*_WEIGHTS, *_MATRICES, *_TIMES, "timecode", "frame", "index", "facelandmarks")
    for trail, own, frame in zip(where, keyed, frames, strict=True):
        held, matrices = _first(own, _WEIGHTS), _first(own, _MATRICES)
        tracker = tracker or "faceblendshapes" in own or matrices is not None
        if isinstance(held, list):
            held, count = _first_face(held)
            more = max(more, count - 1)
            if tracker and not held:  # no face in the picture
                tracked.append(None)
                continue
        beside = {name: value for name, value in frame.items() if _plain(name) not in skipped}
        if held is not None:
            unread.update(dict.fromkeys(name for name in beside if not angle_of(name)))
            beside = {name: value for name, value in beside.items() if angle_of(name)}
            if not isinstance(held, Mapping):
                raise InputError(trail, "weights of another form, expected names with numbers")
        numbers = {**(held or {}), **beside}
        numbers.pop("_neutral", None)  # of MediaPipe: how much of a face shows none of the others
        values = {str(name): _weight(f"{trail} -> {name}", value) for name, value in numbers.items()}
        if matrices:
            values |= _turn(
                f"{trail} -> facialTransformationMatrixes", matrices[0] if isinstance(matrices, list) else matrices
            )
        tracked.append(values)
    names = list(dict.fromkeys(name for weight in tracked if weight is not None for name in weight))
    if not names:
        raise InputError(path, "no weights, expected names of shapes with numbers")
    for trail, weights in zip(where, tracked, strict=True):
        if weights is not None and len(weights) != len(names):
            missing = next(name for name in names if name not in weights)
            raise InputError(trail, f"no '{missing[:60]}', expected the {len(names)} names of the other frames")
    if len(frames) * len(names) > MOST_VALUES:
        raise InputError(path, f"{len(frames)} frames of {len(names)} names, expected at most {MOST_VALUES} values")
    rows = np.array([[math.nan] * len(names) if one is None else [one[name] for name in names] for one in tracked])
    take = Take(form="frames", where=where, names=names, values=rows)
    if unread:
        take.warnings.append(f"{first_names([str(name)[:40] for name in unread], 4)} of its frames: left out")
    if tracker:
        take.form, take.radians = "MediaPipe face landmarker", any(_first(own, _MATRICES) for own in keyed)
        if more:
            take.warnings.append(f"up to {more + 1} faces in a frame: the first is taken")
    if "timecode" in keyed[0]:
        read_timecodes(take, [str(one.get("timecode")) for one in keyed], fps)
        return take
    clock = next((name for name in _TIMES if name in keyed[0]), None)
    if clock is None and tracker and not fps:
        take.rate = 30.0
        take.notes.append("30 fps taken, as cameras have: its frames hold no times (--fps)")
    elif clock is not None:
        times = [_number(f"{one} -> {clock}", own.get(clock), LATEST) for one, own in zip(where, keyed, strict=True)]
        take.seconds = clock_seconds(str(path), clock, np.array(times), take.notes)
    return take


def _first_face(held: list[Any]) -> tuple[dict[str, Any], int]:
    """Weights of the first of the faces that a frame lists, and how many it lists; a list of weights is one face."""
    faces = [_keyed(one)["categories"] for one in held if isinstance(one, Mapping) and "categories" in _keyed(one)]
    faces = [one for one in faces or held if isinstance(one, list)]
    listed = [_keyed(one) if isinstance(one, Mapping) else {} for one in (faces[0] if faces else held) or []]
    return {str(_first(one, ("categoryname", "name"))): _first(one, ("score", "value")) for one in listed}, len(faces)


def _turn(where: str, matrix: object) -> dict[str, float]:
    """Yaw, pitch and roll of the head, radians, of a matrix that puts the face before the camera (Y up, -Z ahead).

    Lists of 16 numbers may be stored by columns, as MediaPipe's are, or by rows: the row 0 0 0 1 tells. Where the head
    is moves no joint and is left out.
    """
    flat = _first(_keyed(matrix), ("data", "packeddata")) if isinstance(matrix, Mapping) else matrix
    if isinstance(flat, list) and len(flat) == 4 and all(isinstance(row, list) for row in flat):
        flat = [value for row in flat for value in row]
    if not isinstance(flat, list) or len(flat) != 16:
        raise InputError(where, "another form, expected 4 x 4 numbers")
    found = np.array([_number(where, value) for value in flat]).reshape(4, 4)
    placed = found if not np.abs(found[3] - (0, 0, 0, 1)).max() > 1e-3 else found.T
    scale = np.linalg.norm(placed[:3, :3], axis=0)
    if np.abs(placed[3] - (0, 0, 0, 1)).max() > 1e-3 or not scale.min() > 1e-9:
        raise InputError(where, "no rigid motion, expected a row 0 0 0 1 and no scale of 0")
    yaw, pitch, roll = turn_angles((placed[:3, :3] / scale)[None])[0].tolist()
    return {"HeadYaw": yaw, "HeadPitch": pitch, "HeadRoll": roll}


def _talking_head(path: Path, top: Mapping[str, Any]) -> Take:
    """Keys of shapes: the key i of each list is reached when the first i + 1 durations are over."""
    durations, tracks = top["dt"], top["vs"]
    if not isinstance(durations, list) or not isinstance(tracks, Mapping) or not durations or not tracks:
        raise InputError(path, "another form, expected dt, a list of milliseconds, and vs, lists of values by name")
    steps = np.array([_number(f"{path} -> dt[{i}]", value) for i, value in enumerate(durations)])
    times = np.cumsum(steps) / 1000
    if not (steps >= 0).all() or times[-1] > _MOST_SECONDS:
        raise InputError(f"{path} -> dt", f"{steps.min():g} to {times[-1]:g} s, expected durations from 0 on")
    names, columns = [], []
    for name, values in tracks.items():
        if not isinstance(values, list) or len(values) != len(durations):
            found = f"{len(values)} values" if isinstance(values, list) else "no list"
            raise InputError(f"{path} -> vs -> {name[:60]}", f"{found}, expected {len(durations)}, as dt has")
        names.append(name)
        columns.append([_weight(f"{path} -> vs -> {name[:60]}[{i}]", value) for i, value in enumerate(values)])
    values = np.array(columns).T
    where = [f"{path} -> key {number}" for number in range(1, len(times) + 1)]
    take = Take(form="TalkingHead", where=where, names=names, values=values, seconds=times)
    if len(times) > 2 and np.ptp(steps[1:]) > 1.0:  # keys apart, not frames: each stays where it is
        grid = np.arange(times[0], times[-1] + 0.5 / FPS, 1 / FPS)
        check_count(str(path), len(grid), len(names))
        take.values = np.full((len(grid), len(names)), math.nan)
        for i in np.flatnonzero(np.isfinite(values).any(axis=0)):
            seen = np.isfinite(values[:, i])
            take.values[:, i] = np.interp(grid, times[seen], values[seen, i])
        take.where, take.seconds = [str(path)] * len(grid), grid
        take.notes.append(f"{len(times)} keys")
    return take


def _azure(path: Path, frames: list[dict[str, Any]]) -> Take:
    """Frames of 55 numbers at 60 fps in chunks with the number of their first frame; else events of viseme ids."""
    chunks = []
    for number, event in enumerate(frames, 1):
        inner = event.get("animation")
        if isinstance(inner, str) and inner.lstrip().startswith("{"):
            check_values(path, inner.encode("utf-8", "replace"))
            try:
                inner = json.loads(inner)
            except (ValueError, RecursionError) as error:
                raise InputError(f"{path} -> event {number} -> animation", f"is not JSON ({str(error)[:80]})") from None
        chunk = _keyed(inner) if isinstance(inner, Mapping) else event
        if "blendshapes" in chunk:
            chunks.append((number, chunk))
    if not chunks:
        cues = [(event.get("visemeid"), _offset(f"{path} -> event {i}", event)) for i, event in enumerate(frames, 1)]
        for number, (kind, _) in enumerate(cues, 1):
            if not isinstance(kind, int) or isinstance(kind, bool) or not 0 <= kind < len(AZURE_VISEMES):
                raise InputError(f"{path} -> event {number} -> visemeId", f"{str(kind)[:40]}, expected 0 to 21")
        cues.sort(key=lambda cue: cue[1])
        mixes = [AZURE_VISEMES[int(str(kind))] for kind, _ in cues]
        starts = [at for _, at in cues]
        return _spoken(path, "Azure viseme ids", mixes, starts, [*starts[1:], starts[-1] + _VISEME_FADE])
    rows: list[list[float]] = []
    places: list[int] = []
    for number, chunk in chunks:
        trail = f"{path} -> chunk {number}"
        first = int(_number(f"{trail} -> FrameIndex", chunk.get("frameindex", len(rows))))
        if not isinstance(chunk["blendshapes"], list):
            raise InputError(f"{trail} -> BlendShapes", "no list, expected lists of 55 numbers")
        for i, row in enumerate(chunk["blendshapes"]):
            if not isinstance(row, list) or len(row) != len(AZURE_BLENDSHAPES):
                found = f"{len(row)} numbers" if isinstance(row, list) else "no list"
                raise InputError(f"{trail} -> BlendShapes[{i}]", f"{found}, expected {len(AZURE_BLENDSHAPES)}")
            rows.append([_weight(f"{trail} -> BlendShapes[{i}]", value) for value in row])
            places.append(first + i)
    if not rows:
        raise InputError(path, "no frames, expected some")
    order = np.argsort(places, kind="stable")
    where = [f"{path} -> frame {places[i]}" for i in order]
    values, at = np.array(rows)[order], np.array(places, dtype=np.float64)[order]
    form, since = "Azure blendshapes", at - at[0]
    return Take(form=form, where=where, names=AZURE_BLENDSHAPES, values=values, frames=since, rate=60.0)


def _offset(where: str, event: Mapping[str, Any]) -> float:
    """Seconds from the start of the audio: Azure's SDKs count ticks of 100 ns, its browser SDK too."""
    name = next((key for key in ("audiooffset", "offset", "time") if key in event), None)
    if name is None:
        raise InputError(where, "no audioOffset, expected ticks of 100 ns")
    value = _number(f"{where} -> {name}", event[name])
    seconds = value * {"audiooffset": 1e-7, "offset": 1e-3, "time": 1.0}[name]
    if not 0 <= seconds <= _MOST_SECONDS:
        raise InputError(f"{where} -> {name}", f"{value:g}, expected 0 to {_MOST_SECONDS:g} s")
    return seconds


def _viseme_cues(path: Path, top: Mapping[str, Any]) -> Take:
    """Visemes by name with the milliseconds when each begins and how long it lasts."""
    lists = [top.get(name) for name in ("visemes", "vtimes", "vdurations")]
    names, times, lasting = lists
    if not all(isinstance(one, list) and len(one) == len(lists[0] or ()) for one in lists) or not names:
        raise InputError(path, "another form, expected visemes, vtimes and vdurations of one length")
    known = {name.removeprefix("viseme_").casefold(): name for name in OCULUS_VISEMES}
    mixes = []
    for number, name in enumerate(names or [], 1):
        key = str(name).removeprefix("viseme_").casefold()
        if key not in known:
            raise InputError(f"{path} -> visemes[{number}]", f"'{str(name)[:40]}', expected one of {' '.join(known)}")
        mixes.append({known[key]: 1.0})
    starts = [_number(f"{path} -> vtimes", value) / 1000 for value in times or []]
    ends = [
        at + _number(f"{path} -> vdurations", value) / 1000 for at, value in zip(starts, lasting or [], strict=True)
    ]
    if (
        min(starts) < -_MOST_SECONDS
        or max(ends) > _MOST_SECONDS
        or any(a > b for a, b in zip(starts, ends, strict=True))
    ):
        raise InputError(f"{path} -> vtimes", f"{min(starts):g} to {max(ends):g} s, expected times of a clip")
    return _spoken(path, "TalkingHead visemes", mixes, starts, ends)


def _spoken(
    path: Path, form: str, mixes: Sequence[Mapping[str, float]], starts: Sequence[float], ends: Sequence[float]
) -> Take:
    """Cues as weights of Oculus's visemes at 60 fps from the time 0 of the audio.

    Each weight rises and falls in straight lines, centred on where its viseme begins and ends, of `_VISEME_FADE` or the
    length of the cue: so that neighbours cross at a half, and the mouth does not jump.
    """
    if sum(ends) - sum(starts) > MOST_VALUES / FPS:
        raise InputError(
            path, f"cues of {sum(ends) - sum(starts):g} s together, expected at most {MOST_VALUES / FPS:g}"
        )
    low = min(0.0, min(starts))
    times = np.arange(low, max(ends) + _VISEME_FADE + 0.5 / FPS, 1 / FPS)
    weights = {name: np.zeros(len(times)) for name in OCULUS_VISEMES}
    for mix, start, end in zip(mixes, starts, ends, strict=True):
        fade = max(min(_VISEME_FADE, end - start), 1e-6)
        corners = [start - fade / 2, start + fade / 2, end - fade / 2, end + fade / 2]
        # of the frames around the cue alone: over all of them a file of many cues would take hours
        here = slice(max(int((corners[0] - low) * FPS), 0), int((corners[3] - low) * FPS) + 2)
        shape = np.interp(times[here], corners, [0.0, 1.0, 1.0, 0.0])
        for name, share in mix.items():
            weights[name][here] = np.maximum(weights[name][here], share * shape)
    used = [name for name, weight in weights.items() if weight.any()] or ["viseme_sil"]
    values: FloatArray = np.stack([weights[name] for name in used], axis=1)
    take = Take(form=form, where=[str(path)] * len(times), names=used, values=values, rate=FPS)
    take.notes.append(f"{len(mixes)} cues")
    return take


def _plain(name: object) -> str:
    return re.sub(r"[^a-z0-9]", "", str(name).casefold())


def _keyed(value: object) -> dict[str, Any]:
    return {_plain(name): one for name, one in value.items()} if isinstance(value, Mapping) else {}


def _first(keyed: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((keyed[name] for name in names if name in keyed), None)


def _weight(where: str, value: object) -> float:
    """A number, NaN for null: not tracked."""
    return math.nan if value is None else _number(where, value)


def _number(where: str, value: object, most: float = LARGEST) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not -most <= value <= most:
        raise InputError(where, f"{str(value)[:40]}, expected a number")
    return float(value)
