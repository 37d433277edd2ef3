/** What parts of the studio share: the buttons of edits, jobs with their progress, faces chosen and dropped. */
import { h, isTyping } from "../viewer/dom";
import { say, sayError } from "../viewer/messages";
import { ask, download, type Face, fileOf, follow, get, type Job, send, type Source } from "./api";
import type { History } from "./history";

/** A part of the studio; at most one is shown. */
export interface Part {
  readonly title: string;
  /** fill the panel and the picture */
  show(): Promise<void>;
  hide(): void;
}

/** Undo and redo, with the keys that they have everywhere. */
export class UndoButtons<State> {
  readonly elements: HTMLButtonElement[];

  constructor(
    private readonly history: () => History<State>,
    private readonly taken: (state: State) => void,
    private readonly shown: () => boolean,
  ) {
    this.elements = [
      h("button", { "aria-keyshortcuts": "Control+Z", title: "Undo (Ctrl+Z)", onclick: () => this.step("undo") }, "Undo"),
      h("button", { "aria-keyshortcuts": "Control+Y", title: "Redo (Ctrl+Y)", onclick: () => this.step("redo") }, "Redo"),
    ];
    document.addEventListener("keydown", (event) => {
      if (!(event.ctrlKey || event.metaKey) || !this.shown() || (isTyping() && !isRange())) return;
      const way = { z: event.shiftKey ? "redo" : "undo", y: "redo" }[event.key.toLowerCase()];
      if (!way) return;
      event.preventDefault();
      this.step(way as "undo" | "redo");
    });
    this.update();
  }

  update(): void {
    const history = this.history();
    this.elements[0].disabled = !history.canUndo;
    this.elements[1].disabled = !history.canRedo;
  }

  private step(way: "undo" | "redo"): void {
    const state = this.history()[way]();
    if (state) this.taken(state);
    this.update();
  }
}

function isRange(): boolean {
  return document.activeElement instanceof HTMLInputElement && document.activeElement.type === "range";
}

const line = h("p", { class: "job-text" });
const bar = h("progress", { max: 1, "aria-label": "Progress" });
const stop = h("button", { class: "quiet" }, "Cancel");
const box = h("div", { class: "job", role: "status", hidden: true }, line, bar, stop);

/**
 * Ask for a job and follow it to its end, with its progress on the page; null where it failed, which is said.
 * @param title what is being done, for people
 * @param seen called with pictures of how it stands
 */
export async function work(title: string, asked: Promise<Job>, seen: (url: string) => void = () => {}): Promise<Job | null> {
  if (!box.isConnected) document.body.append(box);
  line.textContent = title;
  bar.removeAttribute("value");
  box.hidden = false;
  try {
    const job = await asked;
    stop.onclick = () => void ask(`jobs/${job.id}`, { method: "DELETE" }).catch(sayError);
    return await follow(job, ({ progress, state }) => {
      line.textContent = state === "queued" ? `${title}: waits for its turn` : progress ? `${title}: ${progress.text}` : title;
      if (progress?.share != null) bar.value = progress.share;
      if (progress?.picture) seen(`data:image/jpeg;base64,${progress.picture}`);
    });
  } catch (error) {
    sayError(error);
    return null;
  } finally {
    box.hidden = true;
  }
}

/** Send a file that fields of a job name; its id. */
export async function sendFile(content: Blob, suffix: string): Promise<string> {
  const headers = { "Content-Type": "application/octet-stream" };
  const answer = await ask(`files?${new URLSearchParams({ suffix })}`, { method: "POST", headers, body: content });
  return ((await answer.json()) as { artefact: string }).artefact;
}

/** Take files of one face in. */
export async function upload(files: File[]): Promise<Job | null> {
  const form = new FormData();
  const paths = files.map((file) => file.webkitRelativePath || file.name);
  const top = `${paths[0].split("/")[0]}/`;
  const inside = paths.every((path) => path.startsWith(top)); // of a folder its inside counts
  files.forEach((file, i) => form.append("files", file, inside ? paths[i].slice(top.length) : paths[i]));
  const asked = ask("faces", { method: "POST", body: form }).then(async (answer) => ((await answer.json()) as { job: Job }).job);
  return work(`Reading ${files[0].name}`, asked);
}

