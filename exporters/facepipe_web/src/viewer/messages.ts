/** Messages to the user on the page, one line each. */
import { h } from "./dom";

const box = h("div", { class: "messages", role: "alert", "aria-live": "assertive" });

/** Show a message; the same one is there once. */
export function say(text: string): void {
  if (!box.isConnected) document.getElementById("view")!.append(box);
  if ([...box.children].some((one) => one.firstChild?.textContent === text)) return;
  const message = h("div", { class: "message" }, text, " ");
  message.append(h("button", { class: "quiet", "aria-label": "Close this message", onclick: () => message.remove() }, "×"));
  box.append(message);
}

/** Show what an error says. */
export function sayError(error: unknown): void {
  say(error instanceof Error ? error.message : String(error));
}
