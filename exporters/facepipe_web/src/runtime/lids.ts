/** Blinks, looks and squints that fit a person's eyeballs: docs/files.md, "Lids". */
import type { Basis } from "./basis";
import { FaceError } from "./errors";
import { BANDS, bandOf, type LidEye, type LidTables, MARGIN, RINGS } from "./lid_tables";
import { jointPlaces, type Person } from "./person";

/** A shape at a weight: 1 the last, below it inbetweens. */
export interface LidShape {
  /** as ARKit has it */
  name: string;
  weight: number;
  /** points of the basis */
  points: number[];
  /** 3 numbers for each point, millimetres */
  offsets: Float64Array;
}

type Vector = [number, number, number];

const SHAPES: [string, number][] = [
  ...[0.25, 0.5, 0.75, 1].map((weight): [string, number] => ["eyeBlink", weight]),
  ...[["eyeLookUp", 1] as [string, number], ["eyeLookDown", 0.5] as [string, number], ["eyeLookDown", 1] as [string, number]],
  ...["eyeLookIn", "eyeLookOut", "eyeSquint"].map((name): [string, number] => [name, 1]),
];
const LOOKS = [
  { way: 1, middle: 0, turn: [-0.5, 0] }, // up; of a shape's number among ways, that of its half, radians about x and y
  { way: 3, middle: 2, turn: [0.5, 0] },
  { way: 4, middle: 0, turn: [0, -0.5] },
  { way: 5, middle: 0, turn: [0, 0.5] },
];
const SQUINT = 6;
const FAR = -90; // millimetres: below all that lies over an eyeball
// by ring: millimetres over the eyeball in a blink, in a look, and at the ends of sliders; share of the margin's motion
const LEAST = [-1, 0, 0.25, 0.8, 1.4, 1.7, 1.7, 1.7, 1.7, 1.5, 1, -1, -1];
const OVER = [FAR, 0, 0.2, 0.6, 1, 1.2, 1.2, 1.2, 1.2, 1.2, 1, FAR, FAR];
const OVER_AT_ENDS = [FAR, -1, -0.5, 0.1, 0.2, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3];
const FOLLOW = [0.6, 0.95, 1, 1, 1, 0.95, 0.81, 0.6, 0.42, 0.27, 0.17, 0.09, 0.03];
const TOUCH = [2, 3]; // rings that lie on the eyeball as the mean's do on theirs
const [SOFT_IN_BLINKS, SOFT] = [0.15, 0.1]; // millimetres over which lids begin to be pushed
const OVERLAP = 0.4; // millimetres that the upper margin goes below the lower
const TAPER = 0.04; // of the eye's width
const INSIDE = 9; // how much more squares of lids count that are in the eyeball
const [STEPS, ROUNDS] = [6, 12];
const STILL = 1e-6; // radians
const SIDE = 1.5; // of the table of an eyeball
const NOTHING = -1.5; // millimetres: what lies so far above is not pushed

/**
 * Shapes of a person's lids, in place of those of the head that everyone has. None where the basis has no tables of lids.
 * @param points of the person, as `rebuilt` gives them
 * @param person with where its joints rest; none: as the points have them
 * @throws FaceError an eye without width
 */
export function fittedLids(basis: Basis, points: Float64Array, person: Pick<Person, "where" | "rig"> | null = null): LidShape[] {
  const { lids } = basis;
  if (!lids) return [];
  const where = person?.where ?? "person";
  const heights = jointPlaces(basis, points, person?.rig).filter((_, i) => i % 3 === 1);
  const eyes = lids.eyes.map((eye, number) => new EyeFit(basis, lids, eye, number ? -1 : 1, points, heights, where));
  const size = (of: "own" | "mean") => eyes.reduce((sum, eye) => sum + Math.sqrt(eye[of].squares.reduce((all, one) => all + one, 0) / 3), 0);
  const scale = size("own") / size("mean");
  return eyes.flatMap((eye, number) =>
    [...eye.blinks(scale), ...eye.looks()].map((offsets, i) => {
      if (number) for (let k = 0; k < offsets.length; k += 3) offsets[k] = -offsets[k];
      return { name: SHAPES[i][0] + (number ? "Right" : "Left"), weight: SHAPES[i][1], points: eye.eye.lids, offsets };
    }),
  );
}

