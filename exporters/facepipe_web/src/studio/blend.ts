/** The blend studio: sources, weights by region, locks, and the face as they make it. */
import { css, regionColor } from "../viewer/colors";
import { h, throttled } from "../viewer/dom";
import { say, sayError } from "../viewer/messages";
import { Row } from "../viewer/rows";
import { type Face, get, newest, saveAs, type Source } from "./api";
import { History } from "./history";
import { LiveEdit, type Weights } from "./live_edit";
import type { Studio } from "./main";
import { BORDER, legendOf, regionMap } from "./region_map";
import { act, downloads, fileButton, type Part, saidSaved, sendFile, thumbnail, UndoButtons, upload, work } from "./work";

interface Draft {
  sources: (Source & { name: string })[];
  weights: Weights;
  caricature: boolean;
  /** number of the source, from 1, whose motion all have; 0: blended too */
  motion: number;
}

const KEY = "facepipe.draft.blend";
const REST = "default";
const LETTERS = "ABCDEFGHIJKLMNOP";
const EMPTY: Draft = { sources: [], weights: { regions: {}, default: [], locked: {} }, caricature: false, motion: 0 };

export class Blend implements Part {
  readonly title = "Blend";
  private draft: Draft = restored();
  private history = new History<Draft>(this.draft, () => this.undo.update());
  private live: LiveEdit | null = null;
  private regions: string[] = [];
  private open = REST;
  private shown = false;
  private rows = new Map<string, Row[]>();
  private readonly undo = new UndoButtons<Draft>(() => this.history, (draft) => void this.restore(draft), () => this.shown);
  private readonly moved = throttled(15, () => this.live?.send(this.draft.weights));
  private readonly sources = h("ol", { class: "sources" });
  private readonly made = h("div", { class: "buttons" });
  private readonly folds = h("div", { class: "folds" });
  private readonly painting = h(
    "section",
    { "aria-label": "Regions", hidden: true },
    h("h2", {}, "Regions"),
    h("p", {}, "Those of A as a picture over its UV layout, to be painted elsewhere."),
    h("div", { class: "buttons" }, h("button", { onclick: () => void this.writeRegions() }, "Write map and legend"), fileButton("Read a painted map …", { accept: ".png,.json", multiple: true }, (files) => void this.readRegions(files))),
  );
  private readonly name = h("input", { type: "text", placeholder: "Name of the blend", "aria-label": "Name of the blend", maxLength: 200 });

  constructor(private readonly studio: Studio) {}

  async show(): Promise<void> {
    this.shown = true;
    this.studio.page(null);
    this.studio.bench.picked = (region) => this.choose(region);
    const add = fileButton("Add a file …", { multiple: true }, (files) => void this.drop(files));
    const pick = h("button", { onclick: () => this.studio.go("Library") }, "From the library");
    const save = h("button", { class: "main", onclick: () => void this.save() }, "Save");
    this.studio.panel.replaceChildren(
      h("header", {}, h("h1", {}, "Blend"), h("div", { class: "buttons" }, ...this.undo.elements, h("button", { class: "quiet", onclick: () => void this.restore(structuredClone(EMPTY)) }, "Start over"))),
      h("section", { "aria-label": "Sources" }, h("h2", {}, "Sources"), this.sources, h("div", { class: "buttons" }, pick, add)),
      h("section", { "aria-label": "Weights" }, h("h2", {}, "Weights"), this.folds),
      this.painting,
      h("section", { "aria-label": "Save" }, this.name, h("div", { class: "buttons" }, save), this.made),
    );
    this.studio.bench.dropped = (files) => void this.drop(files);
    await this.reopen();
  }

  hide(): void {
    this.shown = false;
    this.live?.close();
    this.live = null;
    this.studio.bench.picked = this.studio.bench.dropped = () => {};
  }

