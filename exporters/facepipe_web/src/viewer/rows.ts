/** A named value with a range and a number field that follow each other. */
import { h } from "./dom";

export interface RowOptions {
  name: string;
  minimum: number;
  maximum: number;
  /** value that counts as not moved */
  rest: number;
  value: number;
  change: (value: number) => void;
  /** the user has let go of it */
  settle?: () => void;
}

let rowCount = 0;

export class Row {
  readonly element: HTMLElement;
  private readonly range: HTMLInputElement;
  private readonly number: HTMLInputElement;

  constructor(private readonly options: RowOptions) {
    const { name, minimum: min, maximum: max } = options;
    const id = `row${rowCount++}`;
    const step = "any";
    this.range = h("input", { type: "range", id, min, max, step, oninput: () => this.take(this.range.valueAsNumber) });
    this.number = h("input", { type: "number", min, max, step, "aria-label": `${name}, number` });
    this.number.addEventListener("change", () => this.take(this.number.valueAsNumber));
    for (const input of [this.range, this.number]) input.addEventListener("change", () => options.settle?.());
    this.range.addEventListener("keydown", (event) => this.key(event));
    const label = h("label", { for: id, title: `${name}: double-click for ${options.rest}` }, name);
    label.addEventListener("dblclick", () => {
      this.take(options.rest);
      options.settle?.();
    });
    this.element = h("div", { class: "row", "data-name": name }, label, this.range, this.number);
    this.show(options.value);
  }

  get name(): string {
    return this.options.name;
  }

  /** Show a value, without a call of `change`. */
  show(value: number): void {
    this.range.value = String(value);
    this.number.value = String(Math.round(value * 1000) / 1000);
    this.element.classList.toggle("moved", Math.abs(value - this.options.rest) > 1e-6);
  }

  private take(value: number): void {
    const { minimum, maximum, rest, change } = this.options;
    const taken = Math.min(Math.max(Number.isFinite(value) ? value : rest, minimum), maximum);
    this.show(taken);
    change(taken);
  }

  /** A range without steps has none for the keyboard either: a fiftieth of the way. */
  private key(event: KeyboardEvent): void {
    const way = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
    if (way === undefined) return;
    event.preventDefault();
    const { minimum, maximum, settle } = this.options;
    this.take(this.range.valueAsNumber + (way * (maximum - minimum)) / 50);
    settle?.();
  }
}
