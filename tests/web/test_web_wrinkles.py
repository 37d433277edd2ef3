"""Wrinkles in three.js: pixels of the runtime against the rule that facepipe's own pictures keep to."""

from __future__ import annotations

import json
from collections.abc import Iterator

import browser
import numpy as np
import pytest
from browser import READY, browse, run
from wrinkled import known, wrinkled_square

from facepipe.geometry.colors import from_srgb
from facepipe.stage import save_parts

pytestmark = [pytest.mark.gate, pytest.mark.slow]

CLOSE = 0.012  # of linear values: 8 bits of sRGB at the bright end, and texels between their middles
WEIGHTS: list[dict[str, float]] = [{}, {"smile": 1.0}, {"smile": 0.4, "squint": 0.5}, {"frown": 1.0, "smile": 0.3}]
LAMP = np.array([0.6, 0.3, np.sqrt(1 - 0.45)])
UVS = np.stack(np.meshgrid(np.linspace(0.06, 0.94, 9), np.linspace(0.06, 0.94, 9)), axis=-1).reshape(-1, 2)

# Lights of the page: an even one that shows base colours alone, or one lamp; colours of UVs (m, 2) of the square.
SEEN = """
const { picture } = facepipe, { renderer, scene, camera } = picture;
const lamp = camera.children.find((one) => one.isDirectionalLight);
renderer.toneMapping = 0;
camera.position.set(0, 0, 0.06), camera.up.set(0, 1, 0), camera.lookAt(0, 0, 0), camera.updateMatrixWorld(true);
camera.near = 0.01, camera.far = 1, camera.updateProjectionMatrix();
const own = face.meshes[0].primitives[0];
own.material.needsUpdate = true;
await face.setShapes({ smile: 0, squint: 0, frown: 0, ...WEIGHTS });
const seen = (shown) => {
  scene.traverse((one) => one.isLight && (one.intensity = 0));
  const even = scene.children.find((one) => one.isHemisphereLight);
  even.color.set(0xffffff), even.groundColor.set(0xffffff), lamp.color.set(0xffffff), lamp.position.set(...LAMP);
  (shown ? lamp : even).intensity = Math.PI;
  renderer.setScissorTest(false), renderer.render(scene, camera);
  const gl = renderer.getContext(), size = [gl.drawingBufferWidth, gl.drawingBufferHeight], pixel = new Uint8Array(4);
  return UVS.map(([u, v]) => {
    const at = own.position.clone().set(0.02 * u - 0.01, 0.02 * v - 0.01, 0).project(camera);
    const [column, row] = [at.x, at.y].map((one, i) => Math.floor(((one + 1) / 2) * size[i]));
    gl.readPixels(column, row, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    return [...pixel.slice(0, 3)];
  });
};
return [seen(false), seen(true)];
"""


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    browser.chromium()
    path = tmp_path_factory.mktemp("web") / "square.usda"
    save_parts(wrinkled_square(), path)
    with browser.viewing(path) as url:
        yield url


def test_the_runtime_keeps_to_the_rule(url: str) -> None:
    """Base colours in even light and Lambert's law under a lamp are those of the rule, for several sets of weights."""
    texts = {"LAMP": LAMP.tolist(), "UVS": UVS.tolist()}
    steps = []
    for weights in WEIGHTS:
        script = SEEN
        for name, value in {**texts, "WEIGHTS": weights}.items():
            script = script.replace(f"...{name}", f"...{json.dumps(value)}").replace(
                f"{name}.map", f"{json.dumps(value)}.map"
            )
        steps.append(run(script))
    results, problems = browse(url, READY, *steps)
    assert problems == []
    for weights, (even, lit) in zip(WEIGHTS, results[1:], strict=True):
        base, normals = known(UVS, weights)
        for found, wanted in ((even, base), (lit, base * (normals @ LAMP)[:, None])):
            np.testing.assert_allclose(from_srgb(np.array(found) / 255), wanted, atol=CLOSE, err_msg=str(weights))