const dot = (a: Vector, b: Vector): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** log(1 + e^x) */
const soft = (x: number): number => Math.max(x, 0) + Math.log1p(Math.exp(-Math.abs(x)));

/** The right eye is fitted as its mirror image. */
class EyeFit {
  readonly own: { middle: Vector; squares: number[] };
  readonly mean: { middle: Vector; squares: number[] };
  private readonly lids: Float64Array;
  private readonly average: Float64Array;
  private readonly count: number;
  private readonly farthest: number;
  private readonly over: Float64Array;
  private readonly overAtEnds: Float64Array;
  private readonly heights: number[];
  private centre: Vector;
  private scale = 1;
  private readonly way: Vector = [0, 0, 0]; // the direction that `above` looked along

  constructor(
    basis: Basis,
    private readonly tables: LidTables,
    readonly eye: LidEye,
    mirror: number,
    points: Float64Array,
    heights: Float64Array,
    private readonly where: string,
  ) {
    const ball = Array.from({ length: eye.ball[1] - eye.ball[0] }, (_, i) => eye.ball[0] + i);
    const own = (row: number, axis: number) => (axis ? 1 : mirror) * points[3 * row + axis];
    const mean = (row: number, axis: number) => (axis ? 1 : mirror) * basis.mean[axis * basis.count + row];
    [this.own, this.mean] = [spreadOf(ball, own), spreadOf(ball, mean)];
    this.count = eye.lids.length;
    [this.over, this.overAtEnds] = [OVER, OVER_AT_ENDS].map((least) => Float64Array.from(tables.rings, (ring) => least[ring]));
    [this.lids, this.average] = [own, mean].map((of) => Float64Array.from({ length: 3 * this.count }, (_, i) => of(eye.lids[(i / 3) | 0], i % 3)));
    this.heights = eye.joints.map((joint) => heights[joint]);
    this.farthest = tables.reach.reduce((most, one) => Math.max(most, one), -Infinity);
    this.centre = eye.centre as Vector;
  }

  /** At a quarter, a half, three quarters and 1, with eyeballs of a scale. */
  blinks(scale: number): Float64Array[] {
    this.fitBall(scale);
    const start = this.lifted(this.lids);
    const closed = this.lifted(start.map((one, i) => one + this.eye.ways[i]));
    const end = this.lifted(this.met(closed));
    return [0.25, 0.5, 0.75, 1].map((share) => {
      const there = share < 1 ? this.lifted(this.arced(start, end, share)) : end;
      return there.map((one, i) => one - start[i]);
    });
  }

  /** Up, down at a half, down, in, out, and the squint. */
  looks(): Float64Array[] {
    const sizes = [this.own, this.mean].map(({ squares }) => squares.reduce((sum, one) => sum + Math.sqrt(one), 0));
    this.scale = sizes[0] / sizes[1];
    this.centre = this.own.middle.map((one, i) => one - this.scale * (this.mean.middle[i] - this.eye.centre[i])) as Vector;
    const ahead = turned(0, 0);
    const squint = this.ways(SQUINT);
    let mostOfSquint = larger(this.need(squint, ahead, this.over), this.needAtEnds(squint, ahead));
    const found: Float64Array[] = [];
    for (const { way, middle, turn } of LOOKS) {
      const [full, half] = [turned(turn[0], turn[1]), turned(turn[0] / 2, turn[1] / 2)];
      const own = this.ways(way);
      const between = middle ? this.ways(middle) : own.map((one) => 0.5 * one);
      let most = larger(larger(this.need(own, ahead, this.over), this.need(own, full, this.over)), this.needAtEnds(own, full));
      const atHalf = this.need(between, half, this.over);
      if (!middle) most = larger(most, atHalf.map((one) => 2 * one));
      const push = this.spread(most);
      if (middle) found.push(this.out(between, this.spread(larger(atHalf, push.map((one) => 0.5 * one)))));
      const last = this.out(own, push);
      found.push(last);
      mostOfSquint = larger(mostOfSquint, this.need(squint.map((one, i) => one + last[i]), full, this.overAtEnds));
    }
    return [...found, this.out(squint, this.spread(mostOfSquint))];
  }

