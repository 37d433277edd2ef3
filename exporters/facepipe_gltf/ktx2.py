"""Pictures of a document as KTX2 (KHR_texture_basisu), which graphics cards keep compressed: a sixth of the memory.

Colours and data are ETC1S, normal maps UASTC: blocks of ETC1S have two colours on one line, and dents where normals
differ in two directions.
"""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from facepipe.core.errors import InputError
from facepipe.core.images import open_image, pixels
from facepipe.records import Json
from facepipe_gltf.materials import BASIS, Image, Pixels
from facepipe_gltf.node_packages import answer_of

_WHERE, _PACKAGE = "--texture-format ktx2", "ktx2-encoder"
_MOST = 12 << 20  # pixels of a picture that the encoder takes
_SECONDS = 3600  # twenty pictures of 12 million pixels take a tenth of it
_BLOCK = 4  # KHR_texture_basisu: sides are multiples of it
_COLOURS = ("baseColorTexture", "emissiveTexture", "sheenColorTexture", "specularColorTexture", "tint")  # sRGB
_NORMALS = ("normalTexture", "clearcoatNormalTexture", "normal")
_PROGRAM = """
  const fs = require("fs");
  const folders = [...roots, ...(process.env.NODE_PATH || "").split(path.delimiter).filter(path.isAbsolute)];
  const folder = folders.map((one) => path.join(one, "ktx2-encoder")).find((one) => fs.existsSync(one));
  if (!folder) process.exit(4);
  const { exports } = JSON.parse(fs.readFileSync(path.join(folder, "package.json")));
  const { encodeToKTX2 } = await import(pathToFileURL(path.join(folder, exports["."].node.import)).href);
  console.log = () => {};  // the encoder tells of its slices there
  const input = await received(), length = input.readUInt32LE(0);
  let at = 4 + length;
  for (const { width, height, use } of JSON.parse(input.subarray(4, at).toString())) {
    const data = new Uint8Array(input.subarray(at, at += 4 * width * height));
    const sRGB = use === "colours", isUASTC = use === "normals";
    const packed = await encodeToKTX2(data, {
      isUASTC, isPerceptual: sRGB, isSetKTX2SRGBTransferFunc: sRGB, generateMipmap: true,
      ...(isUASTC ? { isNormalMap: true, needSupercompression: true } : { qualityLevel: 255, compressionLevel: 1 }),
      imageDecoder: async () => ({ width, height, data }),
    });
    const head = Buffer.alloc(4);
    head.writeUInt32LE(packed.length);
    process.stdout.write(head), process.stdout.write(packed);
  }
"""

Use = Literal["colours", "normals", "data"]


def with_ktx2(document: Json, given: Sequence[Image]) -> tuple[Json, list[Image], tuple[str, ...]]:
    """A document's JSON and its images, `given` as PNG and JPEG, with KTX2 in their place; and how long it took.

    Sides that are no multiples of four are scaled up to the next.

    :raises InputError: node or its package ktx2-encoder is not installed, or a picture is too large for it
    :raises ExportError: the encoder failed
    """
    if not given:
        return document, [], ()
    start, uses = time.perf_counter(), _uses(document)
    pictures = [_picture(image) for image in given]
    header = [
        {"width": one.shape[1], "height": one.shape[0], "use": uses.get(i, "data")} for i, one in enumerate(pictures)
    ]
    text = json.dumps(header).encode()
    request = b"".join([struct.pack("<I", len(text)), text, *(one.tobytes() for one in pictures)])
    # in one process: its program takes a second to compile
    answer, at, images = answer_of(_WHERE, _PACKAGE, _PROGRAM, request, seconds=_SECONDS), 0, list[Image]()
    for image in given:
        (length,) = struct.unpack_from("<I", answer, at)
        images.append(Image(image.name, "image/ktx2", answer[at + 4 : at + 4 + length]))
        at += 4 + length
    size = sum(len(image.data) for image in images)
    line = f"{len(images)} pictures as KTX2: {size / 1e6:.1f} MB in {time.perf_counter() - start:.1f} s"
    return _named(document, images), images, (line,)


def _picture(image: Image) -> Pixels:
    """(h, w, 4)"""
    from PIL import Image as Pillow

    picture = pixels(open_image(image.data, image.name), "RGBA", image.name)
    height, width = picture.shape[:2]
    if width * height > _MOST:
        what = f"{image.name}: {width} x {height} pixels, expected {_MOST} at most (--texture-size makes it smaller)"
        raise InputError(_WHERE, what)
    shape = (width + -width % _BLOCK, height + -height % _BLOCK)
    if shape == (width, height):
        return picture
    planes = [Pillow.fromarray(np.ascontiguousarray(picture[..., k])).resize(shape) for k in range(4)]
    return np.stack([np.asarray(plane) for plane in planes], axis=-1)


def _uses(document: Json) -> dict[int, Use]:
    """What images hold; one that is read as colours and otherwise is of colours."""
    found: dict[int, Use] = {}
    for key, texture in _infos(document.get("materials", [])):
        image = document["textures"][texture]["source"]
        if key in _COLOURS:
            found[image] = "colours"
        elif image not in found:
            found[image] = "normals" if key in _NORMALS else "data"
    return found


def _infos(value: object, key: str = "") -> Iterator[tuple[str, int]]:
    """The textures that JSON refers to, and by which key."""
    if isinstance(value, list):
        for one in value:
            yield from _infos(one, key)
    elif isinstance(value, dict):
        if isinstance(value.get("index"), int):
            yield key, value["index"]
        for name, one in value.items():
            yield from _infos(one, name)


def _named(document: Json, images: list[Image]) -> Json:
    """The JSON with textures that read these images."""
    textures = [
        {"sampler": one["sampler"], "extensions": {BASIS: {"source": one["source"]}}} for one in document["textures"]
    ]
    listed = [{"name": image.name, "mimeType": image.mime} for image in images]
    result = document | {"textures": textures, "images": listed}
    for key in ("extensionsUsed", "extensionsRequired"):
        result[key] = sorted([*result.get(key, []), BASIS])
    return result