  /** Another source, after the others. */
  add(face: Face): void {
    if (this.draft.sources.some((one) => one.face === face.id)) return say(`${face.name} is a source already.`);
    if (this.draft.sources.length >= LETTERS.length) return say(`A blend has ${LETTERS.length} sources at most.`);
    const { weights } = this.draft;
    this.draft.sources.push({ ...newest(face), name: face.name });
    const count = this.draft.sources.length;
    weights.default = count === 2 ? [0.5, 0.5] : [...weights.default, count > 1 ? 0 : 1];
    for (const region of Object.keys(weights.regions)) weights.regions[region] = count === 2 ? [0.5, 0.5] : [...weights.regions[region], 0];
    this.keep();
  }

  private async drop(files: File[]): Promise<void> {
    const job = await upload(files);
    if (!job?.face) return;
    this.add(await get<Face>(`faces/${job.face}`));
    await this.reopen();
  }

  private async remove(number: number): Promise<void> {
    const { weights, sources } = this.draft;
    sources.splice(number, 1);
    const without = (row: number[]) => {
      const left = row.filter((_, i) => i !== number);
      return left.some((one) => one > 0) ? left : left.map(() => 1 / left.length);
    };
    weights.default = without(weights.default);
    for (const region of Object.keys(weights.regions)) weights.regions[region] = without(weights.regions[region]);
    const locks = Object.entries(weights.locked).filter(([, one]) => one !== number + 1);
    weights.locked = Object.fromEntries(locks.map(([region, one]) => [region, one > number + 1 ? one - 1 : one]));
    this.draft.motion = 0;
    this.keep();
    await this.reopen();
  }

  /** Put a state back: with other sources the session is another. */
  private async restore(draft: Draft): Promise<void> {
    const same = JSON.stringify(draft.sources) === JSON.stringify(this.draft.sources);
    this.draft = draft;
    if (!draft.sources.length) this.history.keep(draft);
    localStorage.setItem(KEY, JSON.stringify(draft));
    if (!same) return this.reopen();
    this.fill();
    this.moved();
  }

  private keep(): void {
    this.history.keep(this.draft);
    localStorage.setItem(KEY, JSON.stringify(this.draft)); // a draft outlives the page
  }

  /** The session of the sources, and the picture of the first. */
  private async reopen(): Promise<void> {
    this.live?.close();
    this.live = null;
    this.regions = [];
    this.fill();
    const { sources } = this.draft;
    const { bench } = this.studio;
    if (!sources.length) {
      await bench.clear();
      bench.say("Drop two faces here, or add them from the library.");
      return;
    }
    try {
      const face = await bench.open(sources[0], sources[0].name);
      if (!face || !this.shown) return;
      if (sources.length < 2) return bench.say("Add another face to blend it with.");
      bench.say("Getting the blend ready …");
      this.live = new LiveEdit(sources.map(({ face: id, version }) => ({ face: id, version })), {
        opened: ({ regions }) => {
          this.regions = regions;
          const { weights } = this.draft;
          for (const one of [weights.regions, weights.locked]) for (const region of Object.keys(one)) if (!regions.includes(region)) delete one[region];
          this.fill();
          this.moved();
        },
        moved: (offsets, settled) => {
          if (bench.face !== face) return;
          face.setOffsets(offsets);
          bench.say(null);
          bench.changed();
          document.body.dataset.live = settled ? "settled" : "moving";
        },
        failed: (why) => {
          bench.say(null);
          say(why);
        },
      });
    } catch (error) {
      sayError(error);
    }
  }

  /** Open a region's weights, and nothing else. */
  private choose(region: string): void {
    this.open = region;
    for (const fold of this.folds.querySelectorAll<HTMLDetailsElement>("details")) fold.open = fold.dataset.region === region;
    this.folds.querySelector(`details[data-region="${CSS.escape(region)}"]`)?.scrollIntoView({ block: "nearest" });
  }

