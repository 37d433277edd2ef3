"""Learn what the rig of a face does, as one small network.

The controls of a face (its sliders, and the shapes that none of them drives) are sampled, and the face's rig evaluates
them; or DATA holds what another program baked of its rig: controls over time, and a point cache (docs/neural_rig.md).
It needs the extra train (torch).

examples:
  facepipe neural-rig train head.usdc -o head.fpnr
  facepipe neural-rig train head.usdc -o head.fpnr --spread 2000 --width 256 --json
  facepipe neural-rig train head.usdc --clip head.usdc --clip talk.usdc -o head.fpnr
  facepipe neural-rig train range_of_motion.usdc --controls /Rig/Controls -o head.fpnr
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from facepipe.core.atomic import when_placed
from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_written
from facepipe.core.reports import table
from facepipe.declare import Options, beside, option, source, values_of
from facepipe.kinds import FileAction, Job, action
from facepipe.neural.options import FrameBlocksOptions, SampleMotionOptions, TrainEncoderOptions, TrainNeuralRigOptions

if TYPE_CHECKING:
    from facepipe.neural.motion import Motion
    from facepipe.neural.train_neural_rig import NeuralRigReport


@action("neural-rig train", "learn what the rig of a face does")
@dataclass(frozen=True, kw_only=True)
class Train(
    FrameBlocksOptions, TrainEncoderOptions, TrainNeuralRigOptions, SampleMotionOptions, FileAction["NeuralRigReport"]
):
    """The action."""

    output = "neural rig to write: .fpnr"
    suffixes = (".fpnr",)

    data: Path = source("face stage, or one with controls and points over time: .usda .usdc .usd .usdz")
    clips: tuple[Path, ...] = source(
        "stage whose clips the face's own rig plays too, its own stage among them",
        default=(),
        flag="--clip",
        metavar="STAGE",
    )
    learn_from: Literal["auto", "rig", "samples"] = option(
        "auto", "the face's own rig, or samples over time; auto: samples where the stage has them", flag="--source"
    )
    controls: tuple[str, ...] = option(
        (), "prim whose custom numbers are the controls, in place of facepipe:control:*", metavar="PRIM"
    )
    encoder: bool = option(True, "train an encoder too, from points back to controls")
    checkpoint: Path | None = option(
        None, "file that keeps where the training stands: killed, the same command goes on from there", metavar="FILE"
    )
    plot: Path | None = beside("picture of what is left of the motion, step by step", ".svg", "draw")

    def check(self) -> None:
        for flag, given, other, expected in (
            ("--controls", self.controls, "rig", "samples over time"),
            ("--clip", self.clips, "samples", "a face's own rig to play it"),
        ):
            if given and self.learn_from == other:
                raise InputError(flag, f"given with --source {other}, expected {expected}")
        if self.controls and self.clips:
            raise InputError("--clip", "given with --controls, expected one of them")

    def write(self, job: Job) -> NeuralRigReport:
        from facepipe.neural.neural_rig_file import save_neural_rig
        from facepipe.neural.train_encoder import TrainEncoder
        from facepipe.neural.train_neural_rig import TrainNeuralRig

        kept = None if self.checkpoint is None else Path(self.checkpoint)
        if kept and kept.resolve() in {one.resolve() for one in (job.out, self.plot) if one is not None}:
            raise InputError(job.out, "two outputs of one name, expected a file each")
        if kept:
            check_written(kept)
        motion = self._motion(job)
        with job.watch("train", self.steps) as bar:
            trained = TrainNeuralRig(options=self._as(TrainNeuralRigOptions))(motion, bar.update, kept)
        report, encoder = replace(trained.report, curve=trained.curve), None
        if self.encoder:
            with job.watch("encoder", self.encoder_steps) as bar:
                train_encoder = TrainEncoder(options=self._as(TrainEncoderOptions))
                encoded = train_encoder(motion, bar.update, kept)
            report, encoder = replace(report, encoder=encoded.report), encoded.encoder
        save_neural_rig(trained.rig, job.out, report.to_dict(), encoder)
        if kept:
            when_placed(lambda: kept.unlink(missing_ok=True))
        return report

    def _as(self, kind: type[Options]) -> Options:
        return kind(**values_of(kind, self))

    def _motion(self, job: Job) -> Motion:
        from facepipe.neural.motion import ReadClips, SampleMotion, controls_of
        from facepipe.neural.read_motion import ReadMotion
        from facepipe.stage import open_face
        from facepipe.stage.controls_over_time import is_recorded

        over_time = self.learn_from == "samples"
        if self.learn_from == "auto" and not self.clips:
            over_time = bool(self.controls) or is_recorded(self.data)
        if over_time:
            return ReadMotion(options=self, prims=self.controls)(self.data)
        parts = open_face(self.data).parts()
        controls = controls_of(parts)
        clips = ReadClips(options=self)(self.clips, controls) if self.clips else None
        with job.watch("frames", self.count(len(controls)) + (len(clips.values) if clips else 0)) as bar:
            return SampleMotion(options=self)(parts, str(self.data), bar.update, clips)

    def draw(self, report: NeuralRigReport, path: Path) -> None:
        """The picture of the training."""
        from facepipe.core.atomic import write_bytes
        from facepipe.pictures.figures import training_chart

        write_bytes(path, training_chart(report.curve))

    def text(self, report: NeuralRigReport, out: Path) -> str:
        rows = [("mm, on frames held out", "mean", "largest")]
        rows += [("neural rig", f"{report.error_mean_mm:.4f}", f"{report.error_max_mm:.3f}")]
        rows += [("ridge regression", f"{report.ridge_mean_mm:.4f}", f"{report.ridge_max_mm:.3f}")]
        rows += [("best blendshapes", f"{report.linear_mean_mm:.4f}", f"{report.linear_max_mm:.3f}")]
        own = "of the face's own rig"
        of = {"samples": "over time", "rig and clips": f"{own} and of clips"}.get(report.source, own)
        between = f", {report.between} between blocks left out" if report.between else ""
        learned = f"{out}: learned from {report.frames} frames {of}, checked on {report.held_out}{between}"
        left = f"no frame moves {', '.join(report.left_out)}" if report.left_out else ""
        encoder = ""
        if found := report.encoder:
            off = [("controls off, % of their range", "mean", "median control")]
            off += [("encoder", f"{100 * found.error_mean:.2f}", f"{100 * found.error_median:.2f}")]
            off += [("ridge regression", f"{100 * found.ridge_mean:.2f}", f"{100 * found.ridge_median:.2f}")]
            encoder = table(off)
        return "\n".join(line for line in (f"{learned}; {report.shapes} shapes", table(rows), left, encoder) if line)
