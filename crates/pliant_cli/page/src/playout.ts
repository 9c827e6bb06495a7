// Which states to draw at which time: a little behind the host, so that there is a next state.

import type { State } from "./format";

/** Most states of a body that wait to be drawn. */
const MOST = 64;
/** How long the earliest arrivals count, ms. */
const WINDOW = 5000;

/**
 * The host's ticks by this machine's clock: the line through the earliest arrivals of the last
 * seconds, which are those that waited least.
 */
export class TickClock {
  #step: number;
  #ahead: { at: number; offset: number }[] = [];

  constructor(step: number) {
    this.#step = step;
  }

  /** A tick arrived at `now`, ms. */
  arrived(tick: number, now: number): void {
    const offset = tick * this.#step * 1000 - now;
    // A jump of more than a second is another count of ticks, or a pause of this machine.
    const known = this.#offset();
    if (known !== undefined && Math.abs(offset - known) > 1000) this.#ahead = [];
    while (this.#ahead.length > 0 && this.#ahead[this.#ahead.length - 1]!.offset <= offset) this.#ahead.pop();
    this.#ahead.push({ at: now, offset });
    while (this.#ahead[0]!.at < now - WINDOW) this.#ahead.shift();
  }

  #offset(): number | undefined {
    return this.#ahead[0]?.offset;
  }

  /** The tick to draw at `now`, `delay` ms behind the earliest arrivals. */
  tick(now: number, delay: number): number | undefined {
    const offset = this.#offset();
    return offset === undefined ? undefined : (now + offset - delay) / (this.#step * 1000);
  }
}

/** The states of a body that are drawn or wait. */
export class Playout {
  #states: State[] = [];
  #every: number;

  constructor(every: number) {
    this.#every = every;
  }

  get newest(): State | undefined {
    return this.#states[this.#states.length - 1];
  }

  push(state: State): void {
    const last = this.newest;
    if (last && state.tick <= last.tick) {
      // A group that overlaps the last one, or a new count of ticks.
      if (last.tick - state.tick < 1000 * this.#every) return;
      this.#states = [];
    }
    if (last?.resting && state.tick > last.tick + this.#every) {
      // It slept until a moment ago, and did not glide all that time.
      this.#states.push({ ...last, tick: state.tick - this.#every });
    }
    this.#states.push(state);
    if (this.#states.length > MOST) this.#states.splice(0, this.#states.length - MOST);
  }

  /** The two states around a tick, and how far it is from the first to the second. */
  at(tick: number): [State, State, number] | undefined {
    const states = this.#states;
    while (states.length > 1 && states[1]!.tick <= tick) states.shift();
    const [from, to] = [states[0], states[1] ?? states[0]];
    if (!from || !to) return undefined;
    const part = to.tick > from.tick ? (tick - from.tick) / (to.tick - from.tick) : 0;
    return [from, to, Math.min(Math.max(part, 0), 1)];
  }
}