  private fill(): void {
    const { sources } = this.draft;
    this.sources.replaceChildren(
      ...sources.map((one, i) => {
        const remove = h("button", { class: "quiet", "aria-label": `Remove ${one.name}`, onclick: () => void this.remove(i) }, "×");
        const note = i ? "" : h("small", {}, "gives mesh and materials");
        return h("li", {}, thumbnail(one, ""), h("span", { class: "name" }, `${LETTERS[i]} · ${one.name}`, note), remove);
      }),
    );
    this.painting.hidden = !sources.length;
    this.rows.clear();
    this.folds.replaceChildren();
    if (sources.length < 2) return void this.folds.append(h("p", {}, "Two faces at least."));
    this.folds.append(h("p", {}, "Click a place on the face to choose its region."));
    this.folds.append(...[REST, ...this.regions].map((region) => this.fold(region)), this.more());
  }

  private fold(region: string): HTMLElement {
    const { weights } = this.draft;
    const title = region === REST ? "All others" : region;
    const number = this.regions.indexOf(region);
    const swatch = h("span", { class: "swatch", style: number < 0 ? "display: none" : `background: ${css(regionColor(number))}` });
    const mark = h("span", { class: "count" }, region in weights.locked ? "locked" : region in weights.regions ? "own" : "");
    const fold = h("details", { open: region === this.open, "data-region": region }, h("summary", {}, swatch, title, mark));
    fold.addEventListener("toggle", () => fold.open && (this.open = region));
    const locked = weights.locked[region];
    if (!locked) {
      const rows = this.weightRows(region);
      this.rows.set(region, rows);
      fold.append(h("div", { class: "rows" }, ...rows.map((row) => row.element)));
    }
    if (region !== REST) fold.append(this.locks(region));
    return fold;
  }

  /** A slider for each source; of two one alone, from the first to the second. */
  private weightRows(region: string): Row[] {
    const { sources, weights, caricature } = this.draft;
    const [minimum, maximum] = caricature ? [-1, 2] : [0, 1];
    const row = () => (region === REST ? weights.default : (weights.regions[region] ?? weights.default));
    const set = (next: number[]) => {
      if (!next.some((one) => one > 0) || next.reduce((sum, one) => sum + one, 0) <= 0) return;
      if (region === REST) weights.default = next;
      else weights.regions[region] = next;
      if (region === REST) this.follow();
      this.moved();
    };
    const settle = () => {
      this.keep();
      const mark = this.folds.querySelector(`details[data-region="${CSS.escape(region)}"] .count`);
      if (mark && region in weights.regions) mark.textContent = "own";
    };
    if (sources.length === 2) {
      const name = `A → B`;
      const change = (value: number) => set([1 - value, value]);
      return [new Row({ name, minimum, maximum, rest: 0.5, value: share(row(), 1), change, settle })];
    }
    return sources.map(({ name }, i) => {
      const change = (value: number) => set(row().map((one, at) => (at === i ? value : one)));
      return new Row({ name: `${LETTERS[i]} · ${name}`, minimum, maximum, rest: 0, value: row()[i], change, settle });
    });
  }

  /** Regions without weights of their own have those of all others. */
  private follow(): void {
    const { weights, sources } = this.draft;
    for (const [region, rows] of this.rows) {
      if (region === REST || region in weights.regions) continue;
      rows.forEach((row, i) => row.show(sources.length === 2 ? share(weights.default, 1) : weights.default[i]));
    }
  }

  private locks(region: string): HTMLElement {
    const { weights, sources } = this.draft;
    const taken = h("select", { "aria-label": `Lock ${region}` }, h("option", { value: "0" }, "blended"), ...sources.map((one, i) => h("option", { value: String(i + 1) }, `locked to ${LETTERS[i]} · ${one.name}`)));
    taken.value = String(weights.locked[region] ?? 0);
    taken.addEventListener("change", () => {
      delete weights.locked[region];
      if (+taken.value) {
        weights.locked[region] = +taken.value;
        delete weights.regions[region]; // the command takes one of the two
      }
      this.settled();
    });
    const reset = h("button", { class: "quiet", "aria-label": `Weights of ${region} as all others`, onclick: () => {
      delete weights.regions[region];
      this.settled();
    } }, "as others");
    return h("div", { class: "lock" }, taken, reset);
  }