/** Ask for an action whose result is a face, or a version of one. */
export function act(action: string, fields: unknown, into: { name?: string; face?: string; from?: number }): Promise<Job> {
  return send<Job>("POST", "jobs", { action, fields, ...into });
}

/** Say where a save has gone, also that somebody else had saved in between. */
export async function saidSaved(job: Job, from: Source | null): Promise<Face | null> {
  if (!job.face) return null;
  const face = await get<Face>(`faces/${job.face}`);
  const made = face.versions.find((one) => one.number === job.version);
  const conflict = made?.conflict_of;
  if (conflict) say(`Version ${conflict} was saved meanwhile: both are kept, yours is version ${job.version}, made from version ${from?.version}.`);
  else say(`Saved: ${face.name}, version ${job.version}.`);
  return face;
}

/** Call `taken` with files that are dropped on an element, which shows that it takes them. */
export function onDrop(element: HTMLElement, taken: (files: File[]) => void): void {
  element.addEventListener("dragover", (event) => {
    event.preventDefault();
    element.classList.add("dropping");
  });
  element.addEventListener("dragleave", () => element.classList.remove("dropping"));
  element.addEventListener("drop", (event) => {
    event.preventDefault();
    event.stopPropagation();
    element.classList.remove("dropping");
    const entries = [...(event.dataTransfer?.items ?? [])].map((item) => item.webkitGetAsEntry());
    void Promise.all(entries.map((entry) => (entry ? filesIn(entry) : []))).then((found) => found.flat().length && taken(found.flat()));
  });
}

/** A file, or those of a folder with its textures below it: each is called by its path from what was dropped. */
async function filesIn(entry: FileSystemEntry): Promise<File[]> {
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) => (entry as FileSystemFileEntry).file(resolve, reject));
    return [Object.defineProperty(file, "webkitRelativePath", { value: entry.fullPath.slice(1) })]; // as inputs of folders say it
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const found: File[] = [];
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) return found;
    for (const one of some) found.push(...(await filesIn(one)));
  }
}

/** A button that opens files. */
export function fileButton(text: string, properties: Record<string, unknown>, taken: (files: File[]) => void): HTMLElement {
  const input = h("input", { type: "file", hidden: true, "aria-label": text, ...properties });
  input.addEventListener("change", () => {
    const files = [...(input.files ?? [])];
    input.value = "";
    if (files.length) taken(files);
  });
  return h("span", {}, input, h("button", { onclick: () => input.click() }, text));
}

interface Picture {
  readonly asking: AbortController;
  readonly url: Promise<string>;
}
const pictures = new Map<string, Picture>(); // of versions, which never change

/** The picture of a version, 256 pixels. */
export function thumbnail(source: Source, name: string): HTMLImageElement {
  const image = h("img", { alt: name, width: 256, height: 256 });
  const file = fileOf(source, "thumbnail.png");
  let picture = pictures.get(file);
  if (!picture) {
    const asking = new AbortController();
    const url = ask(file, { signal: asking.signal }).then(async (answer) => URL.createObjectURL(await answer.blob()));
    pictures.set(file, (picture = { asking, url }));
  }
  picture.url.then((found) => (image.src = found)).catch(() => pictures.delete(file)); // the next look asks again
  return image;
}

/** Keep no picture of a face that goes, and ask for none. */
export function forgetPictures(face: string): void {
  for (const [file, { asking, url }] of pictures) {
    if (!file.startsWith(`faces/${face}/`)) continue;
    pictures.delete(file);
    asking.abort(); // it may still be drawn
    url.then(URL.revokeObjectURL).catch(() => {});
  }
}

/** Buttons that save a version as the files that others read. */
export function downloads(source: Source, name: string): HTMLElement[] {
  const kinds = [["face.glb", "GLB"], ["face.usdc", "USD"], ["face.fpb", "Payload"], ["face.onnx", "ONNX"]];
  return kinds.map(([what, text]) => h("button", { onclick: () => void download(fileOf(source, what), `${name}${what.slice(4)}`).catch(sayError) }, text));
}
