/** Clips of a GLB: what they do at a moment to shapes and joints. */
import { type AnimationClip, type Group, type Interpolant, Matrix4, type Object3D, PropertyBinding, Quaternion, Vector3 } from "three";
import type { FaceMesh } from "./glb";

export interface ClipInfo {
  name: string;
  /** seconds of its first and last key */
  start: number;
  end: number;
}

export interface Moment {
  /** weights of shapes */
  weights: Map<string, number>;
  /** of joints, relative to their rest */
  motions: Map<Object3D, Matrix4>;
}

interface Track {
  node: Object3D;
  property: string;
  values: Interpolant;
}

export class Clip implements ClipInfo {
  readonly name: string;
  readonly start: number;
  readonly end: number;
  private readonly tracks: Track[];

  /** @param root the face, joints among it where they are at rest */
  constructor(
    clip: AnimationClip,
    root: Group,
    private readonly meshes: FaceMesh[],
  ) {
    this.name = clip.name;
    const times = clip.tracks.flatMap((one) => [one.times[0], one.times[one.times.length - 1]]);
    [this.start, this.end] = [Math.min(...times), Math.max(...times)];
    this.tracks = clip.tracks.map((one) => {
      const { nodeName, propertyName } = PropertyBinding.parseTrackName(one.name);
      // three sets the method where a track is made; its types don't have it
      const { createInterpolant } = one as unknown as { createInterpolant: () => Interpolant };
      return { node: PropertyBinding.findNode(root, nodeName) as Object3D, property: propertyName, values: createInterpolant.call(one) };
    });
  }

  at(seconds: number): Moment {
    const weights = new Map<string, number>();
    const moved = new Map<Object3D, { position: Vector3; quaternion: Quaternion; scale: Vector3 }>();
    for (const { node, property, values } of this.tracks) {
      const found = values.evaluate(seconds) as ArrayLike<number>;
      if (property === "morphTargetInfluences") {
        const mesh = this.meshes.find((one) => (one.primitives as Object3D[]).includes(node));
        for (const [shape, weight] of mesh ? shapeWeights(mesh, found) : []) weights.set(shape, weight);
        continue;
      }
      const own = moved.get(node) ?? { position: node.position.clone(), quaternion: node.quaternion.clone(), scale: node.scale.clone() };
      own[property as keyof typeof own].fromArray(found as number[]);
      moved.set(node, own);
    }
    const motions = new Map([...moved].map(([node, { position, quaternion, scale }]) => {
      const rest = new Matrix4().compose(node.position, node.quaternion, node.scale);
      return [node, rest.invert().multiply(new Matrix4().compose(position, quaternion, scale))];
    }));
    return { weights, motions };
  }
}

/**
 * Shape weights of activations: a shape's targets are hats over its weights, which give lines back exactly. Activations
 * themselves do not add where a slider moves the same shape past an inbetween.
 */
function shapeWeights(mesh: FaceMesh, activations: ArrayLike<number>): Map<string, number> {
  const found = new Map<string, number>();
  mesh.targets.forEach((name, i) => {
    const { shape, weight } = mesh.inbetweens[name] ?? { shape: name, weight: 1 };
    found.set(shape, (found.get(shape) ?? 0) + weight * activations[i]);
  });
  return found;
}
