/** The picture of the studio: one face or two, a click that finds the region under it. */
import { type Mesh, Raycaster, Vector2 } from "three";
import { FaceError } from "../runtime";
import { pointNumbers } from "../runtime/glb";
import { Divider } from "../viewer/divider";
import { h, throttled } from "../viewer/dom";
import { Legend, roundEnd } from "../viewer/legend";
import type { Coloring } from "../viewer/look";
import { say } from "../viewer/messages";
import { Picture } from "../viewer/scene";
import { action, choice } from "../viewer/toolbar";
import { ViewedFace } from "../viewer/viewed_face";
import { ask, fileOf, type Source } from "./api";
import { onDrop } from "./work";

const STILL = 4; // pixels that a click may move: more is a turn of the head

export class Bench {
  readonly picture: Picture;
  face: ViewedFace | null = null;
  other: ViewedFace | null = null;
  /** called with the region that was clicked */
  picked: (region: string) => void = () => {};
  /** called with files that are dropped on the picture */
  dropped: (files: File[]) => void = () => {};
  private coloring: Coloring = "material";
  private readonly legend = new Legend();
  private readonly divider: Divider;
  private readonly hint = h("p", { class: "hint", hidden: true });
  private loading = 0;
  private readonly measured = throttled(200, () => this.measure());

  /** @throws Error a browser without WebGL */
  constructor(view: HTMLElement) {
    this.picture = new Picture(view);
    this.divider = new Divider(this.picture, view);
    const colorings: [Coloring, string][] = [["material", "Skin"], ["regions", "Regions"], ["distance", "Distance"]];
    const colors = choice({ label: "Colours", values: colorings, value: "material", change: (value) => this.color(value) });
    const front = action("Front", "f", () => this.picture.frame());
    const bar = h("div", { class: "toolbar", role: "toolbar", "aria-label": "View" }, colors, h("span", { class: "space" }), front);
    view.append(bar, this.legend.element, this.hint, ...this.divider.elements);
    this.listen();
    onDrop(this.picture.canvas, (files) => this.dropped(files));
  }

  /** Load a version and show it; null where it can't be shown, or another was asked for meanwhile. */
  async open(source: Source, label: string, kept = false): Promise<ViewedFace | null> {
    const number = ++this.loading;
    this.say("Loading the face …");
    try {
      const face = await load(source, label);
      if (number !== this.loading) {
        await face.face.dispose();
        return null;
      }
      const before = kept ? [] : [this.face, this.other];
      if (kept) this.other = face;
      else [this.face, this.other] = [face, null];
      this.show();
      for (const one of before) await one?.face.dispose();
      return face;
    } finally {
      if (number === this.loading) this.say(null);
    }
  }

  /** Show nothing. */
  async clear(): Promise<void> {
    this.loading++;
    this.say(null);
    const before = [this.face, this.other];
    this.face = this.other = null;
    this.legend.hide();
    this.picture.clear();
    for (const one of before) await one?.face.dispose();
  }

  /** The face has moved. */
  changed(): void {
    this.picture.invalidate();
    if (this.coloring === "distance") this.measured();
  }

  /** One line over the picture; null: none. */
  say(text: string | null): void {
    this.hint.textContent = text;
    this.hint.hidden = text === null;
  }

  private show(): void {
    const [face, other] = [this.face!, this.other];
    const empty = !this.picture.faces;
    this.picture.compare = other ? "split" : "off";
    this.picture.show(face, other);
    if (empty || other) this.picture.frame();
    this.divider.update([face.entry.label, other?.entry.label ?? ""]);
    this.color(this.coloring);
  }

  private color(coloring: Coloring): void {
    this.coloring = coloring;
    this.face?.look.set(coloring, false);
    this.other?.look.set(coloring, false);
    this.legend.hide();
    if (coloring === "regions" && this.face) this.legend.regions(this.face.regionNames);
    if (coloring === "distance") this.measure();
    this.picture.invalidate();
  }

  /** How far points are from where the file has them. */
  private measure(): void {
    if (!this.face || this.coloring !== "distance") return;
    const largest = this.face.look.largest();
    for (const one of [this.face, this.other]) if (one) one.look.range.value = roundEnd(largest.mm);
    this.legend.distance(roundEnd(largest.mm), largest);
    this.picture.invalidate();
  }

  private listen(): void {
    let from: [number, number] | null = null;
    const { canvas } = this.picture;
    canvas.addEventListener("pointerdown", (event) => (from = [event.clientX, event.clientY]));
    canvas.addEventListener("pointerup", (event) => {
      const moved = from && Math.hypot(event.clientX - from[0], event.clientY - from[1]);
      from = null;
      if (moved === null || moved > STILL) return;
      const region = this.regionAt(event.clientX, event.clientY);
      if (region) this.picked(region);
    });
  }

  /** The region at a place of the window. */
  private regionAt(x: number, y: number): string | null {
    const { left, top, width, height } = this.picture.canvas.getBoundingClientRect();
    if (!this.face) return null;
    const ray = new Raycaster();
    ray.setFromCamera(new Vector2((2 * (x - left)) / width - 1, 1 - (2 * (y - top)) / height), this.picture.camera);
    const owners = new Map(this.face.face.meshes.flatMap((mesh) => mesh.primitives.map((one) => [one, mesh.name] as const)));
    for (const hit of ray.intersectObjects([...owners.keys()], false)) {
      const numbers = pointNumbers(hit.object as Mesh);
      const points = [hit.face!.a, hit.face!.b, hit.face!.c].map((vertex) => numbers[vertex]);
      const region = this.face.regionOf(owners.get(hit.object as Mesh)!, points);
      if (region) return region; // hair and lashes are in none: what is below them counts
    }
    return null;
  }
}

/** A version's face; without its sliders where it has none, or the browser can't run them. */
async function load(source: Source, label: string): Promise<ViewedFace> {
  const file = (what: string) => `api/v1/${fileOf(source, what)}`;
  await ask(fileOf(source, "details.json")); // made with the others: what is wrong is said in one line
  const sliders = (await fetch(file("sliders.onnx.json"))).ok;
  const entry = { label, glb: file("face.glb"), onnx: sliders ? file("sliders.onnx") : null, details: file("details.json"), masks: file("regions.bin") };
  try {
    return await ViewedFace.load(entry);
  } catch (error) {
    if (!entry.onnx) throw error;
    say(`${label}: ${error instanceof FaceError ? error.what : error} It is shown without its sliders.`);
    return ViewedFace.load({ ...entry, onnx: null });
  }
}
