/** How a face is painted: its materials, its regions, or how far points are from the neutral. */
import { BufferAttribute, type Material, type Mesh, MeshStandardMaterial, Vector3, type WebGLProgramParametersWithUniforms } from "three";
import type { Face, FaceMesh } from "../runtime";
import { pointNumbers } from "../runtime/glb";
import { linear, NO_REGION, regionColor, VIRIDIS } from "./colors";
import type { Details } from "./viewed_face";

export type Coloring = "material" | "regions" | "distance";

export class Look {
  /** millimetres at the end of the colour scale */
  readonly range = { value: 5 };
  private readonly own = new Map<Mesh, Material | Material[]>();
  private readonly painted: Record<"regions" | "distance", MeshStandardMaterial>;

  /** Must be made while the face is neutral. */
  constructor(
    private readonly face: Face,
    details: Details | null,
    masks: Uint8Array | null,
  ) {
    this.painted = { regions: this.paint("vRegion"), distance: this.paint("scaled(vDistance / paintRange)") };
    const offsets = firstPoints(details, face.meshes);
    const colors = regionColors(details, masks);
    for (const mesh of face.meshes) {
      for (const primitive of mesh.primitives) {
        this.own.set(primitive, primitive.material);
        primitive.geometry.setAttribute("paintNeutral", neutralOf(primitive));
        primitive.geometry.setAttribute("paintRegion", colorsOf(primitive, colors, offsets.get(mesh.name) ?? 0));
      }
    }
  }

  set(coloring: Coloring, wireframe: boolean): void {
    for (const [mesh, own] of this.own) {
      mesh.material = coloring === "material" ? own : this.painted[coloring];
      for (const material of [mesh.material].flat()) (material as MeshStandardMaterial).wireframe = wireframe;
    }
  }

  /** The largest distance from the neutral, in millimetres, and where it is. */
  largest(): { mm: number; mesh: string } {
    const found = { mm: 0, mesh: "" };
    const [now, before] = [new Vector3(), new Vector3()];
    this.face.root.updateWorldMatrix(true, true);
    for (const mesh of this.face.meshes) {
      for (const primitive of mesh.primitives) {
        const neutral = primitive.geometry.getAttribute("paintNeutral");
        for (let vertex = 0; vertex < neutral.count; vertex++) {
          primitive.getVertexPosition(vertex, now);
          const mm = 1000 * now.distanceTo(before.fromBufferAttribute(neutral, vertex));
          if (mm > found.mm) Object.assign(found, { mm, mesh: mesh.name });
        }
      }
    }
    return found;
  }

  /** A white surface whose colour is a GLSL expression. */
  private paint(expression: string): MeshStandardMaterial {
    const material = new MeshStandardMaterial({ roughness: 0.9, side: 2, toneMapped: false });
    material.customProgramCacheKey = () => expression;
    material.onBeforeCompile = (shader: WebGLProgramParametersWithUniforms) => {
      shader.uniforms.paintRange = this.range;
      shader.uniforms.paintScale = { value: VIRIDIS.map((color) => new Vector3(...linear(color))) };
      shader.vertexShader = `${VERTEX_HEAD}${shader.vertexShader.replace("#include <skinning_vertex>", VERTEX)}`;
      const colored = `vec3 paint = ${expression}; diffuseColor.rgb = 0.45 * paint; totalEmissiveRadiance = 0.5 * paint;`;
      const body = shader.fragmentShader.replace("#include <color_fragment>", colored); // half of it lit: still to be read
      shader.fragmentShader = `${FRAGMENT_HEAD}${body}`;
    };
    return material;
  }
}

const VERTEX_HEAD = "attribute vec3 paintNeutral, paintRegion; varying vec3 vRegion; varying float vDistance;\n";
const VERTEX = `#include <skinning_vertex>
vRegion = paintRegion;
vDistance = 1000.0 * length(mat3(modelMatrix) * (transformed - paintNeutral));`;
const FRAGMENT_HEAD = `uniform float paintRange; uniform vec3 paintScale[${VIRIDIS.length}];
varying vec3 vRegion; varying float vDistance;
vec3 scaled(float share) {
  float at = clamp(share, 0.0, 1.0) * ${VIRIDIS.length - 1}.0;
  int low = int(min(floor(at), ${VIRIDIS.length - 2}.0));
  return mix(paintScale[low], paintScale[low + 1], at - float(low));
}
`;

/** Vertices as they are now, in the space of their mesh. */
function neutralOf(primitive: Mesh): BufferAttribute {
  const count = primitive.geometry.attributes.position.count;
  const found = new BufferAttribute(new Float32Array(3 * count), 3);
  const at = new Vector3();
  primitive.updateWorldMatrix(true, true);
  for (let vertex = 0; vertex < count; vertex++) found.setXYZ(vertex, ...primitive.getVertexPosition(vertex, at).toArray());
  return found;
}

/** Where the points of each mesh begin among those of all meshes of the stage. */
function firstPoints(details: Details | null, meshes: FaceMesh[]): Map<string, number> {
  let first = 0;
  const all = details?.meshes ?? meshes.map((mesh) => ({ name: mesh.name, points: mesh.pointCount }));
  return new Map(all.map(({ name, points }) => [name, (first += points) - points]));
}

/** Linear colour of every point, mixed by its shares of the regions; null where there are none. */
function regionColors(details: Details | null, masks: Uint8Array | null): Float32Array | null {
  const regions = details?.regions;
  if (!regions || !masks) return null;
  const colors = regions.names.map((_, i) => linear(regionColor(i)));
  const count = masks.length / regions.names.length;
  const found = new Float32Array(3 * count);
  for (let point = 0; point < count; point++) {
    let total = 0;
    colors.forEach((color, region) => {
      const share = masks[region * count + point];
      total += share;
      for (let i = 0; i < 3; i++) found[3 * point + i] += share * color[i];
    });
    for (let i = 0; i < 3; i++) found[3 * point + i] = total ? found[3 * point + i] / total : linear(NO_REGION)[i];
  }
  return found;
}

function colorsOf(primitive: Mesh, colors: Float32Array | null, first: number): BufferAttribute {
  const numbers = pointNumbers(primitive);
  const grey = linear(NO_REGION);
  const found = Float32Array.from({ length: 3 * numbers.length }, (_, i) =>
    colors ? colors[3 * (first + numbers[Math.floor(i / 3)]) + (i % 3)] : grey[i % 3],
  );
  return new BufferAttribute(found, 3);
}
