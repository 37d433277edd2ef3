"""Every place where a file says a path or a URL, or where a name is looked for: who reads it, and the check it passes.

`docs/path_pages.py` makes a page of this, with the options of commands. A test holds that each check is called where it
is said here, and that nothing else outside of `facepipe.core` opens, lists or looks at files unseen.
"""

from __future__ import annotations

from typing import NamedTuple


class FileField(NamedTuple):
    """What a file says, or what is looked for beside it."""

    file: str
    field: str
    reader: str  # module:function
    check: str  # the function that it calls before anything is opened, listed or made; empty: nothing is
    rule: str


_BELOW = "below the roots of the file or its folder, links followed"
_STAGES = "stages are read anywhere; all else " + _BELOW
_READ = "anywhere; within the roots where reads are confined"
_WRITTEN = "below the roots, links followed"
_CHOSEN = "below the project's folder or given roots; below its own roots where FACEPIPE_PROJECT names it"
_CONFORMS = "no file: a text for people"
_FOUND = "in the folder; a link in it leads below the roots or stays in it"
_URL = "below a root that the caller gave"
_REACHED = "below the roots, of files and of URLs (`Reach`); else the task is done again"

FIELDS = (
    # stages
    FileField(
        "USD layer", "subLayers, references, payloads", "facepipe.stage.layer_files:open_layer", "check_regular", _READ
    ),
    FileField("USD layer", "clips", "facepipe.stage.layer_files:_check_clips", "check_readable", _READ),
    FileField("USD layer", "asset values: textures", "facepipe.stage.assets:copy_refusal", "check_copied", _BELOW),
    FileField(
        "USD layer",
        "facepipe:neuralRig:file",
        "facepipe.stage.neural_rig_link:read_neural_rig_link",
        "copy_refusal",
        _BELOW,
    ),
    FileField("USD layer", "facepipe:photo:image", "facepipe.stage.photos:read_photo", "", _CONFORMS),
    # recipes
    FileField("recipe", "sources, to cook", "facepipe.cooking.graph:read_node", "named_source", _STAGES),
    FileField("recipe", "sources, to edit or make again", "facepipe.performing:_places", "named_source", _STAGES),
    FileField("recipe", "sources", "facepipe.stage.recipes:named_source", "check_copied", _STAGES),
    FileField("folder of photos", "photos, of a recipe's source", "facepipe.stage.recipes:_photos", "files_in", _FOUND),
    FileField("recipe", "results", "facepipe.cooking.graph:_writable", "is_writable", _WRITTEN),
    # projects
    FileField(
        "facepipe.toml",
        "roots",
        "facepipe.core.project:_read",
        "is_url",
        "folders; they count where FACEPIPE_PROJECT names it",
    ),
    FileField("facepipe.toml", "names, defaults", "facepipe.cli.project_words:_seen", "file_chosen", _CHOSEN),
    FileField(
        "project of a rebuild",
        "template, database, scan, landmarks",
        "facepipe.processors.rebuild.project:_file",
        "file_named",
        _BELOW,
    ),
    FileField(
        "project of a rebuild", "work", "facepipe.processors.rebuild.project:read_project", "check_writable", _WRITTEN
    ),
    FileField(
        "work folder",
        "results of steps",
        "facepipe.processors.rebuild.steps:WorkFolder.place",
        "check_writable",
        _WRITTEN,
    ),
    FileField(
        "work folder", "corrections", "facepipe.processors.rebuild.steps:WorkFolder.correction", "check_found", _FOUND
    ),
    FileField(
        "work folder",
        "corrections, all",
        "facepipe.processors.rebuild.steps:WorkFolder.corrections",
        "check_found",
        _FOUND,
    ),
    # other formats
    FileField("glTF", "buffers uri, images uri", "facepipe_gltf.read.document:_beside", "check_copied", _BELOW),
    FileField(
        "glTF that is written",
        "names of its buffers and images",
        "facepipe_gltf.writer:_write_gltf",
        "check_written",
        _WRITTEN,
    ),
    FileField("OBJ, MTL", "mtllib, map_Kd", "facepipe.importers.materials_mtl:_beside", "check_copied", _BELOW),
    FileField("ONNX", "external_data location", "facepipe_onnx.read:_tensor_problem", "", "refused, whatever it says"),
    FileField("landmarks JSON", "image", "facepipe.processors.photo_fit.landmark_file:read_landmarks", "", _CONFORMS),
    # what lies in a folder, or beside a file
    FileField("folder of shapes", "*.obj", "facepipe.importers.obj:_files", "files_in", _FOUND),
    FileField("folder of shapes", "landmarks.json", "facepipe.importers.obj:read", "file_beside", _FOUND),
    FileField("folder of ICT-FaceKit", "FaceXModel", "facepipe.importers.ict_model:read_model", "check_found", _FOUND),
    FileField("folder of ICT-FaceKit", "*.obj", "facepipe.importers.ict_model:_read_folder", "file_beside", _FOUND),
    FileField("folder of photos", "photos", "facepipe.processors.scan_photos.photos:photo_files", "files_in", _FOUND),
    FileField("folder of masks", "masks", "facepipe.processors.scan_photos.photos:_mask", "file_beside", _FOUND),
    FileField(
        "folder of people", "photos", "facepipe.processors.photo_fit.train_photo_action:_photos", "files_in", _FOUND
    ),
    FileField(
        "photo", "*.landmarks.json", "facepipe.processors.photo_fit.train_photo_action:_photos", "file_beside", _FOUND
    ),
    FileField(
        "scan", "*.landmarks.json", "facepipe.processors.rebuild.scan_input:landmark_file", "file_beside", _FOUND
    ),
    FileField(
        "scan of a project", "*.landmarks.json", "facepipe.processors.rebuild.project:_scan", "file_beside", _FOUND
    ),
    FileField("network", "*.onnx.json", "facepipe.learn.features.description:describe", "file_beside", _FOUND),
    FileField("graph", "*.onnx.json", "facepipe_onnx.read:_sidecar_problems", "file_beside", _FOUND),
    FileField("graph that is shown", "*.onnx.json", "facepipe_web.viewer:_entry", "check_found", _FOUND),
    # where results go, with what is written beside them
    FileField("result", "files, and folders of reports", "facepipe.core.atomic:_real", "check_written", _WRITTEN),
    FileField("result", "before any work", "facepipe.stage.outputs:check_output", "check_written", _WRITTEN),
    FileField("result", "NAME_textures", "facepipe.stage.textures:TextureFolder.add", "check_written", _WRITTEN),
    FileField("result", "locks", "facepipe.core.locks:locked", "check_written", _WRITTEN),
    # batches
    FileField("plan", "csv at a URL", "facepipe.farm.table:_of_csv", "checked", _URL),
    FileField("plan", "csv", "facepipe.farm.table:_of_csv", "check_copied", _BELOW),
    FileField("plan", "glob at a URL", "facepipe.farm.table:_of_glob", "checked", _URL),
    FileField("plan", "glob", "facepipe.farm.table:_matching", "check_copied", _BELOW),
    FileField("plan", "out", "facepipe.farm.plan:read_plan", "check_writable", _WRITTEN),
    FileField("plan", "results", "facepipe.farm.work:_check_places", "is_writable", _WRITTEN),
    FileField("state folder", "itself", "facepipe.farm.batch:batch", "check_written", _WRITTEN),
    FileField("ledger", "reads, writes", "facepipe.farm.run:Run._last", "", _REACHED),
    FileField("cache of results", "writes", "facepipe.farm.cache:Cache.fetch", "is_writable", _WRITTEN),
)