  private ways(number: number): Float64Array {
    return this.eye.ways.subarray(3 * number * this.count, 3 * (number + 1) * this.count);
  }

  /** How far the mean's eyeball reaches along `way`: the mean of the nearest three points of its outside. */
  private reach(): number {
    const x = this.way[0];
    const y = this.way[1];
    const z = this.way[2];
    const own = bandOf(y);
    // squares of distances, the nearest first, and radii; one by one, as arrays of them are garbage by the million
    let a = Infinity;
    let b = Infinity;
    let c = Infinity;
    let p = 0;
    let q = 0;
    let r = 0;
    // the direction's band, then one above, one below ... until none on either side can have nearer ones
    for (let number = 0, shut = 0; number < 2 * BANDS && shut < 2; number++) {
      const band = number & 1 ? own + ((number + 1) >> 1) : own - (number >> 1);
      const apart = number === 0 ? 0 : number & 1 ? (2 * band) / BANDS - 1 - y : y + 1 - (2 * band + 2) / BANDS;
      if (band < 0 || band >= BANDS || !(apart * apart < c)) {
        shut++;
        continue;
      }
      shut = 0;
      const outside = this.eye.outside[band];
      let low = 0;
      for (let high = outside.length / 4; low < high; ) {
        const middle = (low + high) >> 1;
        if (outside[4 * middle] < x) low = middle + 1;
        else high = middle;
      }
      for (let step = 4, at = 4 * low; ; at += step) {
        const dx = at >= 0 && at < outside.length ? outside[at] - x : Infinity;
        if (!(dx * dx < c)) {
          if (step < 0) break;
          step = -4; // up first, then down
          at = 4 * low;
          continue;
        }
        const dy = outside[at + 1] - y;
        const dz = outside[at + 2] - z;
        const square = dx * dx + dy * dy + dz * dz;
        if (!(square < c)) continue;
        c = square;
        r = outside[at + 3];
        if (!(c < b)) continue;
        c = b;
        r = q;
        b = square;
        q = outside[at + 3];
        if (!(b < a)) continue;
        b = a;
        q = p;
        a = square;
        p = outside[at + 3];
      }
    }
    const u = 1 / (Math.sqrt(a) + 1e-3);
    const v = 1 / (Math.sqrt(b) + 1e-3);
    const w = 1 / (Math.sqrt(c) + 1e-3);
    return (u * p + v * q + w * r) / (u + v + w);
  }

  /** How far a point lies over the eyeball; `way` is its direction then. */
  private above(points: Float64Array, row: number): number {
    const { way, centre } = this;
    for (let axis = 0; axis < 3; axis++) way[axis] = points[3 * row + axis] - centre[axis];
    const far = Math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
    for (let axis = 0; axis < 3; axis++) way[axis] /= far;
    return far - this.scale * this.reach();
  }

  private lifted(lids: Float64Array): Float64Array {
    const found = lids.slice();
    for (let row = 0; row < this.count; row++) {
      const least = LEAST[this.tables.rings[row]];
      if (least < 0) continue;
      const lift = SOFT_IN_BLINKS * soft((least - this.above(lids, row)) / SOFT_IN_BLINKS);
      for (let axis = 0; axis < 3; axis++) found[3 * row + axis] += lift * this.way[axis];
    }
    return found;
  }

