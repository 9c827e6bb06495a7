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
  WrongData,
  readCatalog,
  readHands,
  readSurface,
} from "./format";
import { Playout, TickClock } from "./playout";
import { Drawn, Model } from "./scene";

/** Time behind the earliest arrivals beside a frame's interval, ms: what a network is late. */
const MARGIN = 40;
/** Most bodies that are drawn, of all that a session may name. */
const MAX_DRAWN = 256;
/** Most bytes of all surfaces of a session. */
const MAX_SURFACES = 2 * MAX_SURFACE;
/** How long the last group of a track that has ended may take, ms. */
const LONGEST_GROUP = 60_000;
/** Most messages that are kept for measurements. */
const MAX_WRONGS = 64;
/** Most states that are kept for measurements. */
const MAX_RECORDED = 4096;

/** Where a session is shown. */
export interface View {
  readonly scene: Pick<Scene, "add" | "remove">;
  /** Most texels of a texture in each direction. */
  readonly largestTexture: number;
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
    // A track or a group that was closed is no fault. Wrong data are counted and named, and the page
    // goes on. The library has limits of its own for a frame and a group.
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
}

/** One broadcast, from its catalog to its end. */
export class Session {
  readonly broadcast: Broadcast.Consumer;
  readonly bodies = new Map<number, Watched>();
  /** Bodies whose model or frames are on the way. */
  readonly wanted = new Map<number, { body: CatalogBody; end: () => void }>();
  readonly models = new Map<string, { bytes: number; ready: Promise<Model>; end: () => void }>();
  catalog: Catalog | undefined;
  clock = new TickClock(1 / 60);
  hands: Hands | undefined;
  ended = false;
  #view: View;
  #notes: Notes;

  constructor(broadcast: Broadcast.Consumer, view: View, notes: Notes) {
    this.broadcast = broadcast;
    this.#view = view;
    this.#notes = notes;
  }

