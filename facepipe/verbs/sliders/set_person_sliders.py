"""Sets the sliders of a face to a person's own values."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from facepipe.core.arrays import FloatArray
from facepipe.core.errors import InputError
from facepipe.parts import Recipe
from facepipe.payload.person_rig import PersonRig
from facepipe.rig import set_face
from facepipe.stage import Face
from facepipe.stage.author_changes import author_changes
from facepipe.stage.face import play
from facepipe.verbs.person_sliders import person_sliders, shows_people
from facepipe.verbs.sliders.author_sliders import SetSliders, SetSlidersReport

_WITHIN_MM = 0.3  # that a point may be off


@dataclass(frozen=True, kw_only=True)
class PersonSlidersReport(SetSlidersReport):
    """What was authored, and how near the person is."""

    section_bytes: int  # of what sliders leave
    sliders_mean_mm: float  # of the skin: what the sliders leave
    sliders_max_mm: float
    mean_mm: float  # what is left with the section
    max_mm: float

    def as_text(self, out: Path) -> str:
        """For people."""
        off = sum(bool(value) for value in self.values.values())
        return (
            f"{out}: {off} of {len(self.values)} sliders off their defaults leave {self.sliders_mean_mm:.2f} mm "
            f"(mean), at most {self.sliders_max_mm:.2f} mm, which is in a section of {self.section_bytes:,} bytes, "
            f"and leaves {self.mean_mm:.2f} mm, at most {self.max_mm:.2f} mm"
        )


@dataclass(frozen=True, kw_only=True)
class SetPersonSliders:
    """The values of a person, and the section that is what they leave.

    :param person: payload (.fpb) or face, on the built-in head's basis
    :param name: of the animation, as of `SetSliders`
    """

    person: Path
    name: str = "sliders"

    def __call__(self, face: Face, *, recipe: Recipe | None = None) -> PersonSlidersReport:
        """Author values, section and pose.

        :raises InputError: a face without sliders of modes, a person that can't be read, or what `SetSliders` refuses
        :raises TopologyError: a person of another topology
        """
        if not shows_people(face.parts()):
            what = "no sliders over modes of the built-in head, expected those of `facepipe sample`"
            raise InputError(face.where, what)
        points, rig = self._person()
        found = person_sliders(face.sliders, points, within=_WITHIN_MM, rig=rig)
        changed, report = SetSliders(values=found.values, reset=True, name=self.name).changed(face)
        authored = author_changes(face, replace(changed, person_basis=found.basis, recipe=recipe or changed.recipe))
        play(face, self.name)
        off, left = (np.linalg.norm(one[found.rows], axis=1) for one in (found.sliders_left, found.left))
        return PersonSlidersReport(
            **{field.name: getattr(report, field.name) for field in fields(report)} | {"authored": authored},
            section_bytes=len(found.basis.section),
            sliders_mean_mm=float(off.mean()),
            sliders_max_mm=float(off.max()),
            mean_mm=float(left.mean()),
            max_mm=float(left.max()),
        )

    def _person(self) -> tuple[FloatArray, PersonRig | None]:
        """(n, 3) whole points of the person, millimetres, and its rig."""
        from facepipe.importers import read_face
        from facepipe.payload.person import decode_person
        from facepipe.verbs.bone_payload import payload_bytes
        from facepipe.verbs.person_basis import head_basis
        from facepipe.verbs.person_rig import rig_of
        from facepipe.verbs.whole_faces import whole_points

        basis = head_basis()
        if self.person.suffix.lower() == ".fpb":
            content = decode_person(payload_bytes(self.person), self.person)
            return basis.rebuilt(content, self.person), content.rig
        parts = read_face(self.person).parts()
        return whole_points(basis.known(set_face(parts).parts, str(self.person))), rig_of(parts)
