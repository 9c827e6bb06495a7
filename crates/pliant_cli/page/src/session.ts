// One session: reads its tracks, and says which bodies and hands are seen where. Nothing here is of
// the page's document or of its graphics card, so a test follows a session without a browser.

import { Group } from "@moq/net";
import type { Broadcast, Track } from "@moq/net";
import type { Scene } from "three";
import {
  Assembler,
  BodyDecoder,
  type Catalog,
  type CatalogBody,
  type Hand,
  type Hands,
  MAX_FRAME,
  MAX_SURFACE,
  type State,
  type Surface,
  WrongData,
  readCatalog,
  readHands,
  readSurface,
} from "./format";
import { HandsPlayout, Playout, TickClock } from "./playout";
import { Drawn, Model } from "./scene";

/** Time behind the earliest arrivals beside a frame's interval, ms: what a network is late. */
const MARGIN = 40;
/** Most bodies that are drawn, of all that a session may name. */
const MAX_DRAWN = 256;
/** Most bytes of all surfaces of a session. */
const MAX_SURFACES = 2 * MAX_SURFACE;
/** Pause before a track that has ended is asked for again, ms. */
const RETRY_PAUSE = 500;
/** Longest pause before a surface is asked for again, ms. */
const LONGEST_PAUSE = 4000;
/** How long the last groups of a track that has ended may take, ms. */
const LAST_GROUPS = 2000;
/** How long a surface may pause on its way before it is asked for anew, ms. */
const LONGEST_SILENCE = 30_000;
/** How long the view waits for further bodies of the catalog after the first one, ms. */
const FRAME_PAUSE = 1000;
/** From which age on the newest picture's age is told, ms. */
const OLD = 2000;
/** Most messages that are kept for measurements. */
const MAX_WRONGS = 64;
/** Most states that are kept for measurements. */
const MAX_RECORDED = 4096;

/** Where a session is shown. */
export interface View {
  readonly scene: Pick<Scene, "add" | "remove">;
  /** Most texels of a texture in each direction. */
  readonly largestTexture: number;
  /** Looks at all bodies, as far as the camera is not the watcher's. */
  frame(catalog: Catalog, drawn: Drawn[]): void;
  showHands(hands: Hand[]): void;
  /** Hands and numbers have arrived. */
  heard(hands: Hands): void;
  /** The line that says what is seen, or what is waited for. */
  say(text: string): void;
  title(text: string): void;
}

/** What arrived since the page was opened, whichever session it was of. */
export class Notes {
  readonly numbers = { frames: 0, bytes: 0, wrong: 0, groups: 0, firstPicture: 0, began: performance.now() };
  readonly wrongs = new Set<string>();
  lastWrong = "";
  /** For measurements: what was decoded, and a tick to hold the picture at. */
  recorded: { body: number; state: State }[] | undefined;
  recordedHands: Hands[] = [];
  frozen: number | undefined;

  checked(payload: Uint8Array): Uint8Array {
    if (payload.length > MAX_FRAME) throw new WrongData("a frame is too long");
    this.numbers.frames++;
    this.numbers.bytes += payload.length;
    return payload;
  }

  /** Counts and names what is wrong, and returns whether it is. */
  told(error: unknown): boolean {
    const found = error instanceof Error ? error.message : String(error);
    // A track or a group that was closed is no fault. Wrong data are counted and named, and the
    // page goes on. The library has limits of its own for a frame and a group.
    const tooLong = found.includes("exceeds max size");
    const flood = error instanceof Group.Lagged;
    if (!(error instanceof WrongData) && !tooLong && !flood) {
      console.debug(`not read: ${found}`);
      return false;
    }
    this.numbers.wrong++;
    this.lastWrong = tooLong ? "a frame is too long" : flood ? "a group comes faster than it is read" : found;
    if (this.wrongs.size < MAX_WRONGS) this.wrongs.add(this.lastWrong);
    return true;
  }
}

/** A body of the running session. */
export interface Watched {
  body: CatalogBody;
  model: Model;
  drawn: Drawn;
  playout: Playout;
  /** When its newest frame arrived. */
  heard: number;
}

/** A body that the catalog names, and what ends its tracks. */
interface Wanted {
  body: CatalogBody;
  end: () => void;
}

/** A model that is there or on the way. */
interface Fetched {
  /** Bytes that it may take, once there is room for it. */
  bytes: number;
  ready: Promise<Model>;
  end: () => void;
}

/** Which surface it is. Of two catalogs that disagree on its length, each gets its own. */
const surfaceOf = (body: CatalogBody) => `${body.model}/${body.surfaceBytes}`;

/** Whether a body is decoded and drawn as another one: its name, place and color do not matter. */
function alike(a: CatalogBody, b: CatalogBody): boolean {
  const same = a.modes === b.modes && a.every === b.every && a.free === b.free && a.warps === b.warps;
  return same && surfaceOf(a) === surfaceOf(b);
}