  start(): void {
    this.#follow("catalog", 0, async (group) => {
      const frame = await group.readFrame();
      if (frame) this.#read(readCatalog(this.#notes.checked(frame.payload)));
    });
    this.#follow("hands", 2, async (group) => {
      for (let frame = await group.readFrame(); frame && !this.ended; frame = await group.readFrame()) {
        this.hands = readHands(this.#notes.checked(frame.payload));
        this.#view.heard(this.hands);
      }
    });
  }

  /**
   * Reads a track, group by group. What is wrong ends its group; the watching goes on. A group that
   * neither ends nor goes on is closed when the second group after it begins, so it holds up nothing.
   */
  #follow(name: string, priority: number, read: (group: Group.Consumer) => Promise<void>): () => void {
    let track: Track.Subscriber | undefined;
    let over = false;
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
      while (!over && !this.ended) {
        const open: { group: Group.Consumer; read: Promise<void> }[] = [];
        try {
          track = this.broadcast.track(name).subscribe({ priority, latencyMax: 300 });
          for (let group = await track.nextGroup(); group; group = await track.nextGroup()) {
            if (over || this.ended) {
              group.close();
              break;
            }
            this.#notes.numbers.groups++;
            open.push({ group, read: one(group) });
            if (open.length > 2) open.shift()?.group.close();
          }
          // A model's track ends while its group is on the way.
          const late = new Promise((end) => setTimeout(end, LONGEST_GROUP));
          await Promise.race([late, Promise.all(open.map((one) => one.read))]);
        } catch (error) {
          this.#told(error);
        }
        for (const { group } of open) group.close();
        track?.close();
        // A track that ended may come again, but not at once.
        await new Promise((later) => setTimeout(later, 500));
      }
    };
    void run();
    return () => {
      over = true;
      track?.close();
    };
  }

  #read(catalog: Catalog): void {
    if (this.catalog?.session !== catalog.session || this.catalog.step !== catalog.step) {
      this.clock = new TickClock(catalog.step);
    }
    this.catalog = catalog;
    this.#view.title(catalog.name);
    const named = new Map(catalog.bodies.map((body) => [body.id, body]));
    for (const [id, { body, end }] of this.wanted) {
      const now = named.get(id);
      if (now && JSON.stringify(now) === JSON.stringify(body)) continue;
      end();
      this.#remove(id);
      this.wanted.delete(id);
    }
    const kept = new Set(catalog.bodies.map((body) => body.model));
    for (const [hash, model] of this.models) {
      if (kept.has(hash)) continue;
      this.models.delete(hash);
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
    this.wanted.set(body.id, {
      body,
      end: () => {
        over = true;
        stop();
      },
    });
    const begin = (model: Model) => {
      if (over || this.ended) return;
      const places = model.surface.places.subarray(0, body.modes);
      stop = this.#follow(`body/${body.id}`, 1, async (group) => {
        // Two groups may overlap for a moment, so each has a decoder of its own.
        const decoder = new BodyDecoder(places);
        for (let frame = await group.readFrame(); frame && !over; frame = await group.readFrame()) {
          this.#arrived(body, model, decoder.decode(this.#notes.checked(frame.payload)));
        }
      });
    };
    this.#model(body).then(begin, (error) => this.#told(error));
  }

  #model(body: CatalogBody): Promise<Model> {
    const known = this.models.get(body.model);
    if (known) return known.ready;
    let bytes = body.surfaceBytes;
    for (const other of this.models.values()) bytes += other.bytes;
    if (!(bytes <= MAX_SURFACES)) return Promise.reject(new WrongData("the session's models are too large"));
    let gone = false;
    let stop = () => {};
    let made: Model | undefined;
    const ready = new Promise<Model>((done) => {
      stop = this.#follow(`surface/${body.model}`, 0, async (group) => {
        const assembler = new Assembler(body.surfaceBytes);
        for (let frame = await group.readFrame(); frame && !gone; frame = await group.readFrame()) {
          const whole = assembler.push(this.#notes.checked(frame.payload));
          this.#sayBefore(`model: ${Math.round(100 * assembler.progress)} %`);
          if (!whole) continue;
          const surface = readSurface(whole);
          if (surface.model !== body.model) throw new WrongData("a surface is of another model");
          stop();
          if (made) return;
          made = new Model(surface, this.#view.largestTexture);
          done(made);
          return;
        }
      });
    });
    const end = () => {
      gone = true;
      stop();
      made?.dispose();
    };
    this.models.set(body.model, { bytes: body.surfaceBytes, ready, end });
    return ready;
  }

  #arrived(body: CatalogBody, model: Model, state: State): void {
    this.clock.arrived(state.tick, performance.now());
    const recorded = this.#notes.recorded;
    if (recorded && recorded.length < MAX_RECORDED) recorded.push({ body: body.id, state });
    let watched = this.bodies.get(body.id);
    if (!watched) {
      watched = { body, model, drawn: new Drawn(body, model), playout: new Playout(body.every) };
      watched.drawn.show(state, state, 0);
      this.bodies.set(body.id, watched);
      this.#view.scene.add(watched.drawn.mesh);
      const numbers = this.#notes.numbers;
      if (numbers.firstPicture === 0) numbers.firstPicture = performance.now() - numbers.began;
    }
    if (this.#notes.frozen === undefined) watched.playout.push(state);
  }

  #told(error: unknown): void {
    if (!this.#notes.told(error)) return;
    this.#sayBefore(`The session sends what this page does not take: ${this.#notes.lastWrong}`);
  }

  /** Says what is under way or wrong while there is no body to see: its line says that, and more. */
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
    for (const { body, drawn, playout } of this.bodies.values()) {
      const delay = body.every * catalog.step * 1000 + MARGIN;
      const tick = this.#notes.frozen ?? this.clock.tick(now, delay);
      const pair = tick === undefined ? undefined : playout.at(tick);
      if (pair) drawn.show(...pair);
    }
    this.#view.frame(
      catalog,
      [...this.bodies.values()].map((watched) => watched.drawn),
    );
    this.#view.showHands(this.hands?.hands ?? []);
    if (this.bodies.size > 0) {
      const people = this.hands ? `${this.hands.people} in the session, ` : "";
      const { numbers, lastWrong } = this.#notes;
      const wrong = numbers.wrong > 0 ? `, ${numbers.wrong} wrong: ${lastWrong}` : "";
      const bodies = this.bodies.size === 1 ? "1 body" : `${this.bodies.size} bodies`;
      this.#view.say(`${people}${bodies}, ${(numbers.bytes / 1024).toFixed(0)} KiB${wrong}`);
    }
  }

  end(): void {
    this.ended = true;
    for (const { end } of this.wanted.values()) end();
    for (const id of [...this.bodies.keys()]) this.#remove(id);
    for (const model of this.models.values()) model.end();
    this.#view.showHands([]);
  }
}
