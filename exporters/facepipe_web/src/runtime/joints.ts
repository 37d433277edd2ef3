/** The joints of a face: brought to where a graph or bone coefficients put them. */
import { type Bone, type Group, Matrix4, type Skeleton } from "three";
import { FaceError } from "./errors";
import type { Output } from "./metadata";

export class Joints {
  readonly bones: Bone[];
  /** number of each joint's parent, -1 for a root */
  readonly parents: number[];
  /** where each joint is below its parents, by their names in the file */
  readonly paths: string[];
  /** of each joint, relative to its parent joint (a root: to the face) */
  rest: Matrix4[];
  private readonly fileRest: Matrix4[];
  private readonly fileWorlds: Matrix4[];
  private readonly fileInverses: Matrix4[];
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
    this.paths = this.bones.map((bone) => (bone.userData.name as string | undefined) ?? bone.name);
    this.parents.forEach((parent, i) => parent >= 0 && (this.paths[i] = `${this.paths[parent]}/${this.paths[i]}`));
    this.rest = this.fileRest = this.locals(worlds);
    this.fileWorlds = worlds;
    this.fileInverses = skeleton.boneInverses.map((inverse) => inverse.clone());
    this.bones.forEach((bone, i) => {
      root.add(bone);
      bone.matrixAutoUpdate = false;
      bone.matrix.copy(worlds[i]);
      bone.matrixWorldNeedsUpdate = true;
    });
    this.inverses = skeleton.boneInverses;
  }

  private readonly inverses: Matrix4[];

  /**
   * Have joints rest elsewhere; the others keep their place below their parents.
   * @param rests by path, in the space of the face; none: as in the file
   */
  setRest(rests: ReadonlyMap<string, Matrix4>): void {
    const worlds: Matrix4[] = [];
    this.bones.forEach((_, i) => {
      const rest = rests.get(this.paths[i]);
      const parent = this.parents[i];
      if (rest) worlds.push(rest);
      else worlds.push(parent < 0 ? this.fileWorlds[i].clone() : worlds[parent].clone().multiply(this.fileRest[i]));
      this.inverses[i].copy(worlds[i]).invert().multiply(this.fileWorlds[i]).multiply(this.fileInverses[i]);
    });
    this.rest = rests.size ? this.locals(worlds) : this.fileRest;
  }

  private locals(worlds: Matrix4[]): Matrix4[] {
    return worlds.map((world, i) => {
      const parent = this.parents[i];
      return parent < 0 ? world.clone() : worlds[parent].clone().invert().multiply(world);
    });
  }

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
    if (this.rest === this.fileRest) return;
    // the graph's joints are those of the file: what they do relative to their rest, others do at theirs
    const moved = this.locals(this.bones.map((bone) => bone.matrix));
    this.setLocals(moved.map((local, i) => local.premultiply(scratch.copy(this.fileRest[i]).invert())));
  }

  /** @param motions of some joints, after what they do now: relative to their rest */
  add(motions: ReadonlyMap<unknown, Matrix4>): void {
    const locals = this.locals(this.bones.map((bone) => bone.matrix));
    this.bones.forEach((bone, i) => {
      const motion = motions.get(bone);
      if (motion) locals[i].multiply(motion);
      bone.matrix.copy(locals[i]);
      if (this.parents[i] >= 0) bone.matrix.premultiply(this.bones[this.parents[i]].matrix);
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
