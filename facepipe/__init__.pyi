# Made by `python schemas/generate.py` of what actions declare.
"""facepipe: face assets from a DCC to a game engine.

    face = facepipe.read("head.glb")                  # a `Face`, the typed view of a USD stage
    facepipe.fit_bones("head.usdc", targets=["smile.usda"], out="fitted.usdc")
    facepipe.export("fitted.usdc", "fitted.glb")

Every action of the command line is a function here: `facepipe blend` is `facepipe.blend`, `facepipe fit-bones`
`facepipe.fit_bones`, with its sources and options as arguments.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from facepipe.api import read as read
from facepipe.api import sample as sample
from facepipe.checks import validate as validate
from facepipe.cooking.cooking import cook as cook
from facepipe.core import __version__ as __version__
from facepipe.core.errors import ExportError as ExportError
from facepipe.core.errors import FacepipeError as FacepipeError
from facepipe.core.errors import FitError as FitError
from facepipe.core.errors import InputError as InputError
from facepipe.core.errors import SchemaError as SchemaError
from facepipe.core.errors import TopologyError as TopologyError
from facepipe.core.reports import Report
from facepipe.exporting import export as export
from facepipe.farm.batch import batch as batch
from facepipe.neural.apply_action import ApplyNeuralRigReport
from facepipe.neural.invert import InverseReport
from facepipe.neural.motion import BakeReport
from facepipe.neural.retarget import RetargetReport
from facepipe.neural.train_neural_rig import NeuralRigReport
from facepipe.photo.fit.report import PhotoFitReport
from facepipe.photo.fit.train_photo_action import TrainPhotoReport
from facepipe.photo.frames.report import ChosenFramesReport
from facepipe.photo.texture.author import BakePhotoReport
from facepipe.scanning.database.database_report import DatabaseReport
from facepipe.scanning.database.info_action import DatabaseInfoReport
from facepipe.scanning.landmarks.find import ScanLandmarksReport
from facepipe.scanning.photos.scan import ScanPhotosReport
from facepipe.scanning.rebuild.fit_neutral import FitNeutralReport
from facepipe.scanning.rebuild.personal_template import PersonalReport
from facepipe.scanning.rebuild.rebuild_report import RebuildReport
from facepipe.scanning.rebuild.refine_neutral import RefineNeutralReport
from facepipe.scanning.rebuild.register_scans import RegisterScanReport
from facepipe.scanning.rebuild.split_expressions import SplitShapesReport
from facepipe.scanning.transfer.transfer import TransferReport
from facepipe.stage.face import Face as Face
from facepipe.stage.face import open_face as open
from facepipe.verbs.animate.face_clip import AnimateReport
from facepipe.verbs.apply_bones import ApplyBonesReport
from facepipe.verbs.basis import BasisReport
from facepipe.verbs.blend.quality import BlendReport
from facepipe.verbs.blend.weights import Weights
from facepipe.verbs.eval import EvalReport
from facepipe.verbs.fit_bones.limits import LimitRules
from facepipe.verbs.fit_bones.target_fits import FitBonesReport
from facepipe.verbs.inspect import InspectReport
from facepipe.verbs.landmarks import LandmarksReport
from facepipe.verbs.lod.levels import LodReport
from facepipe.verbs.person import PersonReport
from facepipe.verbs.regions import RegionsReport
from facepipe.verbs.skin.skinning import SkinReport

__all__ = [
    "ExportError",
    "Face",
    "FacepipeError",
    "FitError",
    "InputError",
    "SchemaError",
    "TopologyError",
    "batch",
    "cook",
    "export",
    "open",
    "read",
    "sample",
    "validate",
]

def animate(
    face: str | os.PathLike[str],
    clip: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    fps: float | None = None,
    angles: Literal["auto", "rad", "deg"] = "auto",
    start: float | None = None,
    end: float | None = None,
    resample: float | None = None,
    offset: float = 0.0,
    head: str | None = None,
    left_eye: str | None = None,
    right_eye: str | None = None,
    name: str | None = None,
) -> AnimateReport:
    """Put a captured performance on a face: `facepipe animate`.

    :param fps: frames per second of CLIP; by default its own, or 60 (a timecode counts frames, not how many make a second)
    :param angles: unit of the turns in CLIP; auto: radians unless they can't be
    :param start: leave out what is before, from the first frame of CLIP [s]
    :param end: leave out what is after, from the first frame of CLIP [s]
    :param resample: frames per second of the result; those of CLIP by default
    :param offset: when the result begins on the stage [s]
    :param head: joint that HeadYaw, HeadPitch and HeadRoll turn, or none; found by its name by default
    :param left_eye: joint that LeftEyeYaw ... turn, or none; as --head
    :param right_eye: joint that RightEyeYaw ... turn, or none; as --head
    :param face: face stage
    :param clip: performance: .csv .tsv .txt .json .jsonl .usd .usda .usdc .usdz .glb .gltf .vrm .fbx
    :param name: name of the animation (default: the file's)
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def apply_bones(
    face: str | os.PathLike[str],
    coefficients: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    database: str | os.PathLike[str] | None = None,
    clamp: bool = False,
    name: str | None = None,
    as_section: bool = False,
) -> ApplyBonesReport:
    """Rebuild a face from bone coefficients: `facepipe apply-bones`.

    :param face: face stage
    :param coefficients: bone coefficients, or a person: .fpb
    :param database: faces whose modes a person is made of: .fpdb, or their .fpbasis
    :param clamp: bring coefficients into the bone limits of FACE
    :param name: name of the animation (default: the file's)
    :param as_section: keep a person as the payload's bytes over FACE's own points
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def bake(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    seed: int = 0,
    spread: int = 1000,
    busy: float = 0.6,
    sweep: int = 8,
    together: int = 500,
    clips: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = (),
) -> BakeReport:
    """Write what a face's rig does as controls and points over time: `facepipe bake`.

    :param seed: another number draws other frames, and another split, network and batches
    :param spread: frames of many controls at once, spread evenly (latin hypercube)
    :param busy: most of the controls that one of those frames moves, as a share; each draws its own, up to it
    :param sweep: frames of each control alone, from one limit to the other
    :param together: frames of two or three controls at once
    :param face: face stage
    :param clips: stage whose clips the face plays too, beside those of its own
    :param out: stage of controls and points over time to write: .usdc .usda .usd .usdz
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def bake_photo(
    stage: str | os.PathLike[str],
    photos: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    similarity_threshold: float | None = None,
    size: int | None = None,
    identity_model: str | os.PathLike[str] | None = None,
    report: str | os.PathLike[str] | None = None,
) -> BakePhotoReport:
    """Bake the colours of photos to a fitted face: `facepipe bake-photo`.

    :param similarity_threshold: similarity of each photo and the render of it to --identity-model (cosine), below which the exit code is 1
    :param stage: face stage that was fitted to the photos
    :param photos: photos that it was fitted to, one or more
    :param size: size of the textures (default that of those they replace) [texels]
    :param identity_model: recognition network that judges how like the photos the result is, .onnx or .pt2
    :param report: folder to make: report and pictures
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def basis(
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    template: str | os.PathLike[str] | None = None,
    database: str | os.PathLike[str] | None = None,
) -> BasisReport:
    """Write what devices need to rebuild persons: `facepipe basis`.

    :param template: face stage that others are sent as points of
    :param database: faces whose modes to use (.fpdb)
    :param out: basis to write: .fpbasis, or .onnx for engines that run graphs
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def blend(
    sources: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    align: str = "landmarks",
    contacts: bool = True,
    edges: Literal["uniform", "cotangent"] = "uniform",
    expressions: Literal["static", "document"] = "static",
    missing: Literal["error", "transfer", "skip"] = "error",
    motion_of: int | None = None,
    static_mm: float = 0.001,
    region_width_mm: float = 0.0,
    keep_shape: str = "auto",
    anchor: str | None = None,
    solver: Literal["auto", "cholespy", "splu"] = "splu",
    weights: Weights | Mapping[str, Any] | None = None,
    match: str | os.PathLike[str] | None = None,
    heatmap: str | os.PathLike[str] | None = None,
    closeup: str | os.PathLike[str] | None = None,
) -> BlendReport:
    """Mix faces by region, with shapes and rig: `facepipe blend`.

    :param align: what each source is moved, turned and scaled onto the first one by: landmarks (nine of nose and eyes, that no expression moves), a region, or none
    :param contacts: skin is held out of eyeballs, teeth, gums and the other lip, but for how deep it lies in them in a source
    :param edges: weights of the edges in the solve: all the same, or cotangents of the mean shape
    :param expressions: points that move in no source: held in the bi-Laplacian solve of each shape, or (document) put back after a free solve
    :param missing: shapes that some sources lack: an error, deformation transfer from those that have it, or skipped
    :param motion_of: source N, from 1, that all shapes come from, whatever the weights
    :param static_mm: a point that moves no further in any source is static [mm]
    :param region_width_mm: width of the harmonic transition put between regions; 0 takes their masks as they are [mm]
    :param keep_shape: meshes whose loose parts keep their shape up to rotation and scale: patterns, comma between; auto: those named like eyeballs and teeth
    :param anchor: MESH:POINT that stays where it is in the first source; default its authored anchor
    :param solver: sparse factorisation: scipy's, or cholespy, whose last digits may differ from run to run
    :param sources: faces or heads; the first gives the mesh, regions, sliders, UVs, materials
    :param weights: 
    :param match: find the weights that come nearest to this face
    :param heatmap: draw the result, coloured by its seam residual
    :param closeup: draw where skin lies deepest in an eyeball, teeth or the other lip
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def choose_frames(
    clip: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    count: int = 5,
) -> ChosenFramesReport:
    """Choose frames of a short video as photos of a person: `facepipe choose-frames`.

    :param clip: short video of one person
    :param count: frames to keep at most
    :param out: folder to make: the frames as PNG, report.json
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def conform(
    head: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    colors: bool = True,
    even: float = 1.0,
    relief: bool = True,
    texture_size: int | None = None,
    unit: Literal["auto", "mm", "cm", "m", "in"] = "auto",
    prior: float = 0.03,
    membrane: float = 6.0,
    landmark_sigma_mm: float = 0.16,
    reach_mm: float = 4.0,
    weight_sigma: float = 0.05,
    template: str | os.PathLike[str] | None = None,
    database: str | os.PathLike[str] | None = None,
    landmarks: str | os.PathLike[str] | None = None,
    weights: Mapping[str, float] = {},
    open_eyes: bool = True,
    close_lips: bool = True,
    picture: str | os.PathLike[str] | None = None,
    own_shapes: bool = False,
    without: Sequence[str] = (),
) -> FitNeutralReport:
    """Give a template the shape of a head of others: `facepipe conform`.

    :param colors: give the skin's textures the scan's colours, where both have some
    :param even: how much of the light in the scan's colours is taken out; 0: as scanned
    :param relief: give the skin's normal maps the scan's detail, where it is finer than the mesh
    :param texture_size: size of the skin's textures (default that of the template's) [texels]
    :param unit: unit of the scan: auto fits the size with the rest, a unit holds it
    :param prior: weight of the squared identity coefficients, in standard deviations, against the scan
    :param membrane: stiffness of what the identity model can't show
    :param landmark_sigma_mm: smaller ones hold landmarks harder against the surface [mm]
    :param reach_mm: points further from the scan don't follow it [mm]
    :param weight_sigma: how far the weight of a shape that the scan shows may be from the given one
    :param template: face stage; landmarks that it lacks are found on it (default the built-in head)
    :param database: faces of the template's topology: .fpdb (default how people differ from the built-in head)
    :param landmarks: landmarks of the scan (default SCAN's .landmarks.json)
    :param weights: shapes that the scan shows besides the neutral, weights above 0 up to 2
    :param open_eyes: open eyes whose lids the landmarks show shut, where no --weights are given
    :param close_lips: close lips whose landmarks meet: of their rims, scans show nothing
    :param picture: draw scan, face and their distance
    :param head: head or body: .glb .gltf .vrm .fbx .obj .ply .stl .off or USD
    :param own_shapes: shapes that HEAD has by any usual name become its own, but for blinks, looks and wide eyes
    :param without: meshes of the template to leave out: of the built-in head Teeth, EyeballLeft ...
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def database_add(
    database: str | os.PathLike[str],
    faces: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    max_surface_mean_mm: float = 0.3,
    max_surface_p95_mm: float = 1.0,
    min_coverage: float = 0.6,
    max_flipped_triangles: int = 20,
    ignore_quality: bool = False,
    drop_shapes: bool = False,
    names: Sequence[str] = (),
    quality: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = (),
) -> DatabaseReport:
    """Put more faces into a database: `facepipe database add`.

    :param max_surface_mean_mm: largest mean distance from the scan of the neutral [mm]
    :param max_surface_p95_mm: largest 95th percentile of that distance [mm]
    :param min_coverage: least share of the face area that the scan shows
    :param max_flipped_triangles: most triangles turned over, in the neutral and its shapes
    :param ignore_quality: add faces that miss the limits too; the history says so
    :param drop_shapes: shapes of the database that a face lacks leave it; otherwise the face is refused
    :param names: names of the faces (default: those of their files)
    :param database: database: .fpdb
    :param faces: face stages of one topology
    :param quality: measures of a face: a JSON report, with several faces NAME=REPORT, once for each
    :param out: write another file (default: in place)
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def database_create(
    faces: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    tolerance_mm: float = 0.1,
    names: Sequence[str] = (),
) -> DatabaseReport:
    """Make a database of face stages: `facepipe database create`.

    :param tolerance_mm: RMS error over all points to which each expression is held; less makes the file larger [mm]
    :param names: names of the faces (default: those of their files)
    :param faces: face stages of one topology
    :param out: database to write: .fpdb
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def database_info(
    database: str | os.PathLike[str],
) -> DatabaseInfoReport:
    """List what is in a database: `facepipe database info`.

    :param database: database: .fpdb
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def database_remove(
    database: str | os.PathLike[str],
    names: Sequence[str],
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> DatabaseReport:
    """Take faces out of a database: `facepipe database remove`.

    :param database: database: .fpdb
    :param names: names of faces, as info lists them
    :param out: write another file (default: in place)
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def eval(
    model: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    weights: Mapping[str, float] = {},
    bones: Mapping[str, float] = {},
    sliders: Mapping[str, float] = {},
) -> EvalReport:
    """Run an exported ONNX file: `facepipe eval`.

    :param weights: shape weight
    :param bones: bone coefficient, channels tx ty tz (stage units) rx ry rz (radians) sx sy sz (factor); JOINT is a path, its last part, or the source's name
    :param sliders: slider value, over those that are set
    :param model: .onnx file of `facepipe export`
    :param out: arrays to write: .npz, one per output of the graph
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def fit_bones(
    rig: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    targets: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    threshold_mm: float = 0.1,
    max_iterations: int = 200,
    rounds: int | None = None,
    regularise: float = 0.0,
    sparsity: float = 0.0,
    symmetric: bool = False,
    residual: bool = False,
    initial: str | None = None,
    limits: LimitRules | Mapping[str, Any] | str | os.PathLike[str] | None = None,
    regions: Mapping[str, float] = {},
    mask: Sequence[str] = (),
    coefficients: str | os.PathLike[str] | None = None,
    precision: Literal["float16", "float32"] = "float32",
    heatmap: str | os.PathLike[str] | None = None,
) -> FitBonesReport:
    """Bring bones to targets, within limits: `facepipe fit-bones`.

    :param threshold_mm: a target is reached where no point is further from it [mm]
    :param max_iterations: steps of a solve, at most
    :param rounds: rounds that even the largest distance, at most, where a target is not reached (default 2; with a residual 0, which keeps it small)
    :param regularise: weight of the mean square strain of the bones beside that of the distances: 0.1 to 1 calms bones that points hardly hold
    :param sparsity: weight of the mean strain: fewer channels move, the others stay exactly at rest; 1 to 20 for some
    :param symmetric: joints of one side move as the mirror image of the other's, paired by names (left and right, L and R); joints in the middle keep to it
    :param residual: keep what bones can't reach as a sparse blendshape TARGET_residual
    :param rig: face stage with joints and skin weights
    :param targets: what to reach
    :param initial: start from the first frame of an animation of RIG or of a payload (default rest)
    :param limits: limits over those of the rig (default none)
    :param regions: how much points of a region or point subset count, 0 or more (default 1)
    :param mask: only points of this region or point subset count (default all do)
    :param coefficients: write the coefficients as a payload: .fpb
    :param precision: of the payload
    :param heatmap: draw the targets that are missed most, coloured by distance
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def fit_neutral(
    scan: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    colors: bool = True,
    even: float = 1.0,
    relief: bool = True,
    texture_size: int | None = None,
    unit: Literal["auto", "mm", "cm", "m", "in"] = "auto",
    prior: float = 0.03,
    membrane: float = 6.0,
    landmark_sigma_mm: float = 0.16,
    reach_mm: float = 4.0,
    weight_sigma: float = 0.05,
    template: str | os.PathLike[str] | None = None,
    database: str | os.PathLike[str] | None = None,
    landmarks: str | os.PathLike[str] | None = None,
    weights: Mapping[str, float] = {},
    open_eyes: bool = True,
    close_lips: bool = True,
    picture: str | os.PathLike[str] | None = None,
) -> FitNeutralReport:
    """Fit a face to the scan of a person: `facepipe fit-neutral`.

    :param colors: give the skin's textures the scan's colours, where both have some
    :param even: how much of the light in the scan's colours is taken out; 0: as scanned
    :param relief: give the skin's normal maps the scan's detail, where it is finer than the mesh
    :param texture_size: size of the skin's textures (default that of the template's) [texels]
    :param unit: unit of the scan: auto fits the size with the rest, a unit holds it
    :param prior: weight of the squared identity coefficients, in standard deviations, against the scan
    :param membrane: stiffness of what the identity model can't show
    :param landmark_sigma_mm: smaller ones hold landmarks harder against the surface [mm]
    :param reach_mm: points further from the scan don't follow it [mm]
    :param weight_sigma: how far the weight of a shape that the scan shows may be from the given one
    :param template: face stage; landmarks that it lacks are found on it (default the built-in head)
    :param scan: scan of the neutral: .ply .obj .stl .off .glb .gltf or USD; or a folder of 5 or more photos
    :param database: faces of the template's topology: .fpdb (default how people differ from the built-in head)
    :param landmarks: landmarks of the scan (default SCAN's .landmarks.json)
    :param weights: shapes that the scan shows besides the neutral, weights above 0 up to 2
    :param open_eyes: open eyes whose lids the landmarks show shut, where no --weights are given
    :param close_lips: close lips whose landmarks meet: of their rims, scans show nothing
    :param picture: draw scan, face and their distance
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def fit_photo(
    face: str | os.PathLike[str] | None = None,
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    photos: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    similarity_threshold: float | None = None,
    iterations: int = 45,
    loss_threshold: float = 0.0,
    optimiser: Literal["adam", "gradient-descent"] = "adam",
    rate: float = 0.04,
    size: int = 192,
    color: float = 6.0,
    content: float = 0.1,
    identity: float | None = None,
    attributes: float | None = None,
    sparsity: float = 0.02,
    expression_sparsity: float = 0.1,
    hue: float = 10.0,
    landmark_sigma: float = 0.02,
    focal_sigma: float = 0.2,
    landmarks: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = (),
    landmarker: str | os.PathLike[str] | None = None,
    database: str | os.PathLike[str] | None = None,
    content_model: str | os.PathLike[str] | None = None,
    identity_model: str | os.PathLike[str] | None = None,
    attribute_model: str | os.PathLike[str] | None = None,
    start: str | os.PathLike[str] | None = None,
    faces: Sequence[int] = (),
    expressions: Sequence[str] | None = None,
    landmark_threshold: float = 8.0,
    landmark_weight: float = 1.0,
    report: str | os.PathLike[str] | None = None,
    person: str | os.PathLike[str] | None = None,
) -> PhotoFitReport:
    """Find a person's sliders in photos: `facepipe fit-photo`.

    :param similarity_threshold: similarity of each photo and the render of it to --identity-model (cosine), below which the exit code is 1
    :param iterations: steps of gradient descent; 0: landmarks alone
    :param loss_threshold: stop once the joint loss is below this
    :param optimiser: adam, or plain gradient descent
    :param rate: size of a step, of a slider's range (adam), or per slope (plain)
    :param size: pixels a side that image terms see of the head
    :param color: weight of the colours of the pixels
    :param content: weight of features and semantics
    :param identity: weight of the identity (default 0.02 with a network of yours, else 0)
    :param attributes: weight of the attributes (default 0.02 with a network of yours, else 0)
    :param sparsity: weight of the sliders' distance from their defaults
    :param expression_sparsity: weight of the expressions
    :param hue: weight of the difference in hue between the key light and the light around it
    :param landmark_sigma: expected landmark error, as a share of the distance of the outer eye corners
    :param focal_sigma: spread of the focal length around a portrait lens, as a natural logarithm
    :param face: face stage, after the photos (default the built-in head)
    :param photos: photos of one person, before the face
    :param landmarks: landmarks of a photo, in the order of the photos
    :param landmarker: find landmarks by MediaPipe: its model face_landmarker.task
    :param database: faces of FACE's topology: who a person may be (default for the built-in head its own modes)
    :param content_model: network for content, .onnx or .pt2 (default facepipe's own)
    :param identity_model: network for identity, .onnx or .pt2 (default facepipe's own)
    :param attribute_model: network for attributes, .onnx or .pt2 (default facepipe's own)
    :param start: network of `facepipe train-photo` for FACE, which guesses where to start
    :param faces: which of several faces, from 0; once, or for each photo
    :param expressions: shape that is an expression (default those with ARKit's names)
    :param landmark_threshold: mean error, percent of the distance of the outer eye corners, above which the exit code is 1
    :param landmark_weight: weight of the landmarks
    :param report: folder to make: report, pictures, landmarks
    :param person: payload of the person, as of `facepipe person`
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def inspect(
    face: str | os.PathLike[str],
) -> InspectReport:
    """Show what a face holds: `facepipe inspect`.

    :param face: face stage
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def landmarks(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    landmarks: str | os.PathLike[str],
    scheme: str | None = None,
    mesh: str | None = None,
) -> LandmarksReport:
    """Author named landmarks: `facepipe landmarks`.

    :param face: face stage
    :param landmarks: landmarks to author
    :param scheme: name of the scheme, where the file holds one (default: the file's)
    :param mesh: mesh they lie on (default: the one with most points)
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def lod(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    triangles: Sequence[int] = (),
    skin_share: float = 0.6,
) -> LodReport:
    """Lower levels of detail of a face: `facepipe lod`.

    :param face: face stage
    :param triangles: triangles of each level, in all (default 40, 15 and 5 % of the face's)
    :param skin_share: least share of them that the skin gets
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def neural_rig_apply(
    face: str | os.PathLike[str],
    rig: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    offset_tolerance_mm: float = 0.01,
    keep_shapes: bool = True,
) -> ApplyNeuralRigReport:
    """Put a neural rig on a face: its controls are sliders: `facepipe neural-rig apply`.

    :param offset_tolerance_mm: a shape leaves out points that it moves by less than this [mm]
    :param keep_shapes: keep the face's own shapes beside the rig's, to be set as before and for clips that play them; without them files are smaller
    :param face: face stage of the meshes that it was learned on
    :param rig: neural rig: .fpnr
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def neural_rig_invert(
    rig: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    mode: Literal["lm", "adam"] = "lm",
    l1: float = 0.0002,
    smoothness: float = 0.001,
    starts: int = 6,
    steps: int = 60,
    points: int = 500,
    accuracy_mm: float = 0.01,
    adam_steps: int = 1000,
    adam_rate: float = 0.05,
    seed: int = 0,
    threshold_mm: float | None = None,
    encoder: bool = True,
) -> InverseReport:
    """Find controls for points: a pose, or a point cache over time: `facepipe neural-rig invert`.

    :param mode: bounded Levenberg-Marquardt, or Adam from random controls
    :param l1: price of a control its whole range from its default [mm2]
    :param smoothness: price of a change of speed by the range a frame, squared, in clips [mm2]
    :param starts: starts of frames that fit much worse than the others, or are few
    :param steps: most steps from a start (lm)
    :param points: points that second derivatives are of, with bones (lm)
    :param accuracy_mm: how exactly targets are known, for what the report says of controls [mm]
    :param adam_steps: steps (adam)
    :param adam_rate: first rate, of ranges; it falls to a hundredth (adam)
    :param seed: of random starts
    :param rig: neural rig: .fpnr
    :param target: stage with the meshes that it was learned on, posed, animated or with points over time: .usda .usdc ...
    :param threshold_mm: exit 1 where the mean error of a frame is above this [mm]
    :param encoder: start from the rig's encoder, if it has one
    :param out: stage of controls over time to write: .usda .usdc .usd .usdz
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def neural_rig_retarget(
    rig: str | os.PathLike[str],
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    frames: str | os.PathLike[str],
    mode: Literal["points", "network"] = "points",
    noise_mm: float = -1.0,
    noise: float = 0.05,
    steps: int = 3000,
    rounds: int = 2,
    held_out: float = 0.15,
    shapes: int = 256,
    tolerance_mm: float = 0.005,
) -> RetargetReport:
    """Carry a neural rig to another person, of some frames of that person: `facepipe neural-rig retarget`.

    :param mode: point by point in closed form, or the published fully connected network of the whole deformation
    :param noise_mm: noise on what the rig says while the subject is learned; -1: what does best on frames left out [mm]
    :param noise: noise at first, in deviations of the rig's deformations (network)
    :param steps: most steps (network)
    :param rounds: how often controls are found, where they aren't given
    :param held_out: share of the frames, the last ones, that the report is on
    :param shapes: most shapes of the subject's rig
    :param tolerance_mm: what those may leave, RMS [mm]
    :param rig: neural rig: .fpnr
    :param face: face stage of the person, on the same topology, with the same joints if the rig has some
    :param frames: stage with the person's points over time; with controls over time too where these are known
    :param out: neural rig of the person to write: .fpnr
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def neural_rig_train(
    data: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    seed: int = 0,
    spread: int = 1000,
    busy: float = 0.6,
    sweep: int = 8,
    together: int = 500,
    held_out: float = 0.15,
    width: int = 256,
    shapes: int = 128,
    tolerance_mm: float = 0.01,
    influences: Literal[4, 8, 0] = 4,
    steps: int = 6000,
    detail: float = 1.0,
    sparsity: float = 0.2,
    patience: int = 1000,
    points: int = 256,
    per_token: int = 8,
    head_width: int = 8,
    layers: int = 2,
    reduced: int = 64,
    noise_mm: float = 0.02,
    encoder_steps: int = 2000,
    encoder_patience: int = 1000,
    block: int = 30,
    margin: int = 2,
    clips: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = (),
    learn_from: Literal["auto", "rig", "samples"] = "auto",
    controls: Sequence[str] = (),
    encoder: bool = True,
    checkpoint: str | os.PathLike[str] | None = None,
    plot: str | os.PathLike[str] | None = None,
) -> NeuralRigReport:
    """Learn what the rig of a face does: `facepipe neural-rig train`.

    :param seed: another number draws other frames, and another split, network and batches
    :param spread: frames of many controls at once, spread evenly (latin hypercube)
    :param busy: most of the controls that one of those frames moves, as a share; each draws its own, up to it
    :param sweep: frames of each control alone, from one limit to the other
    :param together: frames of two or three controls at once
    :param held_out: share of the frames to check on, in whole blocks
    :param width: units of the hidden layer
    :param shapes: most shapes that motion is a sum of
    :param tolerance_mm: what those shapes may leave of all frames, RMS [mm]
    :param influences: largest number of joints that move a point, as engines and `export --influences` have it: shapes make up for the others; 0 keeps all
    :param steps: most steps of training
    :param detail: what an error of differential coordinates, dents and bumps, counts beside one of points
    :param sparsity: how strongly a unit of the hidden layer is held to few controls
    :param patience: steps without a better check that end it
    :param points: points that the encoder looks at
    :param per_token: of them in one token, neighbours
    :param head_width: numbers of each of the 4 heads of the attention
    :param layers: layers of the transformer
    :param reduced: numbers that a face is reduced to
    :param noise_mm: noise on the points that it learns from; 0.1 for scans [mm]
    :param encoder_steps: most steps of the encoder's training
    :param encoder_patience: steps without a better check that end that
    :param block: frames of a clip that are held out together, about
    :param margin: frames left out between two blocks of a clip
    :param data: face stage, or one with controls and points over time: .usda .usdc .usd .usdz
    :param clips: stage whose clips the face's own rig plays too, its own stage among them
    :param learn_from: the face's own rig, or samples over time; auto: samples where the stage has them
    :param controls: prim whose custom numbers are the controls, in place of facepipe:control:*
    :param encoder: train an encoder too, from points back to controls
    :param checkpoint: file that keeps where the training stands: killed, the same command goes on from there
    :param plot: picture of what is left of the motion, step by step
    :param out: neural rig to write: .fpnr
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def person(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    template: str | os.PathLike[str] | None = None,
    database: str | os.PathLike[str] | None = None,
    within: float | None = None,
    most: int | None = None,
    look: bool = False,
    textures: int = 0,
    coefficients: str | os.PathLike[str] | None = None,
) -> PersonReport:
    """Write who a face is as a payload of few bytes: `facepipe person`.

    :param face: face stage
    :param template: face of the same topology that devices have, where there are no modes
    :param database: faces of its topology whose modes to use: .fpdb, or their .fpbasis
    :param within: how far off a point may be at most (default 1 without --bytes) [mm]
    :param most: size of the payload at most [bytes]
    :param look: with how the built-in head looks: skin, hair, eyes
    :param textures: with pictures of the skin of so many texels a side (512, 1024); 0: none [texels]
    :param coefficients: bone coefficients to send with the person (.fpb)
    :param out: payload to write: .fpb
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def personal_template(
    neutral: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    template: str | os.PathLike[str],
    shapes_from: Literal["auto", "database", "template"] = "auto",
    database: str | os.PathLike[str] | None = None,
) -> PersonalReport:
    """Make a person's starting shapes: `facepipe personal-template`.

    :param shapes_from: database: its mean person's and what its people have in common, auto where it has shapes; template: the template's own, carried over by deformation transfer
    :param neutral: face stage with the person's neutral
    :param template: face stage that NEUTRAL was fitted with
    :param database: faces of the template's topology: .fpdb
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def rebuild(
    project: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    joint: bool = False,
    report: str | os.PathLike[str] | None = None,
) -> RebuildReport:
    """Make an actor's neutral and own shapes from scans: `facepipe rebuild`.

    :param project: scans, template, database and options: .toml
    :param joint: refine the neutral on all scans together, as joint = true in PROJECT
    :param report: folder to make: report, pictures of scans and shapes
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def refine_neutral(
    neutral: str | os.PathLike[str],
    scan: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    detail_mm: float = 10.0,
    drift_mm: float = 5.0,
    landmark_sigma_mm: float = 0.3,
    reach_mm: float = 4.0,
    landmarks: str | os.PathLike[str] | None = None,
    regions: Sequence[str] = (),
    weights: Mapping[str, float] = {},
    picture: str | os.PathLike[str] | None = None,
) -> RefineNeutralReport:
    """Draw a neutral, or regions of it, closer to its scan: `facepipe refine-neutral`.

    :param detail_mm: waves of this length in the scan are followed by half, shorter ones less [mm]
    :param drift_mm: how far points may be off along the surface: smaller ones keep them where they are [mm]
    :param landmark_sigma_mm: smaller ones hold landmarks harder against the surface [mm]
    :param reach_mm: points further from the scan don't follow it [mm]
    :param neutral: face stage with the person's neutral
    :param scan: its scan: .ply .obj .stl .off .glb .gltf or USD
    :param landmarks: landmarks of the scan (default SCAN's .landmarks.json)
    :param regions: what may follow (default all)
    :param weights: shapes that the scan shows besides the neutral, weights above 0 up to 2 (default as NEUTRAL was fitted)
    :param picture: draw scan, face and their distance
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def regions(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    map: str | os.PathLike[str],
    legend: str | os.PathLike[str],
    tolerance: float = 8.0,
    edge: int = 2,
    footprint: int = 1,
    tile: int | None = 1001,
    mesh: str | None = None,
    uv_set: str | None = None,
    picture: str | os.PathLike[str] | None = None,
) -> RegionsReport:
    """List regions, or author them from a painted map: `facepipe regions`.

    :param tolerance: distance to a legend colour that still is that colour [RGB, 0 to 255 a channel]
    :param edge: how far antialiased borders run, and paint counts beyond its end [texels]
    :param footprint: side of the square averaged at a point; 1: its texel [texels]
    :param tile: UDIM tile that the map covers, or `all`: it repeats in every tile
    :param face: face stage
    :param map: regions painted over the UV layout, a colour each
    :param legend: a JSON file that says which colour is which region
    :param mesh: meshes the map covers, globs (default: that of most points)
    :param uv_set: UV set that it was painted over (default: st, or the first)
    :param picture: draw the regions on the face
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def register_scan(
    scan: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    personal: str | os.PathLike[str],
    weight_sigma: float = 0.2,
    variation: float = 0.25,
    still_mm: float = 0.1,
    membrane: float = 3.0,
    landmark_sigma_mm: float = 0.3,
    reach_mm: float = 4.0,
    landmarks: str | os.PathLike[str] | None = None,
    neutral_scan: str | os.PathLike[str] | None = None,
    neutral_landmarks: str | os.PathLike[str] | None = None,
    composite: str = "",
    weights: Mapping[str, float] = {},
    neutral_weights: Mapping[str, float] = {},
    name: str = "",
    picture: str | os.PathLike[str] | None = None,
) -> RegisterScanReport:
    """Put a person's face on the scan of an expression: `facepipe register-scan`.

    :param weight_sigma: how far a shape's weight may be from the given one
    :param variation: how far people's own motion is from the template's, as a share of it
    :param still_mm: motion of what the expression does not move [mm]
    :param membrane: stiffness of what the shapes can't show
    :param landmark_sigma_mm: smaller ones hold landmarks and markers harder [mm]
    :param reach_mm: points further from the scan don't follow it [mm]
    :param personal: what `facepipe personal-template` made
    :param scan: scan of an expression: .ply .obj .stl .off .glb .gltf or USD
    :param landmarks: landmarks of the scan (default SCAN's .landmarks.json)
    :param neutral_scan: scan that the neutral was fitted to
    :param neutral_landmarks: its landmarks (default its .landmarks.json)
    :param composite: what the scan shows, as the table of composites has it
    :param weights: what the scan shows: shapes, weights above 0 up to 2
    :param neutral_weights: what the neutral's scan shows besides, as `facepipe fit-neutral` found it
    :param name: of the shape to author (default SCAN's name)
    :param picture: draw scan, face and their distance
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def render(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    weights: Mapping[str, float] = {},
    bones: Mapping[str, float] = {},
    sliders: Mapping[str, float] = {},
    pose: str | None = None,
    lod: int = 0,
    view: Literal["front", "side", "three-quarter"] = "front",
    size: int = 800,
    heatmap: str | None = None,
    regions: bool = False,
    landmarks: str | None = None,
) -> Report:
    """Draw a face: `facepipe render`.

    :param weights: shape weight
    :param bones: bone coefficient, channels tx ty tz (stage units) rx ry rz (radians) sx sy sz (factor); JOINT is a path, its last part, or the source's name
    :param sliders: slider value, over those that are set
    :param face: face stage
    :param pose: the person: set (as FACE is set, the default), rest (the template), or an animation's first sample
    :param lod: level of detail of a face that `facepipe lod` made, 0 the finest
    :param view: where it is seen from
    :param size: width and height [pixels]
    :param heatmap: colour by a per-point primvar in mm, or by `displacement` from the neutral
    :param regions: colour by the face's regions, with a legend
    :param landmarks: draw numbered landmarks of a scheme
    :param out: picture to write: .png
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def scan(
    photos: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    pixels: int = 1600,
    lens: Literal["shared", "each"] = "shared",
    neighbours: int = 4,
    support: int = 2,
    agreement: float = 3.0,
    texture: float = 2.0,
    spacing: float = 2.0,
    outliers: float = 2.5,
    smallest: float = 0.05,
    gap: float = 4.0,
    radius: float = 250.0,
    landmarks: bool = True,
    seed: int = 0,
    cameras: str | os.PathLike[str] | None = None,
    masks: str | os.PathLike[str] | None = None,
    markers: str | os.PathLike[str] | None = None,
    marker_distance: Sequence[str] | None = None,
    save_cameras: str | os.PathLike[str] | None = None,
) -> ScanPhotosReport:
    """Make a scan of photos around a face: `facepipe scan`.

    :param pixels: longer side that larger photos are shrunk to [pixels]
    :param lens: cameras that take photos of one size and EXIF focal length have one lens, or each its own
    :param neighbours: other photos that each photo's depth is found with, at least
    :param support: other photos whose depth must agree for a point to be kept
    :param agreement: how far depths may be apart that agree, in widths of a pixel on the skin [pixels]
    :param texture: contrast below which a place of a photo is too plain to be matched; above what noise has [levels of 255]
    :param spacing: distance of the scan's points, in widths of a pixel on the skin [pixels]
    :param outliers: points whose distance from their neighbours is above the mean by this many standard deviations go
    :param smallest: least share of the points that a loose piece may have
    :param gap: the surface ends this far from the nearest point, in distances of points
    :param radius: of the ball that the cameras look at, where the scale is unknown: about millimetres of a head
    :param landmarks: find the 68 landmarks in the photos, where the extra [train] is installed
    :param seed: seed of the random choices
    :param photos: folder of 5 or more photos of one expression
    :param cameras: where the cameras stand and what they see
    :param masks: a PNG for each photo, white where the person is
    :param markers: pixels of markers in the photos
    :param marker_distance: two markers and the straight distance between them, millimetres
    :param save_cameras: write the cameras that were used
    :param out: scan to write: .ply
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def scan_landmarks(
    scan: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    component: str | None = None,
    picture: str | os.PathLike[str] | None = None,
) -> ScanLandmarksReport:
    """Find the landmarks of a scanned face: `facepipe scan-landmarks`.

    :param scan: mesh or point cloud
    :param component: look at one mesh, object or group of the file alone, by its name
    :param picture: draw the scan with its landmarks, from three sides
    :param out: landmark file to write: .json
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def skin(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    influences: int = 4,
    sharpness: float = 1.0,
    smoothing: float = 2.0,
    count: int = 60,
    iterations: int = 10,
    evenness: float = 0.3,
    joints: str | os.PathLike[str] | None = None,
    learn_from: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = (),
    source: str | os.PathLike[str] | None = None,
    optimise: bool = False,
    picture: str | os.PathLike[str] | None = None,
) -> SkinReport:
    """Give a face a skeleton and skin weights: `facepipe skin`.

    :param influences: most joints that move a point
    :param sharpness: how far joints of --joints keep to their own: at 4, weights fall off about twice as fast as at 1
    :param smoothing: weights of --from are smoothed over this length along the surface [mm]
    :param count: joints of --learn-from
    :param iterations: rounds of --optimise
    :param evenness: how much --optimise keeps weights even from point to point: more is smoother and misses more
    :param face: face stage without joints, or with the same ones
    :param joints: where joints are
    :param learn_from: faces of the same topology to learn joints and weights from: one .fpdb, or stages
    :param source: a skinned face, of any topology
    :param optimise: refine the weights for the face's own blendshapes
    :param picture: draw the weights on the face, a colour a joint
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def sliders(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    pairs: str = "decr:incr,down:up,in:out,backward:forward,concave:convex,compress:uncompress",
    least_reach: float = 0.1,
    least_effect: float = 0.1,
    regularise: float = 0.1,
    residual: bool = False,
    threshold_mm: float = 0.1,
    table: str | os.PathLike[str] | None = None,
    network: str | os.PathLike[str] | None = None,
    person: str | os.PathLike[str] | None = None,
    shapes: str | None = None,
    drop: bool = False,
    values: Mapping[str, float] = {},
    mirror: bool = False,
    reset: bool = False,
    name: str = "sliders",
    limits: LimitRules | Mapping[str, Any] | str | os.PathLike[str] | None = None,
) -> Report:
    """List, author or set sliders: `facepipe sliders`.

    :param pairs: last words of shapes that are the two ends of one slider, low:high, comma between; '' none
    :param least_reach: a slider whose bones reach less of the motion of its shapes (1 - RMS left / RMS of the motion) is left out; with --residual it is made of its shapes alone
    :param least_effect: channels that move no point by this share of the pose's largest motion, or by no more than --threshold-mm, are left out, and the others fitted again; 0 keeps all
    :param regularise: weight of the mean square strain of the bones beside that of the distances: calm poses add up better
    :param residual: sliders also drive what bones can't reach as sparse blendshapes SHAPE_residual
    :param threshold_mm: a distance that is good enough: points that bones leave further off are in the residual [mm]
    :param face: face stage
    :param table: sliders to author: .toml or .csv
    :param network: learned network to put beside the sliders: .npz
    :param person: person whose own values to set: .fpb, or a face
    :param shapes: sliders to make of blendshapes, all or those of these names
    :param drop: with --from and --from-shapes: drop the sliders that FACE has
    :param values: slider value
    :param mirror: with --set: also the slider of the other side
    :param reset: all other sliders to their defaults
    :param name: name of the pose
    :param limits: with --from-shapes: limits of the bones over those of the rig, as in docs/bones.md (default none)
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def split_shapes(
    expressions: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    personal: str | os.PathLike[str],
    shared_gain: float = 0.2,
    own_gain: float = 0.2,
    shared_turn: float = 0.15,
    own_turn: float = 0.15,
    field_length: float = 25.0,
    detail: float = 0.2,
    detail_length: float = 15.0,
    noise: float = 0.6,
    noise_length: float = 15.0,
    weight_spread: float = 0.1,
    largest_weight: float = 1.2,
    alternations: int = 3,
) -> SplitShapesReport:
    """Split scanned expressions into the person's own shapes: `facepipe split-shapes`.

    :param shared_gain: spread of how much more or less than their templates all shapes move together
    :param own_gain: spread of how much more or less each shape moves by itself
    :param shared_turn: spread of the angle by which all shapes are turned together [rad]
    :param own_turn: spread of the angle by which each shape is turned by itself [rad]
    :param field_length: distance over which gains and turns vary: about half of a muscle's length [mm]
    :param detail: spread of the detail beyond gains and turns, as a share of the template's motion; larger values follow the scans more closely, and their errors too
    :param detail_length: distance over which detail varies, and over which points hold gradients in place [mm]
    :param noise: expected error of the composites' points, in each coordinate [mm]
    :param noise_length: distance over which that error varies: points closer together share it [mm]
    :param weight_spread: expected error of the given weights; 0 keeps them. Weights of 0 always stay 0
    :param largest_weight: fitted weights stay between 0 and this, or the given one
    :param alternations: rounds of solving for shapes and weights
    :param personal: what they were registered with
    :param expressions: what `facepipe register-scan` made
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def train_photo(
    face: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    people: int = 100000,
    renders: int = 2000,
    epochs: int = 4,
    steps: int = 400,
    seed: int = 0,
    images: str | os.PathLike[str] | None = None,
    expressions: Sequence[str] | None = None,
) -> TrainPhotoReport:
    """Train a network that guesses where a photo fit starts: `facepipe train-photo`.

    :param people: random people to learn from first, by their landmarks alone
    :param renders: random renders of FACE with known parameters
    :param epochs: passes over these renders
    :param steps: steps on the joint loss after that, with 8 pictures each
    :param seed: seed of people, initial weights and order
    :param face: face stage
    :param images: photos of people, for the joint loss
    :param expressions: shape that is an expression (default those with ARKit's names)
    :param out: network to write: .onnx
    :param overwrite: put it in place of a file that is there
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """

def transfer(
    head: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str],
    overwrite: bool = False,
    flatten: bool = False,
    template: str | os.PathLike[str] | None = None,
    landmarks: str | os.PathLike[str] | None = None,
    shapes: Sequence[str] = (),
    only: Sequence[Literal["shapes", "regions", "landmarks", "sliders"]] = (),
    joints: bool = False,
    cut_mouth: bool = False,
    replace: bool = False,
    picture: str | os.PathLike[str] | None = None,
    report: str | os.PathLike[str] | None = None,
) -> TransferReport:
    """Give a head of others the shapes of a template: `facepipe transfer`.

    :param head: head or body: .glb .gltf .vrm .fbx .obj .ply .stl .off or USD
    :param template: face of any topology with shapes; landmarks that it lacks are found on it (default the built-in head)
    :param landmarks: landmarks of the head (default HEAD's .landmarks.json)
    :param shapes: shapes of the template to bring (default ARKit's 52; all: every one)
    :param only: bring these alone
    :param joints: bring joints with weights too, to a head that has none
    :param cut_mouth: open a mouth that triangles seal, along edges between the lips
    :param replace: make shapes, regions, landmarks and sliders that the head has anew
    :param picture: draw all shapes from the front and from between front and side
    :param report: folder to make: figures of each shape, pictures
    :param out: stage to write, or a file that an exporter writes
    :param overwrite: put it in place of a file that is there
    :param flatten: write a standalone file
    :raises FacepipeError: what can't be read, done or written; then nothing is written
    """
