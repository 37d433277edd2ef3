/** Sliders of a face: found by words, by group, mirrored, drawn by lot, undone, saved as a version. */
import type { SliderInfo } from "../runtime";
import { h } from "../viewer/dom";
import { say, sayError } from "../viewer/messages";
import { Row } from "../viewer/rows";
import type { ViewedFace } from "../viewer/viewed_face";
import { ClipPlayer } from "./clips";
import { download, type Face, fileOf, get, newest, type Source } from "./api";
import { History } from "./history";
import type { Studio } from "./main";
import { act, fileButton, type Part, saidSaved, sendFile, UndoButtons, work } from "./work";

type Values = Record<string, number>;

const CLIPS = ".csv,.tsv,.txt,.json,.jsonl,.usd,.usda,.usdc,.usdz,.glb,.gltf,.vrm,.fbx";
const SPREAD = 0.35; // of the way to an end of its range, that a slider drawn by lot is off its default: still a person

export class Sliders implements Part {
  readonly title = "Sliders";
  private face: Face | null = null;
  private source: Source | null = null;
  private viewed: ViewedFace | null = null;
  player: ClipPlayer | null = null;
  private values: Values = {};
  private saved: Values = {};
  private mirrored = true;
  private shown = false;
  private rows = new Map<string, Row>();
  private history = new History<Values>({}, () => this.undo.update());
  private readonly undo: UndoButtons<Values> = new UndoButtons<Values>(
    () => this.history,
    (values) => this.set(values),
    () => this.shown,
  );

  constructor(private readonly studio: Studio) {}

  /** Edit a face from its newest version on. */
  edit(face: Face): void {
    this.face = face;
    this.source = newest(face);
    this.viewed = null;
  }

  async show(): Promise<void> {
    this.shown = true;
    this.studio.page(null);
    const { bench, panel } = this.studio;
    if (!this.face) {
      const library = h("button", { onclick: () => this.studio.go("Library") }, "Choose a face");
      panel.replaceChildren(h("header", {}, h("h1", {}, "Sliders"), h("p", {}, "No face is chosen.")), h("section", {}, library));
      await bench.clear();
      return;
    }
    const { face } = this;
    panel.replaceChildren(h("header", {}, h("h1", {}, face.name), h("p", {}, "Loading …")));
    this.player?.pause();
    bench.dropped = (files) => void this.play(files[0]);
    try {
      const viewed = await bench.open(this.source!, face.name);
      if (!viewed || !this.shown) return;
      this.viewed = viewed;
      this.player = new ClipPlayer(viewed.face, () => bench.changed());
      this.saved = { ...viewed.face.sliderValues };
      this.values = { ...this.saved };
      this.history = new History<Values>(this.values, () => this.undo.update());
      this.undo.update();
      this.fill();
    } catch (error) {
      sayError(error);
    }
  }

  hide(): void {
    this.shown = false;
    this.player?.pause();
    this.studio.bench.picked = this.studio.bench.dropped = () => {};
  }

  private fill(): void {
    const { face, viewed } = this;
    const sliders = viewed!.face.sliders;
    this.rows = new Map(sliders.map((one) => [one.name, this.row(one)]));
    const groups = [...new Set(sliders.map((one) => one.group))].sort((a, b) => a.localeCompare(b));
    const folds = groups.map((group, i) => this.fold(group, sliders.filter((one) => one.group === group), i === 0));
    const none = h("p", { hidden: true }, "No slider is called so.");
    const search = h("input", { type: "search", placeholder: "Search sliders", "aria-label": "Search sliders" });
    search.addEventListener("input", () => {
      const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
      let found = 0;
      for (const fold of folds) {
        const members = [...fold.querySelectorAll<HTMLElement>(".row")];
        for (const row of members) row.hidden = !words.every((word) => `${fold.dataset.group} ${row.dataset.name}`.toLowerCase().includes(word));
        const some = members.filter((row) => !row.hidden).length;
        fold.hidden = !some;
        if (words.length) fold.open = some > 0;
        found += some;
      }
      none.hidden = found > 0;
    });
    const mirror = h("input", { type: "checkbox", checked: this.mirrored });
    mirror.addEventListener("change", () => (this.mirrored = mirror.checked));
    const reset = h("button", { class: "quiet", onclick: () => this.settle(Object.fromEntries(sliders.map((one) => [one.name, one.default]))) }, "Reset all");
    this.studio.panel.replaceChildren(
      h("header", {}, h("h1", {}, face!.name), h("p", {}, `version ${this.source!.version}`), h("div", { class: "buttons" }, ...this.undo.elements, reset)),
      h("section", { "aria-label": "Sliders" }, search, h("label", { class: "check" }, mirror, " Both sides together"), ...folds, none, ...(sliders.length ? [] : [h("p", {}, "This face has no sliders.")])),
      h("section", { "aria-label": "Clips" }, h("h2", {}, "Clips"), this.player!.element, h("p", {}, "Drop a recording on the face, or"), h("div", { class: "buttons" }, fileButton("Choose a clip …", { accept: CLIPS }, ([file]) => void this.play(file)))),
      this.saving(),
    );
    this.studio.bench.picked = (region) => {
      const fold = folds.find((one) => one.dataset.group === region || one.dataset.group?.startsWith(region.replace(/s$/, "")));
      if (!fold) return;
      for (const one of folds) one.open = one === fold;
      fold.scrollIntoView({ block: "nearest" });
    };
  }

