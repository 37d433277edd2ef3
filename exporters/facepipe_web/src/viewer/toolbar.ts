/** Buttons over the picture, each with a key. */
import { h, isTyping } from "./dom";

export interface Choice<Value extends string> {
  label: string;
  values: [Value, string][];
  value: Value;
  change: (value: Value) => void;
}

/** Buttons of which one is on. */
export function choice<Value extends string>({ label, values, value, change }: Choice<Value>): HTMLElement {
  const buttons = values.map(([own, text]) => {
    const button = h("button", { "aria-pressed": own === value, "data-value": own }, text);
    button.addEventListener("click", () => {
      for (const one of buttons) one.setAttribute("aria-pressed", String(one === button));
      change(own);
    });
    return button;
  });
  return h("div", { class: "choice", role: "group", "aria-label": label }, ...buttons);
}

/** A button that is on or off; `key` presses it. */
export function toggle(text: string, key: string, change: (on: boolean) => void): HTMLButtonElement {
  const button = h("button", { "aria-pressed": false, "aria-keyshortcuts": key, title: `${text} (${key.toUpperCase()})` }, text);
  button.addEventListener("click", () => {
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    change(on);
  });
  onKey(key, () => button.click());
  return button;
}

/** A button that does something; `key` presses it. */
export function action(text: string, key: string, run: () => void): HTMLButtonElement {
  onKey(key, run);
  return h("button", { "aria-keyshortcuts": key, title: `${text} (${key.toUpperCase()})`, onclick: run }, text);
}

/** Call `run` when `key` is pressed outside of fields. */
export function onKey(key: string, run: () => void): void {
  document.addEventListener("keydown", (event) => {
    const plain = !event.ctrlKey && !event.metaKey && !event.altKey;
    if (plain && event.key.toLowerCase() === key && !isTyping()) run();
  });
}
