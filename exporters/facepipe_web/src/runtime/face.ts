/** A face in a three.js scene, driven by sliders, shape weights and bone coefficients. */
import { type Group, Matrix4, type Mesh, Vector3 } from "three";
import type { Basis } from "./basis";
import { Clip, type ClipInfo } from "./clips";
import { localMotions } from "./coefficients";
import { FaceError } from "./errors";
import { type Followed, followedPoints } from "./followed";
import type { FaceMesh, LoadedGlb } from "./glb";
import { Joints } from "./joints";
import { resetShapes, setLids, turnShapes } from "./person_targets";
import { fittedLids } from "./lids";
import { type Metadata, output, sliderInput } from "./metadata";
import type { Network } from "./network";
import { resetNeutral, setNeutral } from "./neutral";
import { jointsHash, type Payload } from "./payload";
import { jointPlaces, jointTurns, type Person, rebuilt, shapesTurn } from "./person";
import { readPictures, setPictures } from "./pictures";
import { readPoints } from "./read_points";
import { setFromGraph, setFromShapes, shapesOf } from "./targets";

const MM = 1e-3; // metres

export interface SliderInfo {
  name: string;
  group: string;
  minimum: number;
  maximum: number;
  /** value of the neutral */
  default: number;
  /** value that is set on the face */
  value: number;
  mirror: string | null;
}

/** What a GLB alone does not hold, and the metadata of the graph does. */
export interface JointFacts {
  paths: string[];
  /** 4 rows: units and axes of the stage -> glTF */
  axes: number[][];
}

export class Face {
  /** to be added to a scene; metres, Y up */
  readonly root: Group;
  readonly meshes: FaceMesh[];
  readonly joints: Joints | null;
  readonly sliders: SliderInfo[];
  readonly shapes: string[];
  /** of the GLB, those that move */
  readonly clips: ClipInfo[];
  readonly copyright: string;
  private readonly shapeWeights = new Map<string, number>();
  private readonly followed = new Map<Basis, Map<Mesh, Followed>>();
  private motions: Matrix4[] | null = null; // of a payload, in place of those of the graph
  private moment: { clip: Clip; seconds: number } | null = null;
  private dirty = false;
  private running: Promise<void> | null = null;

  constructor(
    glb: LoadedGlb,
    readonly network: Network | null,
    private readonly facts: JointFacts | null = null,
  ) {
    this.root = glb.root;
    this.meshes = glb.meshes;
    this.clips = glb.clips.map((one) => new Clip(one, glb.root, glb.meshes)).filter(({ start, end }) => end > start);
    this.copyright = glb.copyright;
    this.joints = glb.skeleton && new Joints(glb.skeleton, glb.root);
    const metadata = network?.metadata;
    this.sliders = metadata ? described(metadata) : [];
    this.shapes = metadata ? (metadata.inputs.find((one) => one.name === "weights")?.names ?? []) : shapesOf(glb.meshes);
    const moved = metadata && output(metadata, "skinning_matrices");
    if (moved) {
      this.joints?.follow(moved);
      this.facts ??= { paths: moved.joints!, axes: axesOf(moved) };
    }
  }

  /**
   * Set sliders by name, in their own units; the others stay. Resolves when the face has taken them.
   * @throws FaceError an unknown slider, or a number that is not finite
   */
  setSliders(values: Record<string, number>): Promise<void> {
    for (const [name, value] of Object.entries(values)) {
      const place = this.sliders.findIndex((one) => one.name === name);
      if (place < 0) throw new FaceError("sliders", `no slider '${name}'`);
      this.network!.values("sliders")[place] = finite(name, value);
    }
    return this.update();
  }

  /**
   * Set shape weights by name, 0 the neutral, 1 the sculpt; they add to what sliders drive.
   * @throws FaceError an unknown shape, or a number that is not finite
   */
  setShapes(weights: Record<string, number>): Promise<void> {
    for (const [name, weight] of Object.entries(weights)) {
      if (!this.shapes.includes(name)) throw new FaceError("shapes", `no shape '${name}'`);
      this.shapeWeights.set(name, finite(name, weight));
    }
    return this.update();
  }

