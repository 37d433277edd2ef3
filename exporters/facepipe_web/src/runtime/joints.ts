/** The joints of a face: brought to where a graph or bone coefficients put them. */
import { type Bone, type Group, Matrix4, type Skeleton } from "three";
import { FaceError } from "./errors";
import type { Output } from "./metadata";

export class Joints {
  readonly bones: Bone[];
  /** number of each joint's parent, -1 for a root */
  readonly parents: number[];
  /** of each joint, relative to its parent joint (a root: to the face), as in the file */
  readonly rest: Matrix4[];
  private fromWorld = new Matrix4();
  private toJoint: Matrix4[] = [];
  private readonly scratch = new Matrix4();

  /** @param root all joints become its children: their matrices are given, none is derived from its parent's */
  constructor(skeleton: Skeleton, root: Group) {
    this.bones = skeleton.bones;
    const number = new Map(this.bones.map((bone, i) => [bone as unknown, i]));
    this.parents = this.bones.map((bone) => {
      let above = bone.parent;
      while (above && !number.has(above)) above = above.parent;
      return above ? number.get(above)! : -1;
    });
    const toRoot = root.matrixWorld.clone().invert();
    const worlds = this.bones.map((bone) => toRoot.clone().multiply(bone.matrixWorld));
    this.rest = worlds.map((world, i) => {
      const parent = this.parents[i];
      return parent < 0 ? world.clone() : worlds[parent].clone().invert().multiply(world);
    });
    this.bones.forEach((bone, i) => {
      root.add(bone);
      bone.matrixAutoUpdate = false;
      bone.matrix.copy(worlds[i]);
      bone.matrixWorldNeedsUpdate = true;
    });
    this.inverses = skeleton.boneInverses;
  }

  private readonly inverses: Matrix4[];

  /** Take the constants that bring skinning matrices of a graph to glTF space. */
  follow(output: Output): void {
    this.fromWorld = matrix(output.gltf_from_world!);
    const back = matrix(output.skeleton_from_gltf!);
    this.toJoint = this.inverses.map((inverse) => back.clone().multiply(inverse.clone().invert()));
  }

  /** @param matrices 16 numbers a joint, row by row: what skins points of the stage */
  setSkinning(matrices: Float32Array): void {
    const { scratch } = this;
    this.bones.forEach((bone, i) => {
      scratch.fromArray(matrices, 16 * i).transpose();
      bone.matrix.multiplyMatrices(this.fromWorld, scratch).multiply(this.toJoint[i]);
      bone.matrixWorldNeedsUpdate = true;
    });
  }

  /** @param locals what each joint does relative to its rest, in glTF space */
  setLocals(locals: Matrix4[]): void {
    this.bones.forEach((bone, i) => {
      bone.matrix.multiplyMatrices(this.rest[i], locals[i]);
      const parent = this.parents[i];
      if (parent >= 0) bone.matrix.premultiply(this.bones[parent].matrix);
      bone.matrixWorldNeedsUpdate = true;
    });
  }
}

/** A matrix given as four rows. */
export function matrix(rows: number[][]): Matrix4 {
  if (rows.length !== 4) throw new FaceError("matrix", `${rows.length} rows, expected 4`);
  return new Matrix4().fromArray(rows.flat()).transpose();
}
