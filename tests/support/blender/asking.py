"""The export as the panel starts it, without a window: FACE FOLDER ANSWER. What it asks is answered."""

from types import SimpleNamespace
from typing import Any

from session import ARGUMENTS, answer, bpy, np

from facepipe_blender import panel  # isort: skip  (the add-on must be registered)

face, folder = ARGUMENTS[:2]
bpy.ops.wm.usd_import(filepath=face)
bpy.context.view_layer.objects.active = bpy.data.objects["Head"]
asked: list[str] = []


def export(how: str, **settings: Any) -> None:
    """Stands for the operator that is called again to ask."""
    asked.append(f"{how} {settings['file_name']} ask={settings['ask']}")


def confirm(operator: Any, event: None, *, title: str, message: str) -> set[str]:
    """Stands for the question that a window shows."""
    asked.append(f"{title} {message}")
    return {"RUNNING_MODAL"}


panel.bpy = SimpleNamespace(path=bpy.path, ops=SimpleNamespace(facepipe=SimpleNamespace(export=export)))
manager = SimpleNamespace(invoke_confirm=confirm, fileselect_add=lambda operator: asked.append("folder?"))
window = SimpleNamespace(window_manager=manager)
operator = SimpleNamespace(directory=folder, file_name="hero", sliders=False, overwrite=False, ask=False)
operator.options = SimpleNamespace(is_invoke=True)
panel.FACEPIPE_OT_export.invoke(operator, window, None)
assert panel.FACEPIPE_OT_export.execute(operator, bpy.context) == {"CANCELLED"}
assert not operator.overwrite
operator.ask = True
panel.FACEPIPE_OT_export.invoke(operator, window, None)
assert operator.overwrite
answer(asked=np.array(asked))
