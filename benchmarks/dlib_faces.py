"""What dlib sees in pictures, run by an interpreter that has it: PICTURE ... REPORT.json.

Needs `pip install dlib-bin numpy face_recognition_models`. Faces are found by histograms of oriented gradients, in the
picture and, where there is none, in one twice as large. The descriptor of a face has 128 numbers; dlib takes two below
a distance of 0.6 for one person's (King, "High Quality Face Recognition with Deep Metric Learning", 2017).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import dlib
import face_recognition_models as models


def main() -> None:
    """Look at the pictures and write the report: of each the descriptor, or null where no face is found."""
    *pictures, out = map(Path, sys.argv[1:])
    find, descriptors = dlib.get_frontal_face_detector(), []
    mark = dlib.shape_predictor(models.pose_predictor_model_location())
    describe = dlib.face_recognition_model_v1(models.face_recognition_model_location())
    for picture in pictures:
        image = dlib.load_rgb_image(str(picture))
        faces = find(image) or find(image, 1)
        largest = max(faces, key=lambda one: one.area(), default=None)
        descriptor = None if largest is None else list(describe.compute_face_descriptor(image, mark(image, largest)))
        descriptors.append(descriptor)
    out.write_text(json.dumps({"version": dlib.__version__, "descriptors": descriptors}), encoding="utf-8")


if __name__ == "__main__":
    main()