  private row({ name, minimum, maximum, default: rest }: SliderInfo): Row {
    const change = (value: number) => {
      this.values[name] = value;
      const twin = this.mirrored && this.viewed!.face.sliders.find((one) => one.name === name)!.mirror;
      if (twin && this.rows.has(twin)) {
        this.values[twin] = value;
        this.rows.get(twin)!.show(value);
      }
      void this.pose(twin ? { [name]: value, [twin]: value } : { [name]: value });
    };
    return new Row({ name, minimum, maximum, rest, value: this.values[name], change, settle: () => this.history.keep(this.values) });
  }

  private fold(group: string, members: SliderInfo[], open: boolean): HTMLDetailsElement {
    const lot = h("button", { class: "quiet", "aria-label": `Randomise ${group || "other"}`, onclick: () => this.settle(this.drawn(members)) }, "randomise");
    const rest = h("button", { class: "quiet", "aria-label": `Reset ${group || "other"}`, onclick: () => this.settle(Object.fromEntries(members.map((one) => [one.name, one.default]))) }, "reset");
    const summary = h("summary", {}, group || "other", h("span", { class: "count" }, String(members.length)));
    const rows = members.map((one) => this.rows.get(one.name)!.element);
    return h("details", { open, "data-group": group }, summary, h("div", { class: "buttons" }, lot, rest), h("div", { class: "rows" }, ...rows));
  }

  /** Values by lot; both sides of a pair the same where they go together. */
  private drawn(members: SliderInfo[]): Values {
    const found: Values = {};
    for (const { name, minimum, maximum, default: rest, mirror } of members) {
      const by = SPREAD * (2 * Math.random() - 1);
      const twin = this.mirrored && mirror !== null ? found[mirror] : undefined;
      found[name] = twin ?? rest + by * (by > 0 ? maximum - rest : rest - minimum);
    }
    return found;
  }

  private settle(changed: Values): void {
    this.set({ ...this.values, ...changed });
    this.history.keep(this.values);
  }

  private set(values: Values): void {
    this.values = { ...values };
    for (const [name, row] of this.rows) row.show(values[name]);
    void this.pose(values);
  }

  private async pose(values: Values): Promise<void> {
    await this.viewed!.face.setSliders(values).catch(sayError);
    this.studio.bench.changed();
  }

  /** Values that are other than in the version. */
  private get changed(): Values {
    return Object.fromEntries(Object.entries(this.values).filter(([name, value]) => Math.abs(value - this.saved[name]) > 1e-9));
  }

  private saving(): HTMLElement {
    const name = h("input", { type: "text", placeholder: "Name, for a face of its own", "aria-label": "Name of a new face", maxLength: 200 });
    const version = h("button", { class: "main", onclick: () => void this.save(null) }, "Save as a version");
    const face = h("button", { onclick: () => void this.save(name.value.trim() || `${this.face!.name} 2`) }, "Save as a new face");
    const payload = h("button", { onclick: () => void this.payload() }, "Payload of these values");
    return h("section", { "aria-label": "Save" }, h("div", { class: "buttons" }, version, payload), name, h("div", { class: "buttons" }, face));
  }

  private async save(name: string | null): Promise<void> {
    const { changed } = this;
    if (!Object.keys(changed).length) return say("Nothing has moved since it was saved.");
    const { source } = this;
    const into = name ? { name } : { face: source!.face, from: source!.version };
    const job = await work("Saving", act("sliders", { face: source, values: changed }, into));
    if (!job) return;
    try {
      const face = await saidSaved(job, source);
      document.body.dataset.saved = `${job.face}/${job.version}`;
      if (!face || !job.version) return;
      this.face = face;
      this.source = { face: face.id, version: job.version };
      await this.show();
    } catch (error) {
      sayError(error);
    }
  }

  /** Put a clip on the face, as its next version, and play it; sliders that were moved stay so. */
  private async play(file: File): Promise<void> {
    const { source, changed } = this;
    if (!source || !this.viewed) return;
    const [, stem, ending] = /^(.*?)(\.\w+)$/.exec(file.name) ?? [null, file.name, ".csv"];
    const name = stem.replace(/\W/g, "_").replace(/^(?=\d)|^$/, "clip");
    const asked = sendFile(file, ending).then((clip) => act("animate", { face: source, clip, name }, { face: source.face, from: source.version }));
    const job = await work(`Putting ${file.name} on`, asked);
    if (!job?.version) return;
    try {
      this.face = (await saidSaved(job, source))!;
      this.source = { face: this.face.id, version: job.version };
      await this.show();
      if (Object.keys(changed).length) this.settle(changed);
      const missed = Object.keys(job.report?.report?.no_target ?? {});
      if (missed.length) say(`This face has nothing for ${missed.slice(0, 5).join(", ")}${missed.length > 5 ? " …" : ""}.`);
      this.player!.choose(name);
      this.player!.toggle();
      document.body.dataset.clip = name;
    } catch (error) {
      sayError(error);
    }
  }

  private async payload(): Promise<void> {
    const init = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ values: this.changed }) };
    await download(fileOf(this.source!, "sliders"), `${this.face!.name}.fpb`, init).catch(sayError);
  }

  /** Open a face by its id. */
  async openId(id: string): Promise<void> {
    this.edit(await get<Face>(`faces/${id}`));
  }
}
