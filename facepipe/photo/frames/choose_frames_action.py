"""Choose the frames of a short video that show a person best: photos for `facepipe fit-photo` and `bake-photo`.

CLIP is a video of one person whose head turns, slowly and in steady light, the face at rest: MP4 or MOV of a phone,
WebM, MKV, AVI, MPEG-TS; up to 20,000 frames. The face is looked for at 48 moments, by facepipe's own network. The
frames that are kept are sharp, with eyes open and the mouth at rest as far as there are such frames, and from sides as
different as the clip has: one near the front, to both sides, up and down. It needs `pip install
'facepipe[train,video]'`.

OUT is a folder to make, whole or not at all: a PNG for each frame, upright, in sRGB, as large as the video, with the
frame's number and time in its name; and report.json. Look at them, and delete or add what you like, before they are
fitted. With --force an earlier folder of frames is replaced; one with anything else in it never is. Exit code 1: done,
but the frames are all from nearly one side, or fit-photo could not take one of them as it is.

examples:
  facepipe choose-frames clip.mp4 -o frames
  facepipe fit-photo frames/*.png head.usdc -o person.usdc --report person
  facepipe choose-frames clip.mp4 -o frames --count 8 --force --json
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.declare import option, source
from facepipe.kinds import FolderAction, Job, action

if TYPE_CHECKING:
    from facepipe.photo.frames.report import ChosenFramesReport


@action("choose-frames", "choose frames of a short video as photos of a person")
@dataclass(frozen=True, kw_only=True)
class ChooseFrames(FolderAction["ChosenFramesReport"]):
    """The action."""

    output = "folder to make: the frames as PNG, report.json"
    holds = r"report\.json|frame_\d+_[\d.]+s\.png"

    clip: Path = source("short video of one person")
    count: int = option(5, "frames to keep at most", 1, 24)

    def write(self, job: Job) -> ChosenFramesReport:
        from facepipe.core.atomic import replacing_folder, write_bytes
        from facepipe.photo.frames.clip import Clip
        from facepipe.photo.frames.search import choose, looks_in, moments, write_frames

        clip = Clip.of(self.clip)
        with job.watch("look for the face", moments(clip)) as bar:
            seen = looks_in(clip, bar.update)
        kept = choose(seen.looks, self.count)
        with replacing_folder(job.out) as folder, job.watch("write frames", len(kept)) as bar:
            report = write_frames(clip, seen, kept, folder, bar.update)
            text = json.dumps(report.to_dict(), sort_keys=True, indent=2)
            write_bytes(folder / "report.json", f"{text}\n".encode())
        return report

    def missed(self, report: ChosenFramesReport) -> bool:
        return bool(report.warnings)
