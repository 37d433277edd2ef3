"""Shapes that a head of others is given in a host, as `facepipe transfer` gives them."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from facepipe.actions import find_action
from facepipe.core.errors import FacepipeError
from facepipe.core.reports import Report, Watch, unwatched
from facepipe.parts import FaceParts
from facepipe.performing import perform
from facepipe.rig import implausible
from facepipe.rig.plausibility import in_usual_unit
from facepipe.stage import open_face, save_parts


def with_given_shapes(parts: FaceParts, landmarks: Path | None, watch: Watch = unwatched) -> tuple[FaceParts, Report]:
    """The head with those of ARKit's shapes beside its own that it lacks and can have; and what was made.

    :param landmarks: multipie68 in JSON, in the head's coordinates; None: they are found, which needs torch
    :raises FacepipeError: no landmarks, or a head that the built-in one can't be fitted to
    """
    if implausible(parts):  # hosts show heads in any unit; the fit finds it, and would warn of it
        parts = in_usual_unit(parts)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        head, out = Path(folder) / "head.usdc", Path(folder) / "with_shapes.usdc"
        save_parts(parts, head)
        kind = find_action("transfer")
        assert kind is not None
        action = kind(head=head, landmarks=landmarks, only=("shapes",))  # type: ignore[call-arg]
        try:
            report = perform(action, out, watch=watch).report
        except FacepipeError as error:  # the host knows the head, and not its file
            raise type(error)(error.where.replace(f"{head} -> </{parts.name}>", parts.name), error.what) from None
        warnings = tuple(line.replace(f"</{parts.name}>", parts.name) for line in report.warnings)
        return open_face(out).parts(), replace(report, warnings=warnings)
