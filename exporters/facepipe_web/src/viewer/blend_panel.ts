/** Weights of a blended face, blended again while they are moved. */
import { css, regionColor } from "./colors";
import { h, throttled } from "./dom";
import { say, sayError } from "./messages";
import type { Page } from "./page";
import { section } from "./panels";
import { Row } from "./rows";
import { type FaceEntry, ViewedFace } from "./viewed_face";

/** The blend in viewer.json. */
export interface BlendEntry {
  sources: string[];
  regions: string[];
  /** region -> a weight for each source; "default" holds for all regions that are not here */
  weights: Record<string, number[]>;
  locked: Record<string, number>;
  /** what makes the result on the command line, without weights */
  command: string;
}

const URL = "blend";

export class BlendPanel {
  readonly element: HTMLElement;
  private readonly weights: Record<string, number[]>;
  private readonly command = h("textarea", { readOnly: true, rows: 3, spellcheck: false, "aria-label": "Command that keeps these weights" });
  private readonly preview = throttled(30, () => void this.move());
  private readonly rows = new Map<string, Row[]>();
  private busy = false;
  private again = false;
  private settled = 0;

  constructor(
    private readonly entry: BlendEntry,
    private readonly page: Page,
  ) {
    this.weights = structuredClone(entry.weights);
    const folds = ["default", ...entry.regions].map((region, number) => this.fold(region, number === 0));
    this.element = section("Blend", null, ...folds, this.command);
    this.showCommand();
  }

  private fold(region: string, open: boolean): HTMLElement {
    const title = region === "default" ? "all others" : region;
    const lock = this.entry.locked[region];
    if (lock) return h("p", {}, `${title}: locked to ${this.entry.sources[lock - 1]}`);
    const rows = this.entry.sources.map((name, source) => {
      const change = (value: number) => {
        this.weights[region] ??= [...this.weights.default];
        this.weights[region][source] = value;
        if (region === "default") this.follow();
        this.preview();
      };
      const value = (this.weights[region] ?? this.weights.default)[source];
      return new Row({ name, minimum: 0, maximum: 1, rest: value, value, change, settle: () => void this.settle() });
    });
    this.rows.set(region, rows);
    const number = this.entry.regions.indexOf(region);
    const swatch = number < 0 ? "" : h("span", { class: "swatch", style: `background: ${css(regionColor(number))}` });
    return h("details", { open }, h("summary", {}, swatch, title), h("div", { class: "rows" }, ...rows.map((row) => row.element)));
  }

  /** Regions without weights of their own have those of all others. */
  private follow(): void {
    for (const [region, rows] of this.rows) {
      if (!(region in this.weights)) rows.forEach((row, source) => row.show(this.weights.default[source]));
    }
  }

  /** New neutral points, as fast as the server gives them. */
  private async move(): Promise<void> {
    this.showCommand();
    if (this.busy) {
      this.again = true;
      return;
    }
    this.busy = true;
    try {
      const answer = await this.ask("points");
      if (answer) {
        this.page.own.setPoints(new Float32Array(await answer.arrayBuffer()));
        this.page.changed();
      }
    } finally {
      this.busy = false;
    }
    if (this.again) {
      this.again = false;
      await this.move();
    }
  }

  /** The whole face with its shapes, joints and sliders. */
  private async settle(): Promise<void> {
    const number = ++this.settled;
    const answer = await this.ask("face");
    if (!answer || number !== this.settled) return;
    try {
      const face = await ViewedFace.load((await answer.json()) as FaceEntry);
      if (number === this.settled) await this.page.replace(face);
    } catch (error) {
      sayError(error);
    }
  }

  private async ask(wanted: "points" | "face"): Promise<Response | null> {
    const body = JSON.stringify({ weights: this.weights, wanted });
    try {
      const answer = await fetch(URL, { method: "POST", headers: { "Content-Type": "application/json" }, body });
      if (answer.ok) return answer;
      say(await answer.text());
    } catch {
      say("facepipe view has ended: start it again to blend.");
    }
    return null;
  }

  private showCommand(): void {
    const words = Object.entries(this.weights)
      .filter(([region]) => !this.entry.locked[region])
      .map(([region, row]) => {
        const numbers = row.map((value) => +value.toFixed(3)).join(",");
        return region === "default" ? `--default ${numbers}` : `--set ${region}=${numbers}`;
      });
    this.command.value = `${this.entry.command} ${words.join(" ")}`;
  }
}