/** Waits, but not beyond the end of what waits, nor until `earlier` if that is given. */
async function pause(ms: number, end: AbortSignal, earlier?: Promise<unknown>): Promise<void> {
  if (end.aborted) return;
  await new Promise<void>((done) => {
    // Nothing of it stays: a session may wait a million times.
    const over = () => {
      clearTimeout(timer);
      end.removeEventListener("abort", over);
      done();
    };
    const timer = setTimeout(over, ms);
    end.addEventListener("abort", over);
    void earlier?.then(over);
  });
}

/** One broadcast, from its catalog to its end. */
export class Session {
  readonly broadcast: Broadcast.Consumer;
  readonly bodies = new Map<number, Watched>();
  /** Bodies whose model or frames are on the way. */
  readonly wanted = new Map<number, Wanted>();
  readonly models = new Map<string, Fetched>();
  catalog: Catalog | undefined;
  clock = new TickClock(1 / 60);
  /** The newest hands, and when they arrived. */
  hands: Hands | undefined;
  handsHeard = 0;
  handsPlayout = new HandsPlayout();
  ended = false;
  /** When the first body was seen, and whether the view has waited for the others. */
  #framed: { first: number; all: boolean } | undefined;
  /** What ends each track that is followed. */
  #tracks = new Set<AbortController>();
  #view: View;
  #notes: Notes;

  constructor(broadcast: Broadcast.Consumer, view: View, notes: Notes) {
    this.broadcast = broadcast;
    this.#view = view;
    this.#notes = notes;
  }

