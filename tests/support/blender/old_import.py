"""A face imported several times: FACE ANSWER. What names say of its objects is compared with what Blender says."""

from typing import Any

from session import ARGUMENTS, answer, bpy, np

from facepipe_blender import hook  # isort: skip  (the add-on must be registered)
from facepipe_blender.import_stage import _objects  # isort: skip

import_faces = hook.import_faces
same = []


def compared(stage: Any, prim_map: Any) -> tuple[str, ...]:
    """Import by names alone, as for a Blender that says nothing."""
    from facepipe.hosting.host_face import faces_on

    said, named = {str(path): list(ids) for path, ids in prim_map.items()}, hook.objects_by_name(stage)
    for face in faces_on(stage):
        same.append(len(_objects(face, named)[1]) > 1 and _objects(face, said) == _objects(face, named))
    return import_faces(stage, named)


hook.import_faces = compared
for _ in range(3):
    bpy.ops.wm.usd_import(filepath=ARGUMENTS[0])
answer(same=np.array(same))
