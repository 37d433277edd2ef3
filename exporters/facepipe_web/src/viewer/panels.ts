/** The panel at the side: sliders by group, shapes with a search. */
import type { Face } from "../runtime";
import { css, regionColor } from "./colors";
import { h } from "./dom";
import { Row } from "./rows";

type Change = (values: Record<string, number>) => void;

function section(title: string, button: HTMLElement | null, ...children: Node[]): HTMLElement {
  const head = h("div", { class: "head" }, h("h2", {}, title), ...(button ? [button] : []));
  return h("section", { "aria-label": title }, head, ...children);
}

function resetButton(title: string, action: () => void): HTMLButtonElement {
  return h("button", { class: "quiet", "aria-label": `Reset ${title}`, onclick: action }, "reset");
}

/** Sliders, a fold for every group; a group that is a region has its colour. */
export function sliderPanel(face: Face, regions: string[], change: Change): { element: HTMLElement; rows: Row[] } {
  const rows = face.sliders.map((one) => {
    const { name, minimum, maximum, value } = one;
    return new Row({ name, minimum, maximum, rest: one.default, value, change: (taken) => change({ [name]: taken }) });
  });
  const groups = [...new Set(face.sliders.map((one) => one.group))].sort((a, b) => a.localeCompare(b));
  const folds = groups.map((group, number) => {
    const members = face.sliders.filter((one) => one.group === group);
    const region = regions.indexOf(group);
    const swatch = h("span", { class: "swatch", style: region < 0 ? "display: none" : `background: ${css(regionColor(region))}` });
    const own = members.map((one) => rows[face.sliders.indexOf(one)].element);
    const summary = h("summary", {}, swatch, group || "other", h("span", { class: "count" }, String(members.length)));
    return h("details", { open: number === 0 || groups.length < 3 }, summary, h("div", { class: "rows" }, ...own));
  });
  const reset = resetButton("sliders", () => {
    face.sliders.forEach((one, i) => rows[i].show(one.default));
    change(Object.fromEntries(face.sliders.map((one) => [one.name, one.default])));
  });
  return { element: section(`Sliders · ${rows.length}`, reset, ...folds), rows };
}

/** Shapes in the order of the face, those that hold the searched words. */
export function shapePanel(face: Face, change: Change): { element: HTMLElement; rows: Row[] } {
  const rows = face.shapes.map(
    (name) => new Row({ name, minimum: 0, maximum: 1, rest: 0, value: 0, change: (taken) => change({ [name]: taken }) }),
  );
  const none = h("p", { hidden: true }, "No shape is called so.");
  const search = h("input", { type: "search", placeholder: "Search shapes", "aria-label": "Search shapes" });
  search.addEventListener("input", () => {
    const words = search.value.toLowerCase().split(/\s+/);
    const found = rows.filter((row) => {
      const fits = words.every((word) => row.name.toLowerCase().includes(word));
      row.element.hidden = !fits;
      return fits;
    });
    none.hidden = found.length > 0;
  });
  const reset = resetButton("shapes", () => {
    rows.forEach((row) => row.show(0));
    change(Object.fromEntries(face.shapes.map((name) => [name, 0])));
  });
  const list = h("div", { class: "list" }, ...rows.map((row) => row.element), none);
  return { element: section(`Shapes · ${rows.length}`, reset, search, list), rows };
}

export { section };