  private more(): HTMLElement {
    const { sources } = this.draft;
    const caricature = h("input", { type: "checkbox", checked: this.draft.caricature });
    caricature.addEventListener("change", () => {
      this.draft.caricature = caricature.checked;
      this.settled();
    });
    const motion = h("select", { "aria-label": "Motion" }, h("option", { value: "0" }, "blended too"), ...sources.map((one, i) => h("option", { value: String(i + 1) }, `of ${LETTERS[i]} · ${one.name}`)));
    motion.value = String(this.draft.motion);
    motion.addEventListener("change", () => {
      this.draft.motion = +motion.value;
      this.keep();
    });
    return h("div", { class: "more" }, h("label", {}, caricature, " Caricature: weights from −1 to 2"), h("label", {}, "Expressions ", motion));
  }

  private async writeRegions(): Promise<void> {
    const { face } = this.studio.bench;
    const [{ name }] = this.draft.sources;
    if (!face) return;
    try {
      saveAs(await regionMap(face), `${name}.regions.png`);
      saveAs(legendOf(face.regionNames), `${name}.regions.json`);
    } catch (error) {
      sayError(error);
    }
  }

  /** A painted map becomes the next version of the first source; without a legend its colours are as they were written. */
  private async readRegions(files: File[]): Promise<void> {
    const [first] = this.draft.sources;
    const map = files.find((one) => one.name.toLowerCase().endsWith(".png"));
    const legend = files.find((one) => one.name.toLowerCase().endsWith(".json"));
    if (!map) return say("No map is among these files, expected a PNG, and its legend as JSON.");
    try {
      const { width } = await createImageBitmap(map);
      const ids = Promise.all([sendFile(map, ".png"), sendFile(legend ?? legendOf(this.studio.bench.face!.regionNames), ".json")]);
      const source = { face: first.face, version: first.version };
      const footprint = Math.max(1, Math.round(BORDER * width));
      const asked = ids.then(([png, json]) => act("regions", { face: source, map: png, legend: json, footprint }, { face: first.face, from: first.version }));
      const job = await work("Reading the regions", asked);
      if (!job?.version) return;
      await saidSaved(job, source);
      first.version = job.version;
      this.keep();
      await this.reopen();
      document.body.dataset.regions = `${job.face}/${job.version}`;
    } catch (error) {
      sayError(error);
    }
  }

  private settled(): void {
    this.keep();
    this.fill();
    this.moved();
  }

  private async save(): Promise<void> {
    const { sources, weights, motion } = this.draft;
    if (sources.length < 2) return say("A blend has two sources at least.");
    const own = sources.map(({ face, version }) => ({ face, version }));
    const name = this.name.value.trim() || sources.map((one) => one.name).join(" + ").slice(0, 200);
    const fields = { sources: own, weights: { ...weights, gains: null }, ...(motion ? { motion_of: motion } : {}) };
    const job = await work(`Blending ${name}`, act("blend", fields, { name }));
    if (job) {
      const face = await saidSaved(job, null).catch(sayError);
      if (face) this.made.replaceChildren(h("button", { onclick: () => void this.studio.editSliders(face) }, "Edit sliders"), ...downloads(newest(face), face.name));
      document.body.dataset.saved = `${job.face}/${job.version}`;
    }
  }
}

function share(row: number[], at: number): number {
  const total = row.reduce((sum, one) => sum + one, 0);
  return row[at] / total;
}

function restored(): Draft {
  try {
    const kept = JSON.parse(localStorage.getItem(KEY) ?? "") as Draft;
    if (Array.isArray(kept.sources) && kept.weights.default.length === kept.sources.length) return kept;
  } catch {
    // none, or one of another version
  }
  return structuredClone(EMPTY);
}