  /** Move the eyeball a little, so that lids lie on it as the mean's do on theirs: steps of Gauss and Newton. */
  private fitBall(scale: number): void {
    const { eye, own, mean, way } = this;
    const touching = Array.from({ length: this.count }, (_, row) => row).filter((row) => TOUCH.includes(this.tables.rings[row]));
    [this.centre, this.scale] = [[...eye.centre] as Vector, 1];
    const goals = touching.map((row) => this.above(this.average, row));
    const start = eye.centre.map((one, i) => one + own.middle[i] - mean.middle[i]) as Vector;
    [this.centre, this.scale] = [[...start] as Vector, scale];
    for (let step = 0; step < STEPS; step++) {
      const rows = start.map((one, a) => [0, 1, 2].map((b) => +(a === b)).concat(one - this.centre[a]));
      touching.forEach((row, i) => {
        const miss = this.above(this.lids, row) - goals[i];
        const weight = miss < 0 ? INSIDE : 1;
        for (let a = 0; a < 3; a++) {
          for (let b = 0; b < 3; b++) rows[a][b] += weight * way[a] * way[b];
          rows[a][3] += weight * way[a] * miss;
        }
      });
      const move = solved(rows);
      for (let axis = 0; axis < 3; axis++) this.centre[axis] += move[axis];
    }
  }

  /** Lids with the upper margin brought onto the lower one, and the lid drawn after it. */
  private met(lids: Float64Array): Float64Array {
    const [inner, outer] = this.tables.corners;
    const across = [0, 1, 2].map((axis) => lids[3 * outer + axis] - lids[3 * inner + axis]);
    const square = across.reduce((sum, one) => sum + one * one, 0);
    const axis = across.map((one) => one / square);
    const flat = Math.hypot(axis[0], axis[1]);
    const sign = axis[0] < 0 ? -1 : 1; // (y, -x, 0) points down where x is above 0
    const down = [(sign * axis[1]) / flat, (-sign * axis[0]) / flat, 0];
    const along = Float64Array.from({ length: this.count }, (_, row) => axis.reduce((sum, one, k) => sum + one * (lids[3 * row + k] - lids[3 * inner + k]), 0));
    if (!along.every(Number.isFinite)) throw new FaceError(`${this.where} -> lids`, "an eye without width, expected corners that are apart");
    const found = lids.slice();
    for (let ring = 0; ring < RINGS; ring++) {
      const [lower, upper] = [0, 1].map((side) => this.rows(Math.min(ring, MARGIN), side).sort((a, b) => along[a] - along[b]));
      const places = [lower, upper].map((rows) => rows.map((row) => along[row]));
      const goals = lower.map((row) => lids.subarray(3 * row, 3 * row + 3));
      const moves = upper.map((row) => {
        const end = Math.min(along[row] - places[0][0], places[0][lower.length - 1] - along[row]);
        const taper = Math.min(Math.max(end / TAPER, 0), 1);
        const way = between(along[row], places[0], goals).map((one, k) => taper * (one - lids[3 * row + k]));
        const aside = way.reduce((sum, one, k) => sum + one * axis[k], 0);
        return way.map((one, k) => one + OVERLAP * taper * down[k] - aside * across[k]);
      });
      for (const row of ring <= MARGIN ? upper : this.rows(ring, 1)) {
        between(along[row], places[1], moves).forEach((one, k) => (found[3 * row + k] += FOLLOW[ring] * one));
      }
    }
    return found;
  }

  private rows(ring: number, upper: number): number[] {
    const found: number[] = [];
    for (let row = 0; row < this.count; row++) if (this.tables.rings[row] === ring && this.tables.upper[row] === upper) found.push(row);
    return found;
  }

