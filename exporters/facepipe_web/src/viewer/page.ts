/** The page: panel, picture and buttons around one face, and another to compare it with. */
import { type BlendEntry, BlendPanel } from "./blend_panel";
import { BonesOverlay } from "./bones";
import { Divider } from "./divider";
import { h, throttled } from "./dom";
import { Legend, roundEnd } from "./legend";
import type { Coloring } from "./look";
import { say, sayError } from "./messages";
import { shapePanel, sliderPanel } from "./panels";
import { PayloadPanel } from "./payload_panel";
import type { Row } from "./rows";
import type { Compare, Picture } from "./scene";
import { action, choice, onKey, toggle } from "./toolbar";
import { ViewedFace } from "./viewed_face";

type Values = Record<string, number>;

export class Page {
  /** the second face; null: the neutral of the first */
  other: ViewedFace | null = null;
  private neutral: ViewedFace | null = null;
  private bones: BonesOverlay;
  private rows: Row[] = [];
  private coloring: Coloring = "material";
  private wireframe = false;
  private showsBones = false;
  private readonly legend = new Legend();
  private readonly divider: Divider;
  private readonly payload: PayloadPanel;
  private readonly measured = throttled(200, () => this.measure());

  constructor(
    readonly picture: Picture,
    view: HTMLElement,
    private readonly panel: HTMLElement,
    public own: ViewedFace,
    private readonly blend: BlendEntry | null,
    basisUrl: string,
  ) {
    this.divider = new Divider(picture, view);
    this.payload = new PayloadPanel(() => this.own.face, basisUrl, () => this.changed());
    this.bones = new BonesOverlay(own.face);
    picture.before = () => this.bones.update();
    view.append(this.toolbar(), this.legend.element, ...this.divider.elements);
  }

  /** Fill the panel and look at the face. */
  show(): void {
    this.fill();
    this.picture.show(this.own, this.other);
    this.picture.frame();
    this.paint();
    document.title = `${this.own.entry.label} - facepipe`;
  }

  /** Put another version of the face in place of the first, posed alike. */
  async replace(face: ViewedFace): Promise<void> {
    const before = this.own;
    this.own = face;
    this.bones = new BonesOverlay(face.face);
    this.bones.group.visible = this.showsBones;
    await face.face.setSliders(before.face.sliderValues);
    await face.face.setShapes(before.face.shapeValues);
    await this.payload.again();
    this.picture.show(face, this.second);
    this.paint();
    this.changed();
    await before.face.dispose();
  }

  /** The face has moved. */
  changed(): void {
    this.picture.invalidate();
    if (this.coloring === "distance") this.measured();
  }

  private get second(): ViewedFace | null {
    return this.other ?? this.neutral;
  }

  private fill(): void {
    const { face, entry, regionNames } = this.own;
    const counts = [counted(face.meshes.length, "mesh", "meshes"), counted(face.joints?.bones.length ?? 0, "joint")];
    const about = h("header", {}, h("h1", {}, entry.label), h("p", {}, counts.join(" · ")));
    if (face.copyright) about.append(h("p", {}, face.copyright));
    about.append(...[this.own, this.other].flatMap((one) => (one ? notesOf(one) : [])));
    const parts: HTMLElement[] = [about];
    if (this.blend) parts.push(new BlendPanel(this.blend, this).element);
    if (face.sliders.length) {
      const { element, rows } = sliderPanel(face, regionNames, (values) => void this.slide(values));
      this.rows.push(...rows);
      parts.push(element);
    }
    if (face.shapes.length) {
      const { element, rows } = shapePanel(face, (values) => void this.shape(values));
      this.rows.push(...rows);
      parts.push(element);
    }
    parts.push(this.payload.element);
    this.panel.replaceChildren(...parts);
  }

  private async slide(values: Values): Promise<void> {
    const known = new Set(this.other?.face.sliders.map((one) => one.name));
    const shared = Object.entries(values).filter(([name]) => known.has(name));
    await Promise.all([this.own.face.setSliders(values), this.other?.face.setSliders(Object.fromEntries(shared))]).catch(sayError);
    this.changed();
  }

