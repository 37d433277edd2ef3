"""Messages where the user of Blender looks: one line each in the status bar and the Info editor."""

from __future__ import annotations

import sys
from collections.abc import Iterable

import bpy

_waiting: list[tuple[str, str]] = []


def tell(lines: Iterable[str], *, error: bool = False) -> None:
    """Show lines. USD hooks may run beside Blender's main thread, so that this waits for it where there is a window."""
    for line in lines:
        print(f"facepipe: {line}", file=sys.stderr)
        _waiting.append(("ERROR" if error else "WARNING", line))
    if bpy.app.background:
        _waiting.clear()
    elif not bpy.app.timers.is_registered(_show):
        bpy.app.timers.register(_show)


def _show() -> None:
    while _waiting:
        kind, line = _waiting.pop(0)
        bpy.ops.facepipe.tell("INVOKE_DEFAULT", kind=kind, line=line)


class FACEPIPE_OT_tell(bpy.types.Operator):  # noqa: N801  (Blender's way to name operators)
    """Show a message of facepipe"""

    bl_idname = "facepipe.tell"
    bl_label = "facepipe"
    bl_options = {"INTERNAL"}  # noqa: RUF012

    kind: bpy.props.StringProperty()  # type: ignore[valid-type]
    line: bpy.props.StringProperty()  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Report the line; an error is shown as a popup too."""
        self.report({self.kind}, self.line)
        return {"FINISHED"}
