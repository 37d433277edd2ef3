"""Write what devices need to rebuild persons: one file of a few megabytes, which all people share.

That of the head in the box; with --database, of the modes of a studio's own faces; with --template, of a face of which
others are sent as points alone. `facepipe person` writes people on it, and docs/files.md says how it is read.

examples:
  facepipe basis -o head.fpbasis
  facepipe basis -o people.fpbasis --database people.fpdb
  facepipe basis -o studio.fpbasis --template studio.usdc
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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

    output = "basis to write: .fpbasis"
    suffixes = (".fpbasis",)

    template: Path | None = source("face stage that others are sent as points of", default=None, flag="--template")
    database: Path | None = source("faces whose modes to use (.fpdb)", default=None, flag="--database", metavar="FPDB")

    def check(self) -> None:
        super().check()
        if self.template is not None and self.database is not None:
            raise InputError("--template", "given with --database, expected only one of them")

    def write(self, job: Job) -> BasisReport:
        from facepipe.core.atomic import write_bytes
        from facepipe.payload.basis import encode_basis
        from facepipe.verbs.person_basis import basis_of

        with job.watch("basis", 1) as bar:
            basis = basis_of(None, "basis", template=self.template, database=self.database)
            data = encode_basis(basis.content)
            bar.update()
        write_bytes(job.out, data)
        return BasisReport(
            bytes=len(data),
            basis=basis.name,
            digest=basis.digest.hex(),
            points=len(basis.mean),
            modes=len(basis.content.modes),
        )

    def text(self, report: BasisReport, out: Path) -> str:
        what = f"{report.points:,} points, {report.modes} modes"
        return f"{out}: {report.bytes:,} bytes, {what}: {report.basis} {report.digest}"
