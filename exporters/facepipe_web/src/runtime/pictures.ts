/** Pictures that a person's payload brings for materials of a face: docs/files.md, "A person (.fpb)", section 10. */
import { type MeshStandardMaterial, Source, Texture } from "three";
import { Bytes } from "./bytes";
import { FaceError } from "./errors";
import type { FaceMesh } from "./glb";

const MOST = 16;
const inFile = new WeakMap<MeshStandardMaterial, Texture>();

/**
 * The pictures of a section, decoded, by the name of their material.
 * @throws FaceError rows that don't fit, or none that the browser reads
 */
export async function readPictures(data: Uint8Array, where: string): Promise<Map<string, ImageBitmap>> {
  const bytes = new Bytes(data, `${where} -> pictures`);
  const found = new Map<string, Blob>();
  while (bytes.left) {
    const name = bytes.name();
    const webp = bytes.take(bytes.uint32());
    if (found.has(name) || found.size === MOST) throw bytes.wrong(`expected at most ${MOST}, each material once`);
    found.set(name, new Blob([Uint8Array.from(webp)], { type: "image/webp" }));
  }
  const decoded = [...found].map(async ([name, blob]): Promise<[string, ImageBitmap]> => {
    const picture = await createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" }).catch(() => null);
    if (!picture) throw new FaceError(`${where} -> ${name}`, "no picture that the browser reads, expected WebP");
    return [name, picture];
  });
  return new Map(await Promise.all(decoded));
}

/** Show pictures in place of the colours of the file; materials without one have the file's. */
export function setPictures(meshes: FaceMesh[], pictures: ReadonlyMap<string, ImageBitmap>): void {
  const all = meshes.flatMap((mesh) => mesh.primitives.flatMap((primitive) => primitive.material as MeshStandardMaterial));
  for (const material of new Set(all)) {
    const file = inFile.get(material) ?? material.map;
    if (!file) continue;
    inFile.set(material, file);
    if (material.map !== file) material.map!.dispose();
    const picture = pictures.get(material.name);
    material.map = picture ? Object.assign(new Texture().copy(file), { source: new Source(picture), needsUpdate: true }) : file;
  }
}
