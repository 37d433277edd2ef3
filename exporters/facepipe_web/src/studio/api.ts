/** The server's API (docs/serve.md), and the token of who asks: typed once, kept for this tab alone. */

export interface Version {
  number: number;
  created: string;
  made_by: string;
  bytes: number;
  sources: Source[];
  conflict_of: number | null;
}

export interface Face {
  id: string;
  name: string;
  created: string;
  version: number;
  versions: Version[];
}

/** A version of a face. */
export interface Source {
  face: string;
  version: number;
}

export interface Job {
  id: string;
  action: string;
  state: "queued" | "running" | "done" | "failed" | "cancelled";
  /** `picture`: a JPEG of how it stands, in base64 */
  progress: { text: string; share: number | null; picture: string | null } | null;
  error: string | null;
  /** of one that is done: the action's own, without long lists */
  report: { report?: { animation?: string; no_target?: Record<string, string> } } | null;
  face: string | null;
  version: number | null;
}

/** What the server said no with. */
export class Refusal extends Error {
  constructor(
    readonly status: number,
    message: string,
    /** ids of faces that stand on what was to be deleted */
    readonly dependents: string[] = [],
  ) {
    super(message);
  }
}

const ROOT = "api/v1/";
const KEY = "facepipe.token";

export function token(): string | null {
  return sessionStorage.getItem(KEY);
}

export function keepToken(text: string): void {
  sessionStorage.setItem(KEY, text);
}

/** Every request of the page has the token, those of the runtime for GLB and ONNX too: it never stands in a URL. */
export function sendToken(): void {
  const plain = window.fetch.bind(window);
  window.fetch = (input, init = {}) => {
    const url = new URL(input instanceof Request ? input.url : input, location.href);
    const own = token();
    if (!own || url.origin !== location.origin) return plain(input, init);
    const headers = new Headers(init.headers);
    headers.set("Authorization", `Bearer ${own}`);
    return plain(input, { ...init, headers });
  };
}

/** @throws Refusal with the server's own line */
export async function ask(path: string, init: RequestInit = {}): Promise<Response> {
  let answer: Response;
  try {
    answer = await fetch(ROOT + path, init);
  } catch {
    throw new Refusal(0, "The server does not answer: is it still running?");
  }
  if (answer.ok) return answer;
  const told = (await answer.json().catch(() => ({}))) as { error?: string; dependents?: string[] };
  throw new Refusal(answer.status, told.error ?? `the server says ${answer.status}`, told.dependents);
}

export async function get<T>(path: string): Promise<T> {
  return (await ask(path)).json() as Promise<T>;
}

export async function send<T>(method: "POST" | "PATCH", path: string, content: unknown): Promise<T> {
  const init = { method, headers: { "Content-Type": "application/json" }, body: JSON.stringify(content) };
  return (await ask(path, init)).json() as Promise<T>;
}

export function fileOf({ face, version }: Source, what: string): string {
  return `faces/${face}/versions/${version}/${what}`;
}

export function newest(face: Face): Source {
  return { face: face.id, version: face.version };
}

/**
 * Follow a job to its end.
 * @throws Refusal a job that has failed or was cancelled
 */
export async function follow(job: Job, told: (job: Job) => void): Promise<Job> {
  let now = job;
  const events = await ask(`jobs/${job.id}/events`);
  const lines = events.body!.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (let part = await lines.read(); !part.done; part = await lines.read()) {
    text += part.value;
    const records = text.split(/\r?\n\r?\n/);
    text = records.pop()!;
    for (const record of records) {
      const data = record.split(/\r?\n/).find((line) => line.startsWith("data:"));
      if (!data) continue;
      now = { ...now, ...(JSON.parse(data.slice(5)) as Partial<Job>) };
      told(now);
    }
  }
  now = await get<Job>(`jobs/${job.id}`);
  if (now.state !== "done") throw new Refusal(0, now.error ?? `${now.action} was ${now.state}`);
  return now;
}

/** Let the browser save a file. */
export async function download(path: string, name: string, init: RequestInit = {}): Promise<void> {
  saveAs(await (await ask(path, init)).blob(), name);
}

export function saveAs(content: Blob, name: string): void {
  const url = URL.createObjectURL(content);
  const link = Object.assign(document.createElement("a"), { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
