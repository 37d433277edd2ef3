/** Wrinkles that a face's shapes draw on its skin: `extras.facepipe.wrinkles` of a material (docs/files.md). */
import { type Mesh, type MeshStandardMaterial, type Texture, Vector4, type WebGLProgramParametersWithUniforms } from "three";
import type { GLTF } from "three/examples/jsm/loaders/GLTFLoader.js";
import type { FaceMesh } from "./glb";

interface TextureInfo {
  index: number;
  texCoord?: number;
}

interface Wrinkles {
  normal: TextureInfo;
  tint: TextureInfo;
  regions: { name: string; mask: TextureInfo; channel: "r" | "g" | "b" | "a"; shapes: Record<string, number> }[];
}

/** Have the materials of a mesh show its wrinkles; they follow the weights of its targets, whoever sets them. */
export async function wrinkle(mesh: FaceMesh, gltf: GLTF): Promise<void> {
  for (const primitive of mesh.primitives) {
    const material = primitive.material as MeshStandardMaterial;
    const own = (material.userData.facepipe as { wrinkles?: Wrinkles } | undefined)?.wrinkles;
    if (!own || !material.normalMap) continue;
    const numbers = [...new Set(own.regions.map((region) => region.mask.index))];
    const load = (number: number): Promise<Texture> => gltf.parser.getDependency("texture", number);
    const [normal, tint, ...masks] = await Promise.all([own.normal.index, own.tint.index, ...numbers].map(load));
    const strengths = numbers.map(() => new Vector4());
    patch(material, normal, tint, masks, strengths);
    primitive.onBeforeRender = () => {
      for (const strength of strengths) strength.set(0, 0, 0, 0);
      for (const { mask, channel, shapes } of own.regions) {
        strengths[numbers.indexOf(mask.index)].setComponent("rgba".indexOf(channel), strengthOf(shapes, mesh, primitive));
      }
    };
  }
}

/** Sum of shape weights times gains, within 0..1. A shape's weight is that of its targets, each by where it is reached. */
export function strengthOf(shapes: Record<string, number>, mesh: FaceMesh, primitive: Mesh): number {
  const weights = primitive.morphTargetInfluences ?? [];
  let sum = 0;
  mesh.targets.forEach((target, i) => {
    const between = mesh.inbetweens[target];
    sum += (shapes[between?.shape ?? target] ?? 0) * (between?.weight ?? 1) * (weights[i] ?? 0);
  });
  return Math.min(Math.max(sum, 0), 1);
}

function patch(material: MeshStandardMaterial, normal: Texture, tint: Texture, masks: Texture[], strengths: Vector4[]): void {
  material.customProgramCacheKey = () => `wrinkles ${masks.length}`;
  material.onBeforeCompile = (shader: WebGLProgramParametersWithUniforms) => {
    Object.assign(shader.uniforms, { wrinkleNormal: { value: normal }, wrinkleTint: { value: tint } });
    Object.assign(shader.uniforms, { wrinkleMasks: { value: masks }, wrinkleStrengths: { value: strengths } });
    const reads = masks.map((_, i) => `dot(texture2D(wrinkleMasks[${i}], vNormalMapUv), wrinkleStrengths[${i}])`);
    shader.fragmentShader = `uniform sampler2D wrinkleNormal, wrinkleTint, wrinkleMasks[${masks.length}];
uniform vec4 wrinkleStrengths[${masks.length}];
${shader.fragmentShader}`
      .replace("#include <color_fragment>", `#include <color_fragment>
float wrinkled = min(${reads.join(" + ")}, 1.0);
diffuseColor.rgb *= 1.0 + wrinkled * (texture2D(wrinkleTint, vNormalMapUv).rgb - 1.0);`)
      .replace("#include <normal_fragment_maps>", `${NORMAL}`);
  };
  material.needsUpdate = true;
}

/** three.js's own chunk for tangent-space normal maps, with the wrinkles' x and y added. */
const NORMAL = `vec3 mapN = texture2D(normalMap, vNormalMapUv).xyz * 2.0 - 1.0;
mapN.xy *= normalScale;
mapN.xy += wrinkled * sign(normalScale) * (texture2D(wrinkleNormal, vNormalMapUv).xy * 2.0 - 1.0);
normal = normalize(tbn * mapN);`;
