/** The GLB of a face in three.js: its meshes, and what they are called in the file. */
import { type AnimationClip, type BufferGeometry, Group, type Mesh, type Object3D, type Skeleton, type SkinnedMesh } from "three";
import { MeshoptDecoder } from "three/examples/jsm/libs/meshopt_decoder.module.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { FaceError, fetched } from "./errors";
import { wrinkle } from "./wrinkles";

/** One mesh of the face: a primitive for each of its materials. */
export interface FaceMesh {
  name: string;
  /** points on the stage; several vertices may stand for one */
  pointCount: number;
  targets: string[];
  /** the mesh that this one's vertices lie on (docs/files.md, `_FACEPIPE_CORNERS`) */
  holds: string | null;
  /** target -> its knots (shape weight, target weight), of shapes with inbetweens */
  curves: Record<string, [number, number][]>;
  /** inbetween target -> shape */
  inbetweens: Record<string, { shape: string; weight: number }>;
  primitives: Mesh[];
}

export interface LoadedGlb {
  root: Group;
  meshes: FaceMesh[];
  skeleton: Skeleton | null;
  clips: AnimationClip[];
  copyright: string;
}

interface MeshRecord {
  name?: string;
  extras?: {
    targetNames?: string[];
    facepipe?: { pointCount?: number; holds?: string; curves?: FaceMesh["curves"]; inbetweens?: FaceMesh["inbetweens"] };
  };
}

/**
 * @throws FaceError no GLB, or one without meshes
 */
export async function readGlb(url: string): Promise<LoadedGlb> {
  const bytes = await (await fetched(url)).arrayBuffer();
  const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder);
  const gltf = await loader.parseAsync(bytes, url.slice(0, url.lastIndexOf("/") + 1)).catch((error: Error) => {
    throw new FaceError(url, `is no GLB that three.js reads: ${error.message.split("\n")[0]}`);
  });
  const { associations } = gltf.parser;
  const json = gltf.parser.json as { meshes?: MeshRecord[]; asset: { copyright?: string } };
  const found = new Map<number, FaceMesh>();
  let skeleton: Skeleton | null = null;
  gltf.scene.traverse((object: Object3D) => {
    const mesh = object as SkinnedMesh;
    const number = mesh.isMesh ? associations.get(mesh)?.meshes : undefined;
    if (number === undefined) return;
    const record = json.meshes?.[number] ?? {};
    const entry = found.get(number) ?? described(record, mesh.geometry);
    entry.primitives.push(mesh);
    if (!record.extras?.facepipe?.pointCount) entry.pointCount = Math.max(entry.pointCount, countOf(mesh));
    found.set(number, entry);
    mesh.frustumCulled = false; // its bounds are those of the neutral
    if (mesh.isSkinnedMesh) skeleton = mesh.skeleton;
  });
  for (const mesh of found.values()) await wrinkle(mesh, gltf);
  if (!found.size) throw new FaceError(url, "holds no mesh, expected a face");
  const root = new Group();
  root.add(gltf.scene);
  root.updateMatrixWorld(true);
  return {
    root,
    meshes: [...found].sort(([a], [b]) => a - b).map(([, mesh]) => mesh),
    skeleton,
    clips: gltf.animations,
    copyright: json.asset.copyright ?? "",
  };
}

function described(record: MeshRecord, geometry: BufferGeometry): FaceMesh {
  const own = record.extras?.facepipe;
  const targets = geometry.morphAttributes.position?.length ?? 0;
  return {
    name: record.name ?? "mesh",
    pointCount: own?.pointCount ?? 0,
    targets: record.extras?.targetNames ?? Array.from({ length: targets }, (_, i) => `target${i}`),
    holds: own?.holds ?? null,
    curves: own?.curves ?? {},
    inbetweens: own?.inbetweens ?? {},
    primitives: [],
  };
}

/** Point of the face that each vertex of a primitive stands for. */
export function pointNumbers(primitive: Mesh): ArrayLike<number> {
  const { attributes } = primitive.geometry;
  const own = attributes._facepipe_point;
  return own ? own.array : Array.from({ length: attributes.position.count }, (_, i) => i);
}

/** Points as far as the vertices of a primitive tell. */
function countOf(primitive: Mesh): number {
  const numbers = pointNumbers(primitive);
  let last = -1;
  for (let i = 0; i < numbers.length; i++) last = Math.max(last, numbers[i]);
  return last + 1;
}
