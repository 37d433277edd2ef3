"""Variants of the materials of a glTF file. Source: KHR_materials_variants."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from facepipe.core import tokens
from facepipe.core.errors import InputError
from facepipe.core.names import handles
from facepipe.stage.material_variants import MOST_VARIANTS, check_variants
from facepipe_gltf.materials import VARIANTS
from facepipe_gltf.read.document import Document, Value, given_name, quote

_LISTED = 4
_NONE = -1  # a primitive without a material
_Row = tuple[tuple[int, int], ...]  # variant and material, where that is another than the primitive's own


@dataclass
class Variants:
    """Which material each primitive has, and what variants show in its place.

    Primitives of one material that variants change otherwise have materials of their own on the face, whose variants
    are by material: numbers beyond those of the document stand for more of the same.
    """

    document: Document
    names: tuple[str, ...] = ()
    twins: list[int] = field(default_factory=list)  # the document's material, or none, of each number beyond
    faults: dict[str, InputError] = field(default_factory=dict)  # what can't be of the mappings, by where
    _numbers: dict[tuple[int, _Row], int] = field(default_factory=dict)
    _rows: dict[int, _Row] = field(default_factory=dict)  # by number, of those that change
    _taken: set[int] = field(default_factory=set)

    def number(self, primitive: Value) -> int:
        """The material of a primitive; -1 for none.

        :raises InputError: no material of the document
        """
        document, reference = self.document, primitive.get("material")
        material = _NONE if reference is None else document.index("materials", reference)
        row = self._row(primitive, material) if self.names else ()
        key = (material, row)
        if key not in self._numbers:
            if material in self._taken or (row and material == _NONE):
                self._numbers[key] = len(document.entries("materials")) + len(self.twins)
                self.twins.append(material)
            else:
                self._numbers[key] = material
                self._taken.add(material)
            if row:
                self._rows[self._numbers[key]] = row
        return self._numbers[key]

    def value(self, number: int) -> Value:
        """The material of the document that a number stands for; of none an empty one."""
        entries = self.document.entries("materials")
        own = self.twins[number - len(entries)] if number >= len(entries) else number
        return Value({}, self.document.root.trail) if own == _NONE else entries[own]

    def by_material(self) -> list[list[int]]:
        """All numbers that stand for each material of the document."""
        count = len(self.document.entries("materials"))
        numbers = [[number] for number in range(count)]
        for place, own in enumerate(self.twins):
            if own != _NONE:
                numbers[own].append(count + place)
        return numbers

    def others(self, number: int) -> list[int]:
        """What variants show in place of a material."""
        return list(dict.fromkeys(material for _, material in self._rows.get(number, ())))

    def shown(self, number: int, called: Sequence[str]) -> dict[str, str]:
        """Variant -> name of the material that it shows in place of another; empty where none changes it.

        :param called: names of materials by number
        """
        row = dict(self._rows.get(number, ()))
        return {name: called[row.get(place, number)] for place, name in enumerate(self.names)} if row else {}

    def note(self, bound: Sequence[int], bindings: int, *, ours: bool) -> None:
        """Name in a warning what becomes of the variants; where that is too much for a face, they are left out.

        :param bound: the materials in use
        :param bindings: meshes and parts of meshes
        :param ours: facepipe wrote them
        """
        if not self.names:
            return
        document = self.document
        said = f"{len(self.names)} variant{'s' * (len(self.names) > 1)}"
        if self._rows.keys().isdisjoint(bound):
            document.warn("materials", f"{said} left out: no triangles have another material in them")
            return
        try:
            check_variants("materials", len(self.names), bindings)
        except InputError as error:
            document.warn(error.where, f"{error.what}: left out")
            self.names = ()
            self._rows.clear()
            return
        if not ours:
            few = [name if name.isprintable() and len(name) < 40 else quote(name) for name in self.names[:_LISTED]]
            whole = len(self.names) == len(few) > 1
            listed = f"{', '.join(few[:-1])} and {few[-1]}" if whole else ", ".join(few)
            listed += " ..." * (len(self.names) > len(few))
            document.warn("materials", f"{said}, {listed}, as the variant set {tokens.VARIANTS}")

    def _row(self, primitive: Value, material: int) -> _Row:
        row: dict[int, int] = {}
        said = primitive.extension(VARIANTS)
        try:
            mappings = [] if said is None else said.require("mappings").items()
        except InputError as error:
            self.faults[str(error.where)] = error
            return ()
        for mapping in mappings:
            try:
                other = self.document.index("materials", mapping.require("material"))
                for entry in mapping.require("variants").items():
                    variant = entry.integer()
                    if variant >= len(self.names):
                        raise entry.error(f"{variant}, but there are {len(self.names)} variants")
                    if row.setdefault(variant, other) != other:
                        raise entry.error("a variant that has another material here already")
            except InputError as error:
                self.faults[str(error.where)] = error
        return tuple(sorted((variant, other) for variant, other in row.items() if other != material))


def read_variants(document: Document) -> Variants:
    """The variants of a document, with a number for the material of each primitive; what can't be is left out with a
    warning.

    :raises InputError: a mesh or primitive that is none, or a material that is not there
    """
    found = Variants(document)
    said = document.root.extension(VARIANTS)
    if said is None:
        return found
    try:
        entries = said.require("variants").items()
        if len(entries) > MOST_VARIANTS:
            raise said.error(f"{len(entries)} variants, expected at most {MOST_VARIANTS}")
    except InputError as error:
        document.warn(error.where, f"{error.what}: variants left out")
        return found
    given = []
    for entry in entries:
        try:
            given.append(given_name(entry) or "")
        except InputError as error:
            found.faults[str(error.where)] = error
            given.append("")
    for name, count in Counter(given).items():
        if count > 1 or not name:
            called = f"called {quote(name)}" if name else "without a name"
            document.warn(said, f"{count} variant{'s' * (count > 1)} {called}, expected names of their own: made up")
    found.names = handles(given, "variant")
    for mesh in document.entries("meshes"):
        for primitive in mesh.get_or("primitives", []).items():
            found.number(primitive)
    for fault in [*found.faults.values()][:_LISTED]:
        document.warn(fault.where, f"{fault.what}: left out")
    if len(found.faults) > _LISTED:
        document.warn(said, f"{len(found.faults) - _LISTED} further names and mappings left out")
    return found
