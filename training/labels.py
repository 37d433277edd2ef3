"""Which class of a face's parts each pixel of a render shows."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facepipe.heads.asset import asset
from facepipe.networks.onnx_file import CLASSES
from facepipe.pictures.draw import seen
from facepipe.pictures.scene import Scene
from facepipe.pictures.shade import Shader

FloatArray = npt.NDArray[np.floating]
IntArray = npt.NDArray[np.integer]

_MESHES = {"GumsAndTongue": "teeth", "Teeth": "teeth", "EyeballLeft": "leftEye", "EyeballRight": "rightEye"}
_MESHES |= {"Lashes": "face", "Hair": "hair", "Clothes": "background"}
_MOUTH = slice(11248, 13294)  # points of Head inside the mouth, numbered as in ICT-FaceKit
_NOSE = np.array(
    [
        *((-0.75, 4.3), (0.75, 4.3), (0.95, 2.0), (1.75, 0.4), (2.0, -0.6), (1.3, -1.35), (0, -1.6)),
        *((-1.3, -1.35), (-2.0, -0.6), (-1.75, 0.4), (-0.95, 2.0)),
    ]
)  # x, y in cm on the average head


def pixel_classes(shader: Shader, size: int) -> npt.NDArray[np.uint8]:
    """(size, size) the class, of `CLASSES`, that covers most of each pixel; necks and clothes are background."""
    spots, over = seen(shader, size, 1)
    classes = triangle_classes(shader.scene)
    amount, passed = np.zeros((size * size, len(CLASSES))), np.ones(size * size)
    if over is not None:
        passed[over.veiled] = over.passed
        share = over.weight * shader.opacity(over.triangle, over.x, over.y)
        np.add.at(amount, (over.pixel, classes[over.triangle]), share)
    np.add.at(amount, (spots.pixel, classes[spots.triangle]), spots.share * passed[spots.pixel])
    amount[:, 0] += 1 - amount.sum(axis=1)
    return amount.argmax(axis=1).astype(np.uint8).reshape(size, size)


def triangle_classes(scene: Scene) -> IntArray:
    """(t,) the class of each triangle, by its mesh and by where it is on the average head."""
    classes = np.zeros(len(scene.triangles), np.int64)
    for number, surface in enumerate(scene.surfaces):
        of_surface = np.flatnonzero(scene.surface == number)
        name = surface.mesh.name
        if name == "Head":
            classes[of_surface] = _head_classes(scene.triangles[of_surface])
        elif name == "Brows":
            left = scene.points[scene.triangles[of_surface, 0], 0] > 0
            classes[of_surface] = np.where(left, CLASSES.index("leftBrow"), CLASSES.index("rightBrow"))
        else:
            classes[of_surface] = CLASSES.index(_MESHES[name])
    return classes


def _head_classes(triangles: IntArray) -> IntArray:
    """(t,) classes of triangles (t, 3) of Head."""
    points = asset().points
    marks, middle = points[asset().landmarks], points[triangles].mean(axis=1)
    x, y, z = middle.T
    front = z > 4
    classes = np.full(len(triangles), CLASSES.index("face"))
    classes[_inside(_NOSE, x, y) & (z > 7)] = CLASSES.index("nose")
    edge, inner = marks[48:60, :2], marks[60:68, :2]
    lips = _inside(edge + (edge - edge.mean(axis=0)) * 0.03, x, y) & front
    parting = np.vstack([edge[0], inner[1:4], edge[6]])
    order = np.argsort(parting[:, 0])
    upper = y > np.interp(x, parting[order, 0], parting[order, 1])
    classes[lips] = np.where(upper, CLASSES.index("upperLip"), CLASSES.index("lowerLip"))[lips]
    classes[((triangles >= _MOUTH.start) & (triangles < _MOUTH.stop)).all(axis=1)] = CLASSES.index("teeth")
    jaw = np.interp(z, [0, 4.5, 6.0, 7.3, 8.8, 10.4], [-3, -3.5, -5.2, -6.7, -7.4, -8.1])
    classes[(y < jaw) & (classes == CLASSES.index("face"))] = CLASSES.index("background")
    return classes


def _inside(polygon: FloatArray, x: FloatArray, y: FloatArray) -> npt.NDArray[np.bool_]:
    """(n,) whether points lie in a polygon: crossings of a ray to the right, even or odd."""
    found = np.zeros(len(x), bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            found ^= ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return found
