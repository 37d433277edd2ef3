/** What colours mean. */
import { css, NO_REGION, regionColor, VIRIDIS } from "./colors";
import { h } from "./dom";

export class Legend {
  readonly element = h("div", { class: "legend", hidden: true });

  hide(): void {
    this.element.hidden = true;
  }

  regions(names: string[]): void {
    const entries = names.length ? names.map((name, i): [string, number[]] => [name, regionColor(i)]) : [["no regions", NO_REGION] as [string, number[]]];
    const items = entries.map(([name, color]) => h("li", {}, h("span", { class: "swatch", style: `background: ${css(color)}` }), name));
    this.element.replaceChildren(h("ul", {}, ...items));
    this.element.hidden = false;
  }

  /** @param end millimetres at the end of the scale */
  distance(end: number, largest: { mm: number; mesh: string }): void {
    const bar = h("div", { class: "bar", style: `background: linear-gradient(to right, ${VIRIDIS.map(css).join(", ")})` });
    const ticks = [0, 0.25, 0.5, 0.75, 1].map((share) => h("span", {}, String(+(share * end).toPrecision(3))));
    const where = largest.mm > 0.005 ? `largest ${largest.mm.toFixed(2)} mm (${largest.mesh})` : "nothing has moved";
    this.element.replaceChildren(
      h("div", {}, "distance from the neutral, mm"),
      bar,
      h("div", { class: "ticks" }, ...ticks),
      h("p", {}, where),
    );
    this.element.hidden = false;
  }
}

/** A round end of a scale that holds `mm`: 1, 2 or 5 times a power of ten, at least 1. */
export function roundEnd(mm: number): number {
  const power = 10 ** Math.floor(Math.log10(Math.max(mm, 1)));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= mm * 0.999)!;
}
