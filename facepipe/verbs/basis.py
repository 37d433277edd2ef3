"""Write what devices need to rebuild persons: one file of a few megabytes, which all people share.

That of the head in the box; with --database, of the modes of a studio's own faces; with --template, of a face of which
others are sent as points alone. `facepipe person` writes people on it, and docs/files.md says how it is read.

examples:
  facepipe basis -o head.fpbasis
  facepipe basis -o people.fpbasis --database people.fpdb
  facepipe basis -o studio.fpbasis --template studio.usdc
  facepipe basis -o head.onnx
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.reports import Report
from facepipe.declare import source
from facepipe.kinds import FileAction, Job, action


@dataclass(frozen=True, kw_only=True)
class BasisReport(Report):
    """What was written."""

    bytes: int
    basis: str  # its name
    digest: str  # hexadecimal
    points: int
    modes: int


@action("basis", "write what devices need to rebuild persons")
@dataclass(frozen=True, kw_only=True)
class WriteBasis(FileAction[BasisReport]):
    """The action."""

    output = "basis to write: .fpbasis, or .onnx for engines that run graphs"
    suffixes = (".fpbasis", ".onnx")

    template: Path | None = source("face stage that others are sent as points of", default=None, flag="--template")
    database: Path | None = source("faces whose modes to use (.fpdb)", default=None, flag="--database", metavar="FPDB")

    @classmethod
    def with_it(cls, out: Path) -> tuple[Path, ...]:
        """The sidecar of a graph."""
        return (out.with_name(f"{out.name}.json"),) if out.suffix.lower() == ".onnx" else ()

    def check(self) -> None:
        super().check()
        if self.template is not None and self.database is not None:
            raise InputError("--template", "given with --database, expected only one of them")

    def write(self, job: Job) -> BasisReport:
        from facepipe.core.atomic import write_bytes
        from facepipe.payload.basis import encode_basis
        from facepipe.registry import exporter
        from facepipe.verbs.person_basis import basis_of

        with job.watch("basis", 1) as bar:
            basis = basis_of(None, "basis", template=self.template, database=self.database)
            if job.out.suffix.lower() == ".onnx":
                onnx: Any = exporter(job.out)
                size = onnx.export_persons(basis.content, basis.digest.hex(), job.out).bytes
            else:
                data = encode_basis(basis.content)
                write_bytes(job.out, data)
                size = len(data)
            bar.update()
        return BasisReport(
            bytes=size,
            basis=basis.name,
            digest=basis.digest.hex(),
            points=len(basis.mean),
            modes=len(basis.content.modes),
        )

    def text(self, report: BasisReport, out: Path) -> str:
        what = f"{report.points:,} points, {report.modes} modes"
        return f"{out}: {report.bytes:,} bytes, {what}: {report.basis} {report.digest}"