  /**
   * Put the joints where bone coefficients say, until `setPayload(null)`; shapes stay with sliders and weights.
   * @param frame of the payload
   * @throws FaceError a payload for other joints, or no such frame
   */
  async setPayload(payload: Payload | null, frame = 0): Promise<void> {
    if (payload === null) {
      this.motions = null;
      return this.update();
    }
    await this.checkPayload(payload);
    const coefficients = payload.frames[frame];
    if (!coefficients) throw new FaceError("payload", `no frame ${frame}, expected one below ${payload.frames.length}`);
    const axes = new Matrix4().fromArray(this.facts!.axes.flat()).transpose();
    this.motions = localMotions(coefficients, axes, this.joints!.rest.map(() => new Matrix4()));
    return this.update();
  }

  /**
   * Be a person, until `setPerson(null)`: points, normals and joints are theirs, and sliders, shapes and payloads move
   * these. Cards and other meshes go with the points of the basis, and lids fit the eyeballs in blinks, looks and squints;
   * materials have the person's pictures, if any.
   * @param basis of which the GLB has the meshes
   * @throws FaceError a person of another basis, or a basis of another face
   */
  setPerson(person: null): Promise<void>;
  setPerson(person: Person, basis: Basis): Promise<void>;
  async setPerson(person: Person | null, basis?: Basis): Promise<void> {
    if (!person || !basis) {
      this.meshes.forEach(resetNeutral);
      resetShapes(this.meshes);
      this.joints?.setRest(new Map());
      setPictures(this.meshes, new Map());
      return this.update();
    }
    const millimetres = rebuilt(basis, person);
    const lids = fittedLids(basis, millimetres, person);
    const points = millimetres.map((value) => value * MM);
    const followed = this.followed.get(basis) ?? followedPoints(this.meshes, basis);
    this.followed.set(basis, followed);
    setPictures(this.meshes, await readPictures(person.pictures, person.where));
    for (const mesh of this.meshes) {
      setNeutral(mesh, (primitive, vertex, _, out) => {
        const { width, rows, shares, offsets } = followed.get(primitive)!;
        out.fromArray(offsets, 3 * vertex);
        for (let k = vertex * width; k < (vertex + 1) * width; k++) {
          const [share, at] = [shares[k], 3 * rows[k]];
          out.x += share * points[at];
          out.y += share * points[at + 1];
          out.z += share * points[at + 2];
        }
      });
    }
    resetShapes(this.meshes);
    if (person.rig) turnShapes(this.meshes, shapesTurn(person.rig), new Set(lids.map(({ name }) => name)));
    setLids(this.meshes, followed, basis.count, lids);
    const [places, turns] = [jointPlaces(basis, millimetres, person.rig), jointTurns(basis, person.rig)];
    const rest = (i: number) => {
      const [a, b, c, d, e, f, g, h, k] = turns.subarray(9 * i, 9 * i + 9);
      return new Matrix4().set(a, b, c, 0, d, e, f, 0, g, h, k, 0, 0, 0, 0, 1).setPosition(new Vector3().fromArray(places, 3 * i).multiplyScalar(MM));
    };
    this.joints?.setRest(new Map(basis.joints.map(({ path }, i) => [path, rest(i)])));
    return this.update();
  }

  /**
   * Show a moment of a clip on top of sliders, shapes and payload, until `setClip(null)`.
   * @param name of one of `clips`
   * @param seconds on its own clock, `start` to `end`
   * @throws FaceError no such clip
   */
  setClip(name: string | null, seconds = 0): Promise<void> {
    const clip = this.clips.find((one) => one.name === name) as Clip | undefined;
    if (name !== null && !clip) throw new FaceError("clips", `no clip '${name}'`);
    this.moment = clip ? { clip, seconds: finite("seconds", seconds) } : null;
    return this.update();
  }

  /** Values of all sliders as they were set last. */
  get sliderValues(): Record<string, number> {
    const values = this.network?.values("sliders");
    return Object.fromEntries(this.sliders.map((one, i) => [one.name, values![i]]));
  }

  /** Weights of the shapes that were set. */
  get shapeValues(): Record<string, number> {
    return Object.fromEntries(this.shapeWeights);
  }

