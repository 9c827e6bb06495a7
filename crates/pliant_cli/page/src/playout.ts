// Which states to draw at which time: a little behind the host, so that there is a next state.

import type { Hand, Hands, State, Vector } from "./format";

/** Most states of a body, and most messages with hands, that wait to be drawn. */
const MOST = 64;
/** Number of ticks by which a message with hands may be older than what was heard last. */
const OVERLAP = 1000;
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

/** Which hand it is: of which body, of whom, and which one of theirs. */
export const keyOf = (hand: Hand) => `${hand.body}/${hand.user}/${hand.grab}`;

/** The messages with hands that are drawn or wait. */
export class HandsPlayout {
  #messages: Hands[] = [];

  push(hands: Hands): void {
    const messages = this.#messages;
    const last = messages[messages.length - 1];
    if (last && hands.tick <= last.tick) {
      // Two groups that overlap, or a new count of ticks, as of a body's states.
      if (last.tick - hands.tick < OVERLAP) return;
      messages.length = 0;
    }
    messages.push(hands);
    if (messages.length > MOST) messages.shift();
  }

  /**
   * The hands at a tick. A hand that both messages around the tick have goes straight from one to
   * the other. One that only the first has stays until the tick of the second, and one that only
   * the second has appears there: nothing says when it came or went in between.
   */
  at(tick: number): Hand[] {
    const messages = this.#messages;
    while (messages.length > 1 && messages[1]!.tick <= tick) messages.shift();
    const [from, to] = messages;
    if (!from || from.tick > tick) return [];
    if (!to) return from.hands;
    const part = (tick - from.tick) / (to.tick - from.tick);
    const next = new Map(to.hands.map((hand) => [keyOf(hand), hand]));
    return from.hands.map((hand) => {
      const then = next.get(keyOf(hand));
      if (!then) return hand;
      const between = (a: Vector, b: Vector) => a.map((x, k) => x + (b[k]! - x) * part) as Vector;
      const target = between(hand.target, then.target);
      return { ...hand, target, reaction: between(hand.reaction, then.reaction) };
    });
  }
}
