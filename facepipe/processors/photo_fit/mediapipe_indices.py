"""Which of MediaPipe's landmarks stand for the 68 of Multi-PIE."""

from __future__ import annotations

# Vertices of MediaPipe's face mesh (numbered as in canonical_face_model.obj of google-ai-edge/mediapipe) that lie where
# the Multi-PIE mark-up has its points. The contour is that of the mesh, a little inside the jaw line. The 10 points of
# the irises, 468 to 477, are not among them.
MULTIPIE68_OF_MEDIAPIPE = (
    *(162, 234, 93, 58, 172, 136, 149, 148, 152, 377, 378, 365, 397, 288, 323, 454, 389),  # jaw line
    *(71, 63, 105, 66, 107, 336, 296, 334, 293, 301),  # brows, the person's right first
    *(168, 197, 5, 4, 75, 97, 2, 326, 305),  # bridge and base of the nose
    *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),  # eyes, the person's right first
    *(61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181),  # outer lips
    *(78, 82, 13, 312, 308, 317, 14, 87),  # inner lips
)
