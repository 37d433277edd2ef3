"""The process of a warm session: a blend, or the sliders of a face, opened once and then asked again and again.

A line of JSON in for each request. Out come two lengths (u32, little-endian), so many bytes of JSON, and so many of
what was asked for. The first line opens it: version, roots that confine all reads, and ``blend``, the files of its
sources, or ``sliders``, with one. Others have an ``id`` and ``weights`` or ``values``. It ends with its input.

Weights are answered twice: at once without contacts, and settled, once they have rested for a while.
"""

from __future__ import annotations

import json
import os
import queue
import struct
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from facepipe.core import __version__
from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.policy.paths import Trust, trusting
from facepipe.tasks.program import at_rest_mb, listen

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.hosting.live_blend import LiveBlend
    from facepipe.hosting.live_sliders import LiveSliders
    from facepipe.parts import FaceParts

LENGTHS = struct.Struct("<II")
_PAUSE = 0.15  # seconds that weights rest before they are settled, which takes as long and is lost if they move again
_BEHIND = 10  # niceness of the thread that settles: quick answers of all sessions go first where cores are few
_FARTHEST = 6e4  # millimetres that float16 holds
_SWITCH = 5e-4  # seconds after which an answer takes its turn from settling; Python's 5 ms would add up to 40


class Answers:
    """What goes out, from any thread."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe, self._lock = pipe, threading.Lock()

    def send(self, head: Mapping[str, Any], body: bytes = b"") -> None:
        """One answer."""
        text = json.dumps({**head, "mb": at_rest_mb()}).encode()
        with self._lock:
            self._pipe.write(LENGTHS.pack(len(text), len(body)) + text + body)
            self._pipe.flush()


class Blend:
    """A blend of faces."""

    def __init__(self, sources: list[str], answers: Answers) -> None:
        from facepipe.hosting.live_blend import LiveBlend
        from facepipe.verbs.blend import BlendFaces

        self._live: LiveBlend = LiveBlend(BlendFaces(sources=tuple(map(Path, sources))))
        self._answers, self._changed = answers, threading.Condition()
        self._newest = -1  # number of the request whose weights rest
        self._resting: tuple[int, Any] | None = None
        session, self._quick = self._live.session, self._live.quick
        self.opened = {"regions": list(session.graph.regions), "sources": len(sources), **_facts(self._live.base)}
        threading.Thread(target=self._settle, daemon=True).start()

    def answer(self, request: Mapping[str, Any]) -> bytes:
        """Offsets without contacts; settled ones come by themselves.

        :raises InputError: no weights, or some that can't be blended
        """
        from facepipe.verbs.blend.weights import weights_from_json

        weights = weights_from_json(request.get("weights"), "weights")
        offsets = self._live.offsets(weights, settled=False)
        with self._changed:
            self._newest, self._resting = request["id"], (request["id"], weights)
            self._changed.notify()
        return offset_bytes(offsets)

    def _settle(self) -> None:
        if sys.platform == "linux":  # elsewhere a thread has no niceness of its own
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), max(os.nice(0), _BEHIND))
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._resting is not None)
                while self._changed.wait(_PAUSE):  # they have moved again
                    pass
                assert self._resting is not None
                (number, weights), self._resting = self._resting, None
            body = offset_bytes(self._live.offsets(weights))  # they are fit for it: they had a quick answer
            with self._changed:
                newest = self._newest
            if newest == number:
                self._answers.send({"id": number, "settled": True}, body)


class Sliders:
    """The sliders of a face."""

    def __init__(self, path: str) -> None:
        from facepipe.hosting.live_sliders import LiveSliders

        self._live: LiveSliders = LiveSliders(Path(path))
        sliders = [
            {
                "name": one.name,
                "group": one.group,
                "range": [one.minimum, one.maximum],
                "default": one.default,
                "value": one.setting,
                "mirror": one.mirror,
            }
            for one in self._live.sliders
        ]
        self.opened = {"sliders": sliders, **_facts(self._live.base)}
        self._live.offsets({})

    def answer(self, request: Mapping[str, Any]) -> bytes:
        """Offsets, or the payload of the person.

        :raises FacepipeError: no such slider, a value out of its range, a payload of a face that has no basis
        """
        values = request.get("values")
        if not isinstance(values, Mapping):
            raise InputError("values", "expected an object of sliders and numbers")
        if request.get("wanted") == "payload":
            return self._live.payload(values)
        return offset_bytes(self._live.offsets(values))


def offset_bytes(offsets: FloatArray) -> bytes:
    """(n, 3) millimetres as float16, little-endian: off by 1/2048 of each at most, 0.008 mm of an offset of 16."""
    import numpy as np

    return np.clip(offsets, -_FARTHEST, _FARTHEST).astype("<f2").tobytes()


def _facts(parts: FaceParts) -> dict[str, Any]:
    return {"meshes": [{"name": mesh.name, "points": len(mesh.points)} for mesh in parts.meshes]}


def main() -> None:
    """Open, then answer requests until there are no more."""
    answers = Answers(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # what libraries print is no answer
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=listen, args=(requests,), daemon=True).start()
    sys.setswitchinterval(_SWITCH)
    setting = json.loads(requests.get())
    if setting["version"] != __version__:
        answers.send({"error": f"facepipe {__version__} works here, expected {setting['version']}"})
        return
    # roots and trust go with the context of a thread: the one that settles reads nothing any more
    with trusting(Trust(roots=tuple(map(Path, setting["roots"])), models=False, confined=True)):
        try:
            live = Blend(setting["blend"], answers) if "blend" in setting else Sliders(setting["sliders"][0])
        except FacepipeError as error:
            answers.send({"error": str(error)})
            return
        answers.send({"opened": live.opened})
        while True:
            request = json.loads(requests.get())
            try:
                body = live.answer(request)
            except FacepipeError as error:
                answers.send({"id": request["id"], "error": str(error)})
            else:
                answers.send({"id": request["id"], "settled": isinstance(live, Sliders)}, body)


if __name__ == "__main__":
    main()
