/** The regions of a face as a picture over its UV layout with a legend, to be painted elsewhere and read back. */
import type { BufferGeometry } from "three";
import { pointNumbers } from "../runtime/glb";
import { regionColor } from "../viewer/colors";
import type { ViewedFace } from "../viewer/viewed_face";

const SIZE = 2048; // texels a side
/** Of a map that is read, the share of its side that borders between regions are wide: it has them sharp. */
export const BORDER = 1 / 64;

/** As `facepipe regions --legend` takes it. */
export function legendOf(regions: string[]): Blob {
  const hex = (number: number) => `#${regionColor(number).map((one) => Math.round(one).toString(16).padStart(2, "0")).join("")}`;
  return new Blob([JSON.stringify({ regions: Object.fromEntries(regions.map((name, i) => [name, hex(i)])) }, null, 2)]);
}

/**
 * A PNG of the mesh with most points: every texel has the colour of the region that is most there; none beyond the mesh.
 * @throws Error a face without regions, or a mesh without UVs
 */
export async function regionMap({ face, details, masks, regionNames }: ViewedFace): Promise<Blob> {
  const meshes = details?.meshes ?? [];
  const most = meshes.reduce((best, one, i) => (one.points > meshes[best].points ? i : best), 0);
  const mesh = face.meshes.find((one) => one.name === meshes[most]?.name);
  if (!masks || !mesh) throw new Error("This face has no regions.");
  const first = meshes.slice(0, most).reduce((sum, one) => sum + one.points, 0);
  const count = masks.length / regionNames.length;
  const image = new ImageData(SIZE, SIZE);
  const texels = new Uint32Array(image.data.buffer);
  const colors = regionNames.map((_, i) => regionColor(i).reduce((sum, one, channel) => sum + Math.round(one) * 256 ** channel, 255 * 256 ** 3));
  for (const primitive of mesh.primitives) {
    const geometry = primitive.geometry as BufferGeometry;
    const { uv } = geometry.attributes;
    if (!uv) throw new Error(`${mesh.name} has no UVs, over which regions could be painted.`);
    const numbers = pointNumbers(primitive);
    const corners = geometry.index?.array ?? numbers.length;
    const total = typeof corners === "number" ? corners : corners.length;
    for (let at = 0; at < total; at += 3) {
      const vertices = [0, 1, 2].map((i) => (typeof corners === "number" ? at + i : corners[at + i]));
      const places = vertices.map((one) => [uv.getX(one) * SIZE - 0.5, uv.getY(one) * SIZE - 0.5]);
      const shares = regionNames.map((_, region) => vertices.map((one) => masks[region * count + first + numbers[one]]));
      fill(texels, places, (weights) => {
        let [best, largest] = [-1, 0];
        shares.forEach(([a, b, c], region) => {
          const share = weights[0] * a + weights[1] * b + weights[2] * c;
          if (share > largest) [best, largest] = [region, share];
        });
        return best < 0 ? 0 : colors[best];
      });
    }
  }
  const canvas = new OffscreenCanvas(SIZE, SIZE);
  canvas.getContext("2d")!.putImageData(image, 0, 0);
  return canvas.convertToBlob({ type: "image/png" });
}

/** Set the texels whose middle lies in a triangle, of the color at their barycentric coordinates. */
function fill(texels: Uint32Array, [[ax, ay], [bx, by], [cx, cy]]: number[][], color: (weights: number[]) => number): void {
  const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
  if (!area) return;
  const [left, right] = [Math.max(Math.ceil(Math.min(ax, bx, cx)), 0), Math.min(Math.floor(Math.max(ax, bx, cx)), SIZE - 1)];
  const [top, bottom] = [Math.max(Math.ceil(Math.min(ay, by, cy)), 0), Math.min(Math.floor(Math.max(ay, by, cy)), SIZE - 1)];
  for (let y = top; y <= bottom; y++) {
    for (let x = left; x <= right; x++) {
      const v = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area;
      const w = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area;
      if (v < -1e-9 || w < -1e-9 || v + w > 1 + 1e-9) continue;
      texels[y * SIZE + x] = color([1 - v - w, v, w]);
    }
  }
}
