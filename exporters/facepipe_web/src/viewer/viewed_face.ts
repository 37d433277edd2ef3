/** A face of the page: the runtime's face, and what the server gives beside it. */
import { Face, loadFace } from "../runtime";
import { offsetNeutral, setNeutral } from "../runtime/neutral";
import { Look } from "./look";

/** A face in viewer.json. */
export interface FaceEntry {
  label: string;
  glb: string;
  onnx: string | null;
  details: string | null;
  /** where the masks of regions are, if not where the details say */
  masks?: string;
}

export interface Details {
  regions: { names: string[]; masks: string } | null;
  joints: { paths: string[]; axes: number[][] } | null;
  /** point counts of all meshes of the stage, in its order */
  meshes: { name: string; points: number }[];
  notes: string[];
}

export class ViewedFace {
  private constructor(
    readonly entry: FaceEntry,
    readonly face: Face,
    readonly details: Details | null,
    readonly masks: Uint8Array | null,
    readonly look: Look,
  ) {}

  /** @throws FaceError files that don't load, or are of different faces */
  static async load(entry: FaceEntry): Promise<ViewedFace> {
    const details = entry.details ? ((await (await fetch(entry.details)).json()) as Details) : null;
    const regions = details?.regions;
    const masks = regions ? new Uint8Array(await (await fetch(entry.masks ?? regions.masks)).arrayBuffer()) : null;
    const face = await loadFace(entry.glb, entry.onnx, { joints: details?.joints ?? undefined });
    await face.reset();
    const look = new Look(face, details, masks);
    const values = Object.fromEntries(face.sliders.map((one) => [one.name, one.value]));
    await face.setSliders(values);
    return new ViewedFace(entry, face, details, masks, look);
  }

  /** @param points of the neutral, 3 numbers for each point of all meshes of the stage, metres, Y up */
  setPoints(points: Float32Array): void {
    let end = 0;
    for (const { name, points: count } of this.details?.meshes ?? []) {
      const mesh = this.face.meshes.find((one) => one.name === name);
      const first = end;
      end += count;
      if (mesh) setNeutral(mesh, (_primitive, _vertex, point, out) => void out.fromArray(points, 3 * (first + point)));
    }
  }

  /** @param offsets from the points of the file, as `setPoints` has points */
  setOffsets(offsets: Float32Array): void {
    let end = 0;
    for (const { name, points: count } of this.details?.meshes ?? []) {
      const mesh = this.face.meshes.find((one) => one.name === name);
      const first = end;
      end += count;
      const moves = offsets.subarray(3 * first, 3 * end).some((one) => one !== 0);
      if (!mesh || (!moves && !this.offset.has(name))) continue;
      if (moves) this.offset.add(name);
      else this.offset.delete(name);
      offsetNeutral(mesh, offsets, first);
    }
  }

  private readonly offset = new Set<string>(); // meshes that are not as in their file

  /** The region that points of a mesh are in most; null for none. */
  regionOf(mesh: string, points: number[]): string | null {
    const { masks, regionNames: names } = this;
    const all = this.details?.meshes ?? [];
    const place = all.findIndex((one) => one.name === mesh);
    if (!masks || place < 0) return null;
    const first = all.slice(0, place).reduce((sum, one) => sum + one.points, 0);
    const count = masks.length / names.length;
    const shares = names.map((_, region) => points.reduce((sum, point) => sum + masks[region * count + first + point], 0));
    const most = Math.max(...shares);
    return most > 0 ? names[shares.indexOf(most)] : null;
  }

  get regionNames(): string[] {
    return this.details?.regions?.names ?? [];
  }
}
