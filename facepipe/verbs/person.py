"""Write who a face is as a few hundred bytes, for a device that has the head that people are made of.

The person of FACE, with what sliders and bones make of it, by the modes of a basis: those of the built-in head, of
--database, or none where --template gives a face to start from. What modes leave of it is sent as points by levels,
as many and as fine as --within asks for, or as --bytes allow; of blends and scans also how joints rest and shapes turn.
`facepipe apply-bones HEAD OUT` rebuilds it.

examples:
  facepipe person anna.usdc -o anna.fpb
  facepipe person anna.usdc -o anna.fpb --within 0.3
  facepipe person anna.usdc -o anna.fpb --bytes 1300
  facepipe person anna.usdc -o anna.fpb --look
  facepipe person bob.usdc -o bob.fpb --database people.fpdb
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.core.reports import Report, table
from facepipe.declare import option, source
from facepipe.kinds import FileAction, Job, action

if TYPE_CHECKING:
    from facepipe.core.arrays import FloatArray
    from facepipe.parts import FaceParts
    from facepipe.payload.person_rig import PersonRig
    from facepipe.verbs.person_basis import Basis
    from facepipe.verbs.person_layers import PersonLayer

_WITHIN_MM = 1.0
_RIG_SHARE = 0.03  # of --bytes that the rig may take: points are worth more of few


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
    mean_mm: float  # of what a reader makes of the bytes
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
    look: bool = option(False, "with how the built-in head looks: skin, hair, eyes")
    textures: int = option(
        0, "with pictures of the skin of so many texels a side (512, 1024); 0: none", 0, 4096, "texels"
    )
    coefficients: Path | None = source(
        "bone coefficients to send with the person (.fpb)", default=None, flag="--coefficients", metavar="FPB"
    )

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
            more = self._more(parts)
            data, report = encoded_person(parts, str(self.face), within=self.within, most=self.most, more=more, **how)
            bar.update()
        write_bytes(job.out, data)
        return report

    def _more(self, parts: FaceParts) -> dict[str, Any]:
        """Of `PersonContent`, what is asked for beside the shape."""
        more = dict[str, Any]()
        if self.look:
            from facepipe.heads.look_code import encode_look
            from facepipe.verbs.person_basis import is_head
            from facepipe.verbs.person_look import look_of

            if not is_head(parts, str(self.face)):
                raise InputError("--look", f"{self.face} is not the built-in head, expected it")
            more["look"] = encode_look(look_of(parts))
        if self.textures:
            from facepipe.verbs.person_look import pictures_of

            more["pictures"] = pictures_of(parts, self.textures)
        if self.coefficients is not None:
            from facepipe.payload import decode
            from facepipe.verbs.bone_payload import payload_bytes

            more["coefficients"] = payload_bytes(self.coefficients)
            decode(more["coefficients"], parts.skeleton.joints, self.coefficients)
        return more

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
    more: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[bytes, PersonReport]:
    """The payload of who a face is set to, and its report.

    :param within: millimetres; where there is no `most` either, what the command has as its default
    :param most: bytes
    :param more: of `PersonContent`, what goes with the shape
    :raises InputError: a face without a basis, or fewer bytes than the person takes
    """
    from facepipe.rig import set_points
    from facepipe.verbs.person_basis import basis_of, head_basis
    from facepipe.verbs.person_rig import rig_of
    from facepipe.verbs.whole_faces import whole_points

    basis = basis_of(parts, where, template=template, database=database)
    points = whole_points(basis.known(set_points(parts), where))
    rig = rig_of(parts) if basis is head_basis() else None
    return encoded_whole(basis, points, where, rig=rig, within=within, most=most, more=more)


def encoded_whole(
    basis: Basis,
    points: FloatArray,
    where: str,
    *,
    rig: PersonRig | None,
    within: float | None = None,
    most: int | None = None,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[bytes, PersonReport]:
    """The payload of whole points (n, 3) of the basis's meshes, and its report, as `encoded_person` has them.

    :param rig: how the face's joints rest and shapes go
    """
    import numpy as np

    from facepipe.payload.person import PersonContent, decode_person, encode_person
    from facepipe.verbs.person_layers import encode_points

    within = _WITHIN_MM if within is None and most is None else within
    nobody = PersonContent(basis=basis.digest, modes=np.zeros(0))

    def size(**sections: Any) -> int:
        return len(encode_person(replace(nobody, **sections))) - len(encode_person(nobody))

    if rig is not None and (most is None or size(rig=rig) <= _RIG_SHARE * most):
        more = {**more, "rig": rig}
    beside = size(**more)
    spare = None if most is None else most - beside
    data, layers = encode_points(basis, points, within=within, most=spare)
    if more:
        data = encode_person(replace(decode_person(data, where), **more))
    if most is not None and len(data) > most:
        raise InputError("--bytes", f"{most}, expected at least the {len(data)} that this person takes")
    told = tuple(Layer.of(one, points) for one in layers)
    last = told[-1]
    if "rig" in more:
        told += (replace(last, name="rig", bytes=last.bytes + size(rig=more["rig"])),)
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
