/** States that can be gone back to. */
const MOST = 200;

export class History<State> {
  private readonly before: string[] = [];
  private readonly after: string[] = [];

  private now: string; // as text: who changes the state that it was given changes none of these

  constructor(
    state: State,
    private readonly changed: () => void,
  ) {
    this.now = JSON.stringify(state);
  }

  /** A state that was settled on; the same again is none. */
  keep(state: State): void {
    const text = JSON.stringify(state);
    if (this.now === text) return;
    this.before.push(this.now);
    this.before.splice(0, this.before.length - MOST);
    this.after.length = 0;
    this.now = text;
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
    to.push(this.now);
    this.now = text;
    this.changed();
    return JSON.parse(text) as State;
  }
}
