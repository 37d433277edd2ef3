/** A blend that follows its weights: the websocket of warm sessions. */
import { token } from "./api";
import type { Source } from "./api";

export interface Weights {
  regions: Record<string, number[]>;
  default: number[];
  locked: Record<string, number>;
}

export interface Opened {
  regions: string[];
  meshes: { name: string; points: number }[];
}

export interface Listener {
  opened: (opened: Opened) => void;
  /** millimetres in glTF space from the first source's points, 3 numbers a point; the last answer is settled */
  moved: (offsets: Float32Array, settled: boolean) => void;
  failed: (why: string) => void;
}

const [AGAIN, LATEST] = [1000, 30_000]; // ms after which a lost connection is made anew, twice as long each time
const MM = 1e-3;

export class LiveEdit {
  private socket: WebSocket | null = null;
  private number = 0;
  private ready = false;
  private waiting: Weights | null = null;
  private last: Weights | null = null;
  private closed = false;
  private pause = AGAIN;

  constructor(
    private readonly sources: Source[],
    private readonly listener: Listener,
  ) {
    this.connect();
  }

  /** Ask for weights; those that come while others are on their way wait, and only the newest of them. */
  send(weights: Weights): void {
    this.last = this.waiting = structuredClone(weights);
    this.next();
  }

  close(): void {
    this.closed = true;
    this.socket?.close();
  }

  private connect(): void {
    const url = new URL("api/v1/edit", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    const socket = (this.socket = new WebSocket(url, "facepipe.1"));
    socket.binaryType = "arraybuffer";
    this.ready = false;
    let refused = false;
    socket.addEventListener("open", () => socket.send(JSON.stringify({ token: token(), open: { blend: { sources: this.sources } } })));
    socket.addEventListener("message", ({ data }: MessageEvent<string | ArrayBuffer>) => {
      if (data instanceof ArrayBuffer) this.take(data);
      else {
        const told = JSON.parse(data) as { opened?: Opened; error?: string };
        if (told.opened) {
          this.pause = AGAIN;
          this.listener.opened(told.opened);
        }
        if (told.error) refused = !this.ready && !this.number;
        if (told.error) this.listener.failed(told.error);
        this.ready = true;
        this.next();
      }
    });
    socket.addEventListener("close", () => {
      this.ready = false;
      if (this.closed || refused) return;
      this.waiting ??= this.last;
      setTimeout(() => !this.closed && this.connect(), this.pause);
      this.pause = Math.min(2 * this.pause, LATEST);
    });
  }

  private next(): void {
    if (!this.ready || !this.waiting || this.socket?.readyState !== WebSocket.OPEN) return;
    this.socket.send(JSON.stringify({ n: ++this.number, weights: this.waiting }));
    this.waiting = null;
    this.ready = false;
  }

  private take(data: ArrayBuffer): void {
    const head = new DataView(data);
    const [number, settled] = [head.getUint32(0, true), head.getUint32(4, true) === 1];
    if (number !== this.number) return; // it has moved on
    this.listener.moved(floats(new Uint16Array(data, 8)), settled);
    if (!settled) this.ready = true;
    this.next();
  }
}

let table: Float32Array | null = null;

/** Float16 millimetres -> metres. */
function floats(halves: Uint16Array): Float32Array {
  table ??= Float32Array.from({ length: 1 << 16 }, (_, bits) => MM * half(bits));
  const found = new Float32Array(halves.length);
  for (let i = 0; i < halves.length; i++) found[i] = table[halves[i]];
  return found;
}

function half(bits: number): number {
  const [sign, exponent, fraction] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  if (exponent === 31) return 0; // the server sends no infinity
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}
