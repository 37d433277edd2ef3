/** States that can be gone back to. */
const MOST = 200;

export class History<State> {
  private readonly before: string[] = [];
  private readonly after: string[] = [];

  constructor(
    private now: State,
    private readonly changed: () => void,
  ) {}

  /** A state that was settled on; the same again is none. */
  keep(state: State): void {
    const [old, text] = [JSON.stringify(this.now), JSON.stringify(state)];
    if (old === text) return;
    this.before.push(old);
    this.before.splice(0, this.before.length - MOST);
    this.after.length = 0;
    this.now = JSON.parse(text) as State;
    this.changed();
  }

  undo(): State | null {
    return this.step(this.before, this.after);
  }

  redo(): State | null {
    return this.step(this.after, this.before);
  }

  get canUndo(): boolean {
    return this.before.length > 0;
  }

  get canRedo(): boolean {
    return this.after.length > 0;
  }

  private step(from: string[], to: string[]): State | null {
    const text = from.pop();
    if (text === undefined) return null;
    to.push(JSON.stringify(this.now));
    this.now = JSON.parse(text) as State;
    this.changed();
    return structuredClone(this.now);
  }
}