  /** All sliders at the neutral, all shapes off, no payload; the person stays. */
  reset(): Promise<void> {
    const sliders = this.network?.values("sliders");
    this.sliders.forEach((one, i) => (sliders![i] = one.default));
    this.shapeWeights.clear();
    this.motions = null;
    return this.update();
  }

  /**
   * Points of a mesh as they are now, read back on the CPU: 3 numbers a point of the stage, metres, Y up.
   * @throws FaceError no such mesh
   */
  points(mesh: string): Float32Array {
    const own = this.meshes.find((one) => one.name === mesh);
    if (!own) throw new FaceError("points", `no mesh '${mesh}', expected one of ${this.meshes.map((one) => one.name).join(", ")}`);
    return readPoints(this.root, own);
  }

  /** Free what the face holds on the GPU and in WebAssembly. */
  async dispose(): Promise<void> {
    this.root.removeFromParent();
    for (const primitive of this.meshes.flatMap((mesh) => mesh.primitives)) primitive.geometry.dispose();
    await this.running;
    await this.network?.release();
  }

  /** One evaluation at a time; what is set meanwhile is taken by the next. */
  private update(): Promise<void> {
    this.dirty = true;
    this.running ??= this.evaluate();
    return this.running;
  }

  private async evaluate(): Promise<void> {
    try {
      while (this.dirty) {
        this.dirty = false;
        const moment = this.moment?.clip.at(this.moment.seconds);
        const weights = new Map(this.shapeWeights);
        for (const [name, weight] of moment?.weights ?? []) weights.set(name, (weights.get(name) ?? 0) + weight);
        this.network?.values("weights").set(this.shapes.map((name) => weights.get(name) ?? 0));
        const found = await this.network?.run();
        if (this.motions) this.joints!.setLocals(this.motions);
        else if (found?.matrices) this.joints?.setSkinning(found.matrices);
        else this.joints?.setLocals(this.joints.rest.map(() => new Matrix4()));
        if (found?.morphs) setFromGraph(this.meshes, this.network!.metadata, found.morphs);
        else if (!this.network) setFromShapes(this.meshes, weights);
        if (moment?.motions.size) this.joints?.add(moment.motions);
      }
    } finally {
      this.running = null;
    }
  }

  private async checkPayload(payload: Payload): Promise<void> {
    if (!this.joints) throw new FaceError("payload", "this face has no joints");
    if (!this.facts) throw new FaceError("payload", "a GLB alone does not hold its joints' paths, expected its ONNX too");
    const hash = await jointsHash(this.facts.paths);
    if (payload.jointCount !== this.facts.paths.length || payload.jointsHash !== hash) {
      const own = `${this.facts.paths.length}, hash ${hash}`;
      throw new FaceError("payload", `made for other joints (${payload.jointCount}, hash ${payload.jointsHash}), expected ${own}`);
    }
  }
}

function described(metadata: Metadata): SliderInfo[] {
  const input = sliderInput(metadata);
  return input.names.map((name, i) => ({
    name,
    group: input.groups[i],
    minimum: input.range[i][0],
    maximum: input.range[i][1],
    default: input.default[i],
    value: input.values[i],
    mirror: metadata.sliders[i]?.mirror ?? null,
  }));
}

/** Units and axes of the stage with the skeleton's scale, from the constants of the graph. */
function axesOf(moved: { gltf_from_world?: number[][]; skeleton_from_gltf?: number[][] }): number[][] {
  const world = new Matrix4().fromArray(moved.gltf_from_world!.flat()).transpose();
  const back = new Matrix4().fromArray(moved.skeleton_from_gltf!.flat()).transpose();
  const scale = Math.cbrt(1 / Math.abs(back.determinant())) / Math.cbrt(Math.abs(world.determinant()));
  return moved.gltf_from_world!.map((row, i) => row.map((value, k) => (i < 3 && k < 3 ? value * scale : +(i === k))));
}

function finite(name: string, value: number): number {
  if (!Number.isFinite(value)) throw new FaceError(name, `is ${value}, expected a finite number`);
  return value;
}
