"""List the sliders of a face, author them from a table, make them from its blendshapes, or set them.

--from authors the sliders of a .toml or .csv table: what each drives, by how much, its range, default, group and the
slider of the other side. Sliders of the same names are replaced; with --replace the table's are all that the face has.

--from-shapes makes sliders that move the bones as the face's blendshapes move it, all or those of PATTERNS
(names, comma between). Two that differ in the last word alone (nose_hump_decr, nose_hump_incr) are the ends of a slider
from -1 to 1, others go from 0 to 1; shapes of the left and the right get mirrored poses. The report gives what bones
reach, in millimetres. Exit code 1: done, but sliders were left out whose bones reach less than --least-reach.

--from-network puts a learned network beside the sliders: from the values of some it adds to bone coefficients and shape
weights. The .npz file holds sliders, outputs (joint:channel or shape:NAME), layer0.weight, layer0.bias and so on.

--person sets the values that a person has as its own, of a payload (.fpb) or a face of the built-in head: measures show
what it measures, identity sliders carry the rest, and what even they leave is the neutral, as bytes on the stage.

--set writes slider values and poses the face: a SkelAnimation of all that its sliders drive, which the skeleton plays.
Sliders that are not named keep their values. Exit code 1: done, but the pose is beyond the bone limits of FACE.

OUT is an override layer over FACE.

examples:
  facepipe sliders head.usdc
  facepipe sliders head.usdc --from table.toml -o controls.usda
  facepipe sliders head.usdc --from-shapes 'nose_*,mouth_*' --limits face_bones.json -o controls.usda
  facepipe sliders head.usdc --from-network learned.npz -o learned.usda
  facepipe sliders head.usdc --person anna.fpb -o anna.usdc
  facepipe sliders head.usdc --set noseWidth=0.8 --set browArchLeft=1 --mirror -o person.usdc
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.core.errors import InputError
from facepipe.declare import named_numbers, option, source, values_of
from facepipe.kinds import Job, StageAction, action
from facepipe.verbs.fit_bones.options import LIMIT_RULES, read_rules
from facepipe.verbs.sliders.options import ShapeSliderOptions

if TYPE_CHECKING:
    from facepipe.core.reports import Report
    from facepipe.stage import Face
    from facepipe.verbs.fit_bones.limits import LimitRules
else:
    LimitRules = Any


@action("sliders", "list, author or set sliders", remote=True)
@dataclass(frozen=True, kw_only=True)
class SlidersOfFace(ShapeSliderOptions, StageAction["Report"]):
    """The action."""

    face: Path = source("face stage")
    table: Path | None = source("sliders to author: .toml or .csv", default=None, flag="--from", metavar="TABLE")
    network: Path | None = source(
        "learned network to put beside the sliders: .npz", default=None, flag="--from-network", metavar="NPZ"
    )
    person: Path | None = source(
        "person whose own values to set: .fpb, or a face", default=None, flag="--person", metavar="FILE", before=None
    )
    shapes: str | None = option(
        None,
        "sliders to make of blendshapes, all or those of these names",
        flag="--from-shapes",
        metavar="PATTERNS",
        alone="*",
    )
    drop: bool = option(False, "with --from and --from-shapes: drop the sliders that FACE has", flag="--replace")
    values: Mapping[str, float] = option(
        dict, "slider value", flag="--set", metavar="SLIDER=VALUE", parse=named_numbers
    )
    mirror: bool = option(False, "with --set: also the slider of the other side")
    reset: bool = option(False, "all other sliders to their defaults")
    name: str = option("sliders", "name of the pose")
    limits: LimitRules | None = option(
        None,
        "with --from-shapes: limits of the bones over those of the rig, as in docs/bones.md (default none)",
        metavar="JSON",
        parse=read_rules,
        value=LIMIT_RULES,
    )

    @property
    def ways(self) -> tuple[str, ...]:
        """The flags of what is to be done; one, where the action is whole."""
        given = {
            "--from": self.table,
            "--from-shapes": self.shapes,
            "--from-network": self.network,
            "--person": self.person,
        }
        setting = ("--set",) if self.values else ("--reset",) if self.reset else ()
        return (*(flag for flag, value in given.items() if value is not None), *setting)

    @classmethod
    def line_values(cls, arguments: Any, values: dict[str, Any]) -> dict[str, Any]:
        for name in (*(field.name for field in dataclasses.fields(ShapeSliderOptions)), "limits"):
            if hasattr(arguments, name) and values.get("shapes") is None:
                flag = f"--{name.replace('_', '-')}"
                raise InputError(flag, "given without --from-shapes, expected both or neither")
        return values

    def check(self) -> None:
        super().check()
        ways = self.ways
        if not ways:
            ways_there = "--from, --from-shapes, --from-network, --person or --set"
            raise InputError("sliders", f"nothing to do, expected {ways_there}")
        if len(ways) > 1:
            raise InputError(ways[0], f"given with {ways[1]}, expected only one of them")
        if self.drop and ways[0] not in ("--from", "--from-shapes"):
            raise InputError("--replace", "given without --from or --from-shapes, expected both or neither")
        if self.mirror and not self.values:
            raise InputError("--mirror", "given without --set, expected both or neither")

    def author(self, face: Face, job: Job) -> Report:
        if self.shapes is not None:
            from facepipe.verbs.fit_bones.limits import LimitRules
            from facepipe.verbs.sliders.from_shapes import SlidersFromShapes

            maker = SlidersFromShapes(
                **values_of(ShapeSliderOptions, self),
                shapes=self.shapes or "",
                limits=self.limits or LimitRules(),
                drop=self.drop,
            )
            with job.watch("fit", len(maker.chosen(face))) as bar:
                report = maker(face, recipe=job.recipe(), done=bar.update)
            if not report.sliders:
                what = "bones reach no shape, expected some that they can (or --residual, or a lower --least-reach)"
                raise InputError(face.where, what)
            return report
        if self.network is not None:
            from facepipe.importers.slider_network import read_network
            from facepipe.verbs.sliders.author_sliders import AuthorNetwork

            if self.network.suffix.lower() != ".npz":
                raise InputError(self.network, f"suffix '{self.network.suffix[:20]}', expected .npz")
            network = read_network(self.network, face.skeleton.joints, face.shapes)
            return AuthorNetwork(network=network)(face, recipe=job.recipe())
        if self.table is not None:
            from facepipe.verbs.sliders.author_sliders import AuthorSliders
            from facepipe.verbs.sliders.tables import read_table

            return AuthorSliders(table=read_table(self.table), drop=self.drop)(face, recipe=job.recipe())
        if self.person is not None:
            from facepipe.verbs.sliders.set_person_sliders import SetPersonSliders

            return SetPersonSliders(person=self.person, name=self.name)(face, recipe=job.recipe())
        from facepipe.core.names import named
        from facepipe.verbs.sliders.author_sliders import SetSliders

        values = named(self.values, [slider.name for slider in face.sliders], "--set", "slider")
        settings = SetSliders(values=values, mirror=self.mirror, reset=self.reset, name=self.name)
        return settings(face, recipe=job.recipe(replace(self, values=values)))

    def missed(self, report: Any) -> bool:
        return bool(
            report.left_out if self.shapes is not None else (self.values or self.reset) and report.beyond_limits
        )
