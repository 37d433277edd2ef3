/** Small helpers for hand-written DOM. */
type Properties = Record<string, unknown>;

/** An element with properties (`aria-*`, `data-*`, `for` and `class` as attributes, `on*` as listeners) and children. */
export function h<Tag extends keyof HTMLElementTagNameMap>(
  tag: Tag,
  properties: Properties = {},
  ...children: (Node | string)[]
): HTMLElementTagNameMap[Tag] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value as EventListener);
    else if (/^(aria-|data-|for$|class$|role$)/.test(name)) element.setAttribute(name, String(value));
    else (element as unknown as Properties)[name] = value;
  }
  element.append(...children);
  return element;
}

/** Whether keys typed now belong to a field. */
export function isTyping(): boolean {
  const active = document.activeElement;
  return active instanceof HTMLInputElement || active instanceof HTMLSelectElement || active instanceof HTMLTextAreaElement;
}

/** `action`, at most once in `ms`, the last call not lost. */
export function throttled(ms: number, action: () => void): () => void {
  let timer: number | undefined;
  return () => {
    timer ??= window.setTimeout(() => {
      timer = undefined;
      action();
    }, ms);
  };
}