  start(): void {
    this.#follow("catalog", 3, async (group) => {
      const frame = await group.readFrame();
      if (frame) this.#read(readCatalog(this.#notes.checked(frame.payload)));
    });
    this.#follow("hands", 1, async (group) => {
      for (let frame = await group.readFrame(); frame && !this.ended; frame = await group.readFrame()) {
        this.#heard(readHands(this.#notes.checked(frame.payload)));
      }
    });
  }

  /**
   * Reads a track, group by group. What is wrong ends its group; the watching goes on. A group
   * that neither ends nor goes on is closed when the second group after it begins, so it holds up
   * nothing.
   */
  #follow(name: string, priority: number, read: (group: Group.Consumer) => Promise<void>): () => void {
    let track: Track.Subscriber | undefined;
    const end = new AbortController();
    this.#tracks.add(end);
    end.signal.addEventListener("abort", () => {
      this.#tracks.delete(end);
      track?.close();
    });
    const one = async (group: Group.Consumer) => {
      try {
        await read(group);
      } catch (error) {
        this.#told(error);
      } finally {
        group.close();
      }
    };
    const run = async () => {
      while (!end.signal.aborted) {
        const open: { group: Group.Consumer; read: Promise<void> }[] = [];
        try {
          track = this.broadcast.track(name).subscribe({ priority, latencyMax: 300 });
          for (let group = await track.nextGroup(); group; group = await track.nextGroup()) {
            if (end.signal.aborted) {
              group.close();
              break;
            }
            this.#notes.numbers.groups++;
            open.push({ group, read: one(group) });
            if (open.length > 2) open.shift()?.group.close();
          }
          // A track may end while its last groups are on the way.
          await pause(LAST_GROUPS, end.signal, Promise.all(open.map((one) => one.read)));
        } catch (error) {
          this.#told(error);
        }
        for (const { group } of open) group.close();
        track?.close();
        // A track that ended may come again, but not at once.
        await pause(RETRY_PAUSE, end.signal);
      }
    };
    void run();
    return () => end.abort();
  }

  #read(catalog: Catalog): void {
    const other = this.catalog?.session !== catalog.session || this.catalog.step !== catalog.step;
    if (other) {
      this.clock = new TickClock(catalog.step);
      this.handsPlayout = new HandsPlayout();
      this.#framed = undefined;
    }
    this.catalog = catalog;
    this.#view.title(catalog.name);
    const named = new Map(catalog.bodies.map((body) => [body.id, body]));
    for (const [id, wanted] of this.wanted) {
      const now = named.get(id);
      if (now && !other && alike(now, wanted.body)) {
        wanted.body = now;
        const watched = this.bodies.get(id);
        if (!watched) continue;
        watched.body = now;
        watched.drawn.place(now);
        continue;
      }
      wanted.end();
      this.#remove(id);
      this.wanted.delete(id);
    }
    const kept = new Set(catalog.bodies.map(surfaceOf));
    for (const [key, model] of this.models) {
      if (kept.has(key)) continue;
      this.models.delete(key);
      model.end();
    }
    for (const body of catalog.bodies) {
      if (this.wanted.has(body.id)) continue;
      if (this.wanted.size >= MAX_DRAWN) throw new WrongData(`the session has more than ${MAX_DRAWN} bodies`);
      this.#want(body);
    }
  }

  #want(body: CatalogBody): void {
    let over = false;
    let stop = () => {};
    const wanted: Wanted = {
      body,
      end: () => {
        over = true;
        stop();
      },
    };
    this.wanted.set(body.id, wanted);
    const begin = (model: Model) => {
      if (over || this.ended) return;
      const places = model.surface.places.subarray(0, body.modes);
      stop = this.#follow(`body/${body.id}`, 2, async (group) => {
        // Two groups may overlap for a moment, so each has a decoder of its own.
        const decoder = new BodyDecoder(places);
        for (let frame = await group.readFrame(); frame && !over; frame = await group.readFrame()) {
          this.#arrived(wanted.body, model, decoder.decode(this.#notes.checked(frame.payload)));
        }
      });
    };
    void this.#model(body).then(begin);
  }

  /** The model of a body, which is fetched once for all bodies that have it. */
  #model(body: CatalogBody): Promise<Model> {
    const key = surfaceOf(body);
    const known = this.models.get(key);
    if (known) return known.ready;
    const gone = new AbortController();
    let made: Model | undefined;
    const end = () => {
      gone.abort();
      made?.dispose();
    };
    const fetch = async (done: (model: Model) => void) => {
      // A host writes a surface once for each that asks, so that whoever has not got it asks again.
      for (let wait = RETRY_PAUSE; !gone.signal.aborted; wait = Math.min(2 * wait, LONGEST_PAUSE)) {
        let surface: Surface | undefined;
        try {
          this.#admit(body);
          surface = await this.#surface(body, gone.signal);
        } catch (error) {
          this.#told(error);
        }
        if (gone.signal.aborted) return;
        if (!surface) {
          await pause(wait, gone.signal);
          continue;
        }
        try {
          made = new Model(surface, this.#view.largestTexture);
          done(made);
        } catch (error) {
          // It would not get smaller.
          this.#told(error);
        }
        return;
      }
    };
    let done: (model: Model) => void = () => {};
    const ready = new Promise<Model>((made) => {
      done = made;
    });
    this.models.set(key, { bytes: 0, ready, end });
    void fetch(done);
    return ready;
  }

  /** Whether there is room for a surface. What is refused takes no room from the others. */
  #admit(body: CatalogBody): void {
    const fetched = this.models.get(surfaceOf(body));
    if (!fetched || fetched.bytes > 0) return;
    let bytes = body.surfaceBytes;
    for (const other of this.models.values()) bytes += other.bytes;
    if (!(bytes <= MAX_SURFACES)) throw new WrongData("the session's models are too large");
    fetched.bytes = body.surfaceBytes;
  }

  /** Asks for a surface, and reads it. Returns nothing when it was cut off. */
  async #surface(body: CatalogBody, gone: AbortSignal): Promise<Surface | undefined> {
    const assembler = new Assembler(body.surfaceBytes);
    const track = this.broadcast.track(`surface/${body.model}`).subscribe({ priority: 0, latencyMax: 300 });
    let group: Group.Consumer | undefined;
    // Whoever closes what is read ends the reading. The next try begins with a line of its own.
    const close = () => {
      group?.close();
      track.close();
    };
    let heard = performance.now();
    const silence = setInterval(() => {
      if (performance.now() - heard > LONGEST_SILENCE) close();
    }, 1000);
    gone.addEventListener("abort", close);
    try {
      group = await track.nextGroup();
      if (group) this.#notes.numbers.groups++;
      for (let frame = await group?.readFrame(); frame; frame = await group?.readFrame()) {
        heard = performance.now();
        const whole = assembler.push(this.#notes.checked(frame.payload));
        this.#sayBefore(`model: ${Math.round(100 * assembler.progress)} %`);
        if (!whole) continue;
        const surface = readSurface(whole);
        if (surface.model !== body.model) throw new WrongData("a surface is of another model");
        return surface;
      }
      return undefined;
    } finally {
      clearInterval(silence);
      gone.removeEventListener("abort", close);
      close();
    }
  }

  #heard(hands: Hands): void {
    const now = performance.now();
    // Hands come while all bodies rest, too, and say which tick it is.
    this.clock.arrived(hands.tick, now);
    const { recorded, recordedHands, frozen } = this.#notes;
    if (recorded && recordedHands.length < MAX_RECORDED) recordedHands.push(hands);
    if (frozen === undefined) this.handsPlayout.push(hands);
    this.hands = hands;
    this.handsHeard = now;
    this.#view.heard(hands);
  }

  #arrived(body: CatalogBody, model: Model, state: State): void {
    const now = performance.now();
    // Who comes late gets the last frame of a body that rests, however long ago it was.
    if (!state.resting) this.clock.arrived(state.tick, now);
    const recorded = this.#notes.recorded;
    if (recorded && recorded.length < MAX_RECORDED) recorded.push({ body: body.id, state });
    let watched = this.bodies.get(body.id);
    if (!watched) {
      watched = { body, model, drawn: new Drawn(body, model), playout: new Playout(body.every), heard: now };
      watched.drawn.show(state, state, 0);
      this.bodies.set(body.id, watched);
      this.#view.scene.add(watched.drawn.mesh);
      const numbers = this.#notes.numbers;
      if (numbers.firstPicture === 0) numbers.firstPicture = now - numbers.began;
    }
    watched.heard = now;
    if (this.#notes.frozen === undefined) watched.playout.push(state);
  }

  #told(error: unknown): void {
    if (!this.#notes.told(error)) return;
    this.#sayBefore(`The session sends what this page does not take: ${this.#notes.lastWrong}`);
  }

  /** Says what is under way or wrong while no body is seen: with one, its line says more. */
  #sayBefore(text: string): void {
    if (this.bodies.size === 0) this.#view.say(text);
  }

  #remove(id: number): void {
    const watched = this.bodies.get(id);
    if (!watched) return;
    this.#view.scene.remove(watched.drawn.mesh);
    watched.drawn.dispose();
    this.bodies.delete(id);
  }

  draw(now: number): void {
    const catalog = this.catalog;
    if (!catalog) return;
    const due = (every: number) => {
      return this.#notes.frozen ?? this.clock.tick(now, every * catalog.step * 1000 + MARGIN);
    };
    for (const { body, drawn, playout } of this.bodies.values()) {
      const tick = due(body.every);
      const pair = tick === undefined ? undefined : playout.at(tick);
      if (pair) drawn.show(...pair);
    }
    this.#frame(catalog, now);
    // A host has one rate for hands and all bodies.
    const tick = due(Math.max(1, ...catalog.bodies.map((body) => body.every)));
    this.#view.showHands(tick === undefined ? [] : this.handsPlayout.at(tick));
    if (this.bodies.size > 0) {
      const people = this.hands ? `${this.hands.people} in the session, ` : "";
      const { numbers, lastWrong } = this.#notes;
      const wrong = numbers.wrong > 0 ? `, ${numbers.wrong} wrong: ${lastWrong}` : "";
      const bodies = this.bodies.size === 1 ? "1 body" : `${this.bodies.size} bodies`;
      this.#view.say(`${people}${bodies}${this.#age(now)}, ${(numbers.bytes / 1024).toFixed(0)} KiB${wrong}`);
    }
  }

  /** Looks at the first body at once, and once more when the others are there, or late. */
  #frame(catalog: Catalog, now: number): void {
    if (this.bodies.size === 0 || this.#framed?.all) return;
    const first = this.#framed?.first ?? now;
    const all = this.bodies.size >= catalog.bodies.length || now - first > FRAME_PAUSE;
    if (!this.#framed || all) {
      this.#view.frame(
        catalog,
        [...this.bodies.values()].map((watched) => watched.drawn),
      );
    }
    this.#framed = { first, all };
  }

  /**
   * How old the newest picture is, where it is old. A body that rests has no frames, so that if all
   * do, hands' messages tell whether the host is there: they come all the time.
   */
  #age(now: number): string {
    const step = this.catalog?.step ?? 0;
    const all = [...this.bodies.values()];
    const awake = all.filter(({ playout }) => !playout.newest?.resting);
    const old = awake.filter(({ body, heard }) => now - heard > Math.max(OLD, 2000 * body.every * step));
    const since = (heard: number) => `nothing new for ${Math.floor((now - heard) / 1000)} s`;
    if (awake.length === 0) {
      const heard = Math.max(this.handsHeard, ...all.map((body) => body.heard));
      const longest = Math.max(OLD, ...all.map(({ body }) => 2000 * body.every * step));
      return now - heard > longest ? `, ${since(heard)}` : "";
    }
    if (old.length === 0) return "";
    if (old.length === awake.length) return `, ${since(Math.max(...old.map((body) => body.heard)))}`;
    const of = old.length === 1 ? "1 body" : `${old.length} bodies`;
    const heard = Math.min(...old.map((body) => body.heard));
    return `, ${since(heard).replace(" for", ` of ${of} for`)}`;
  }

  end(): void {
    this.ended = true;
    for (const track of [...this.#tracks]) track.abort();
    for (const { end } of this.wanted.values()) end();
    for (const id of [...this.bodies.keys()]) this.#remove(id);
    for (const model of this.models.values()) model.end();
    this.#view.showHands([]);
  }
}
