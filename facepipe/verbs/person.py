"""Write who a face is as a few hundred bytes, for a device that has the head that people are made of.

The person of FACE, with what sliders and bones make of it, by the modes of a basis: those of the built-in head, of
--database, or none where --template gives a face to start from. What modes leave of it is sent as points by levels,
as many and as fine as --within asks for, or as --bytes allow. `facepipe apply-bones HEAD OUT` rebuilds it.

examples:
  facepipe person anna.usdc -o anna.fpb
  facepipe person anna.usdc -o anna.fpb --within 0.3
  facepipe person anna.usdc -o anna.fpb --bytes 1300
  facepipe person bob.usdc -o bob.fpb --database people.fpdb
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe.core.errors import InputError
from facepipe.core.reports import Report, table
from facepipe.declare import option, source
from facepipe.kinds import FileAction, Job, action

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.parts import FaceParts
    from facepipe.verbs.person_layers import PersonLayer

_WITHIN_MM = 1.0


@dataclass(frozen=True, kw_only=True)
class Layer:
    """What a layer of a payload adds."""

    name: str
    bytes: int
    mean_mm: (
        float  # distance of the points that the payload gives from the face's own, with this layer and those before
    )
    max_mm: float

    @classmethod
    def of(cls, layer: PersonLayer, points: FloatArray) -> Layer:
        """What it leaves of points (n, 3)."""
        import numpy as np

        off = np.linalg.norm(layer.points - points, axis=1)
        return cls(name=layer.name, bytes=layer.bytes, mean_mm=float(off.mean()), max_mm=float(off.max()))


@dataclass(frozen=True, kw_only=True)
class PersonReport(Report):
    """A person as a payload."""

    bytes: int
    basis: str  # its name
    digest: str  # hexadecimal
    layers: tuple[Layer, ...]
    mean_mm: float  # of the bytes as they were written, read back
    max_mm: float
    missed: bool = False  # --within is more than the payload keeps


@action("person", "write who a face is as a payload of few bytes")
@dataclass(frozen=True, kw_only=True)
class WritePerson(FileAction[PersonReport]):
    """The action."""

    output = "payload to write: .fpb"
    suffixes = (".fpb",)

    face: Path = source("face stage")
    template: Path | None = source(
        "face of the same topology that devices have, where there are no modes", default=None, flag="--template"
    )
    database: Path | None = source(
        "faces of its topology whose modes to use: .fpdb, or their .fpbasis",
        default=None,
        flag="--database",
        metavar="FPDB",
    )
    within: float | None = option(
        None,
        f"how far off a point may be at most (default {_WITHIN_MM:g} without --bytes)",
        1e-3,
        1e3,
        "mm",
        metavar="MM",
    )
    most: int | None = option(None, "size of the payload at most", 64, 1 << 24, "bytes", flag="--bytes", metavar="N")

    def check(self) -> None:
        super().check()
        if self.within is not None and self.most is not None:
            raise InputError("--within", "given with --bytes, expected only one of them")
        if self.template is not None and self.database is not None:
            raise InputError("--template", "given with --database, expected only one of them")

    def write(self, job: Job) -> PersonReport:
        from facepipe.core.atomic import write_bytes
        from facepipe.importers import read_face

        with job.watch("person", 1) as bar:
            parts, how = read_face(self.face).parts(), {"template": self.template, "database": self.database}
            data, report = encoded_person(parts, str(self.face), within=self.within, most=self.most, **how)
            bar.update()
        write_bytes(job.out, data)
        return report

    def text(self, report: PersonReport, out: Path) -> str:
        rows = [(one.name, one.bytes, f"{one.mean_mm:.3f}", f"{one.max_mm:.3f}") for one in report.layers]
        lines = table([("layer", "bytes", "mean mm", "largest mm"), *rows])
        return f"{out}: {report.bytes:,} bytes on {report.basis} {report.digest}\n{lines}"


def encoded_person(
    parts: FaceParts,
    where: str,
    *,
    template: Path | None = None,
    database: Path | None = None,
    within: float | None = None,
    most: int | None = None,
) -> tuple[bytes, PersonReport]:
    """The payload of who a face is set to, and its report.

    :param within: millimetres; where there is no `most` either, what the command has as its default
    :param most: bytes
    :raises InputError: a face without a basis, or fewer bytes than the person takes
    """
    from facepipe.rig import set_face
    from facepipe.verbs.person_basis import basis_of
    from facepipe.verbs.person_layers import encode_points
    from facepipe.verbs.whole_faces import whole_points

    basis = basis_of(parts, where, template=template, database=database)
    points = whole_points(basis.known(set_face(parts).parts, where))
    within = _WITHIN_MM if within is None and most is None else within
    data, layers = encode_points(basis, points, within=within, most=most)
    if most is not None and len(data) > most:
        raise InputError("--bytes", f"{most}, expected at least the {len(data)} that this person takes")
    told = tuple(Layer.of(one, points) for one in layers)
    last = told[-1]
    missed = within is not None and last.max_mm > within
    report = PersonReport(
        bytes=len(data),
        basis=basis.name,
        digest=basis.digest.hex(),
        layers=told,
        mean_mm=last.mean_mm,
        max_mm=last.max_mm,
        missed=missed,
        warnings=(f"{last.max_mm:.2f} mm off where parts keep their shape, more than --within",) if missed else (),
    )
    return data, report