  /** Points a share of their way on arcs around the eyeball's middle. */
  private arced(start: Float64Array, end: Float64Array, share: number): Float64Array {
    const [x, y, z] = this.centre;
    const found = new Float64Array(start.length);
    for (let at = 0; at < start.length; at += 3) {
      const from: Vector = [start[at] - x, start[at + 1] - y, start[at + 2] - z];
      const to: Vector = [end[at] - x, end[at + 1] - y, end[at + 2] - z];
      const first = Math.sqrt(dot(from, from));
      const last = Math.sqrt(dot(to, to));
      const across: Vector = [from[1] * to[2] - from[2] * to[1], from[2] * to[0] - from[0] * to[2], from[0] * to[1] - from[1] * to[0]];
      const angle = Math.max(Math.atan2(Math.sqrt(dot(across, across)), dot(from, to)), STILL);
      const far = ((1 - share) * first + share * last) / Math.sin(angle);
      const p = (far * Math.sin((1 - share) * angle)) / first;
      const q = (far * Math.sin(share * angle)) / last;
      for (let axis = 0; axis < 3; axis++) found[at + axis] = this.centre[axis] + p * from[axis] + q * to[axis];
    }
    return found;
  }

  /**
   * Raise what offsets from the middle of a turned eyeball of a scale lack to lie over it.
   * What lies as far above as no eyeball reaches is not looked up.
   */
  private raise(found: Float64Array, offsets: Float64Array, turn: Float64Array, scale: number, least: Float64Array): void {
    const { cells, reach } = this.tables;
    const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = turn;
    const cell = (cells - 1) / (2 * SIDE);
    const farthest = scale * this.farthest;
    for (let index = 0, at = 0; index < found.length; index++, at += 3) {
      const x = offsets[at];
      const y = offsets[at + 1];
      const z = offsets[at + 2];
      const square = x * x + y * y + z * z;
      const most = least[index] + farthest - found[index];
      if (!(most > 0 && square < most * most)) continue;
      const far = Math.sqrt(square);
      const flat = 1 / (far + Math.max(x * xz + y * yz + z * zz, -0.5 * far));
      const u = Math.min(Math.max(((x * xx + y * yx + z * zx) * flat + SIDE) * cell, 0), cells - 1.001);
      const v = Math.min(Math.max(((x * xy + y * yy + z * zy) * flat + SIDE) * cell, 0), cells - 1.001);
      const column = u | 0;
      const row = v | 0;
      const s = u - column;
      const t = v - row;
      const place = row * cells + column;
      const low = (1 - s) * reach[place] + s * reach[place + 1];
      const high = (1 - s) * reach[place + cells] + s * reach[place + cells + 1];
      found[index] = Math.max(found[index], least[index] + scale * ((1 - t) * low + t * high) - far);
    }
  }

  private need(ways: Float64Array, turn: Float64Array, least: Float64Array): Float64Array {
    const { lids, centre } = this;
    const found = new Float64Array(this.count).fill(-Infinity);
    const offsets = ways.slice();
    for (let i = 0; i < offsets.length; i++) offsets[i] += lids[i] - centre[i % 3];
    this.raise(found, offsets, turn, this.scale, least);
    return found;
  }

  /** The most that lids lack at an end of a slider. */
  private needAtEnds(ways: Float64Array, turn: Float64Array): Float64Array {
    const { lids, centre, eye, tables, count, heights } = this;
    const found = new Float64Array(count).fill(NOTHING);
    const offsets = new Float64Array(3 * count);
    for (let end = 0; end < 2 * tables.sliders; end++) {
      const [slider, sign] = [end >> 1, end & 1 ? 1 : -1];
      const [bx, by, bz, growth] = eye.balls.slice(4 * slider, 4 * slider + 4);
      const [up, stretch] = [eye.stretches[2 * slider], eye.stretches[2 * slider + 1]];
      for (let row = 0, at = 0, own = 3 * slider * count; row < count; row++, at += 3, own += 3) {
        const height = lids[at + 1] + ways[at + 1] + sign * eye.ends[own + 1];
        const upper = eye.shares[row] * (up + stretch * (height - heights[0]));
        const lower = eye.shares[count + row] * (up + stretch * (height - heights[1]));
        offsets[at] = lids[at] + ways[at] + sign * (eye.ends[own] - bx) - centre[0];
        offsets[at + 1] = height + sign * (upper + lower - by) - centre[1];
        offsets[at + 2] = lids[at + 2] + ways[at + 2] + sign * (eye.ends[own + 2] - bz) - centre[2];
      }
      this.raise(found, offsets, turn, this.scale * (1 + sign * growth), this.overAtEnds);
    }
    return found;
  }