  private async shape(weights: Values): Promise<void> {
    const known = new Set(this.other?.face.shapes);
    const shared = Object.entries(weights).filter(([name]) => known.has(name));
    await Promise.all([this.own.face.setShapes(weights), this.other?.face.setShapes(Object.fromEntries(shared))]).catch(sayError);
    this.changed();
  }

  private toolbar(): HTMLElement {
    const colorings: [Coloring, string][] = [["material", "Material"], ["regions", "Regions"], ["distance", "Distance"]];
    const compares: [Compare, string][] = [["off", "One"], ["split", "Split"], ["toggle", "A/B"]];
    onKey("x", () => this.flip());
    return h(
      "div",
      { class: "toolbar", role: "toolbar", "aria-label": "View" },
      choice({ label: "Colours", values: colorings, value: "material", change: (value) => this.color(value) }),
      toggle("Wireframe", "w", (on) => {
        this.wireframe = on;
        this.paint();
      }),
      toggle("Bones", "b", (on) => {
        this.showsBones = this.bones.group.visible = on;
        this.picture.invalidate();
      }),
      choice({ label: "Compare", values: compares, value: "off", change: (value) => void this.compare(value) }),
      h("span", { class: "space" }),
      action("Front", "f", () => this.picture.frame()),
      action("Screenshot", "s", () => void this.save()),
    );
  }

  private color(coloring: Coloring): void {
    this.coloring = coloring;
    this.paint();
  }

  private paint(): void {
    const alone = this.coloring === "distance" && !this.other; // the neutral is nowhere far from itself
    this.own.look.set(this.coloring, this.wireframe);
    this.second?.look.set(alone ? "material" : this.coloring, this.wireframe);
    if (this.coloring === "material") this.legend.hide();
    if (this.coloring === "regions") this.legend.regions(this.own.regionNames);
    if (this.coloring === "distance") this.measure();
    this.picture.invalidate();
  }

  private measure(): void {
    const largest = this.own.look.largest();
    const end = roundEnd(largest.mm);
    for (const one of [this.own, this.second]) if (one) one.look.range.value = end;
    if (this.coloring === "distance") this.legend.distance(end, largest);
    this.picture.invalidate();
  }

  private async compare(compare: Compare): Promise<void> {
    if (compare !== "off" && !this.second) {
      try {
        this.neutral = await ViewedFace.load(this.own.entry);
        await this.neutral.face.reset();
      } catch (error) {
        return sayError(error);
      }
      this.picture.show(this.own, this.neutral);
    }
    this.picture.compare = compare;
    this.picture.showsOther = compare === "toggle";
    this.paint();
    this.divider.update(this.labels());
  }

  /** In A/B the other face. */
  private flip(): void {
    if (this.picture.compare !== "toggle") return say("X shows the other face where A/B is on.");
    this.picture.showsOther = !this.picture.showsOther;
    this.divider.update(this.labels());
    this.picture.invalidate();
  }

  private labels(): [string, string] {
    return this.other ? [this.own.entry.label, this.other.entry.label] : ["posed", "neutral"];
  }

  private async save(): Promise<void> {
    const url = URL.createObjectURL(await this.picture.png());
    h("a", { href: url, download: `${this.own.entry.label.replace(/\.\w+$/, "")}.png` }).click();
    URL.revokeObjectURL(url);
  }
}

/** What the export of a face could not hold. */
function notesOf({ details, entry }: ViewedFace): HTMLElement[] {
  const notes = details?.notes ?? [];
  const title = `${notes.length} export note${notes.length > 1 ? "s" : ""}: ${entry.label}`;
  return notes.length ? [h("details", { class: "notes", open: notes.length < 3 }, h("summary", {}, title), ...notes.map((note) => h("p", {}, note)))] : [];
}

function counted(count: number, one: string, many = `${one}s`): string {
  return `${count} ${count === 1 ? one : many}`;
}