  /** Pushes of at least the need, as smooth as a skin drawn over them. */
  private spread(need: Float64Array): Float64Array {
    const { beside, links } = this.tables;
    const least = need.map((one) => SOFT * soft(one / SOFT));
    let [push, before] = [least.slice(), new Float64Array(need.length)];
    for (let round = 0; round < ROUNDS; round++) {
      [push, before] = [before, push];
      for (let row = 0; row < push.length; row++) {
        const near = beside[row];
        let sum = 0;
        for (let i = 0; i < near.length; i++) sum += before[near[i]];
        push[row] = Math.max(least[row], sum / links[row]);
      }
    }
    return push;
  }

  private out(ways: Float64Array, push: Float64Array): Float64Array {
    const { lids, centre } = this;
    const found = ways.slice();
    for (let row = 0, at = 0; row < this.count; row++, at += 3) {
      const x = lids[at] + ways[at] - centre[0];
      const y = lids[at + 1] + ways[at + 1] - centre[1];
      const z = lids[at + 2] + ways[at + 2] - centre[2];
      const share = push[row] / Math.sqrt(x * x + y * y + z * z);
      found[at] += share * x;
      found[at + 1] += share * y;
      found[at + 2] += share * z;
    }
    return found;
  }
}

/** The mean of points and their squares about it, by axes. */
function spreadOf(rows: number[], of: (row: number, axis: number) => number): { middle: Vector; squares: number[] } {
  const mean = (values: number[]) => values.reduce((sum, one) => sum + one, 0) / values.length;
  const middle = [0, 1, 2].map((axis) => mean(rows.map((row) => of(row, axis)))) as Vector;
  return { middle, squares: middle.map((one, axis) => mean(rows.map((row) => (of(row, axis) - one) ** 2))) };
}

/** A rotation about x and one about y, row by row; one of the angles is 0. */
function turned(x: number, y: number): Float64Array {
  const [a, b, c, d] = [Math.cos(x), Math.sin(x), Math.cos(y), Math.sin(y)];
  return Float64Array.of(c, 0, d, b * d, a, -b * c, -a * d, b, a * c);
}

function larger(one: Float64Array, other: Float64Array): Float64Array {
  return one.map((value, i) => Math.max(value, other[i]));
}

/** Of a symmetric positive definite matrix and a column beside it. */
function solved(rows: number[][]): Vector {
  for (let i = 0; i < 3; i++) {
    for (let k = i + 1; k < 3; k++) for (let column = 3; column >= i; column--) rows[k][column] -= (rows[k][i] / rows[i][i]) * rows[i][column];
  }
  const found: Vector = [0, 0, 0];
  for (let i = 2; i >= 0; i--) found[i] = (rows[i][3] - rows[i].slice(i + 1, 3).reduce((sum, one, k) => sum + one * found[i + 1 + k], 0)) / rows[i][i];
  return found;
}

/** Values between those at ascending places; beyond these the first or the last. */
function between(at: number, places: number[], values: ArrayLike<number>[]): number[] {
  let [next, end] = [0, places.length]; // the first place beyond
  while (next < end) {
    const middle = (next + end) >> 1;
    if (places[middle] <= at) next = middle + 1;
    else end = middle;
  }
  if (!next || next === places.length) return Array.from(values[next ? next - 1 : 0]);
  const share = (at - places[next - 1]) / (places[next] - places[next - 1]);
  return Array.from(values[next - 1], (one, k) => one + share * (values[next][k] - one));
}
