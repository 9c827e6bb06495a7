// The page: opens the session of its link and draws it.
//
// The link's fragment says where: #relay=URL&session=PATH, and certificate=HASH for a relay with a
// certificate of its own. A fragment never reaches the web server, so a token in the relay's URL
// stays between watcher and relay.

import { Connection, Group, Path } from "@moq/net";
import type { Broadcast, Track } from "@moq/net";
import {
  Assembler,
  BodyDecoder,
  type Catalog,
  type CatalogBody,
  type Hands,
  MAX_FRAME,
  MAX_SURFACE,
  type State,
  WrongData,
  readCatalog,
  readHands,
  readSurface,
  shapeOf,
} from "./format";
import { Playout, TickClock } from "./playout";
import { Plot } from "./plot";
import { Drawn, Model, Stage } from "./scene";

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

const byId = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;
const stage = new Stage(byId<HTMLCanvasElement>("scene"));
const plot = new Plot(byId<HTMLCanvasElement>("plot"));
const status = byId("status");
const title = byId("title");

function say(text: string): void {
  // Names and errors come from outside: they are text and never markup.
  status.textContent = text;
}

/** Says what is under way or wrong while there is no body to see: its line says that, and more. */
function sayBefore(text: string): void {
  if (!session?.bodies.size) say(text);
}

/** A body of the running session. */
interface Watched {
  body: CatalogBody;
  model: Model;
  drawn: Drawn;
  playout: Playout;
}

const numbers = { frames: 0, bytes: 0, wrong: 0, groups: 0, firstPicture: 0, began: performance.now() };
let session: Session | undefined;

/** One broadcast, from its catalog to its end. */
class Session {
  readonly broadcast: Broadcast.Consumer;
  readonly bodies = new Map<number, Watched>();
  /** Bodies whose model or frames are on the way. */
  readonly wanted = new Map<number, { body: CatalogBody; end: () => void }>();
  readonly models = new Map<string, { bytes: number; ready: Promise<Model>; end: () => void }>();
  catalog: Catalog | undefined;
  clock = new TickClock(1 / 60);
  hands: Hands | undefined;
  ended = false;

  constructor(broadcast: Broadcast.Consumer) {
    this.broadcast = broadcast;
  }

  start(): void {
    this.#follow("catalog", 0, async (group) => {
      const frame = await group.readFrame();
      if (frame) this.#read(readCatalog(checked(frame.payload)));
    });
    this.#follow("hands", 2, async (group) => {
      for (let frame = await group.readFrame(); frame && !this.ended; frame = await group.readFrame()) {
        this.hands = readHands(checked(frame.payload));
        const strongest = Math.max(0, ...this.hands.hands.map((hand) => Math.hypot(...hand.reaction)));
        plot.push(performance.now(), strongest, this.hands.loss);
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
        told(error);
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
            numbers.groups++;
            open.push({ group, read: one(group) });
            if (open.length > 2) open.shift()?.group.close();
          }
          // A model's track ends while its group is on the way.
          const late = new Promise((end) => setTimeout(end, LONGEST_GROUP));
          await Promise.race([late, Promise.all(open.map((one) => one.read))]);
        } catch (error) {
          told(error);
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
    title.textContent = catalog.name;
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
          this.#arrived(body, model, decoder.decode(checked(frame.payload)));
        }
      });
    };
    this.#model(body).then(begin, told);
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
          const whole = assembler.push(checked(frame.payload));
          sayBefore(`model: ${Math.round(100 * assembler.progress)} %`);
          if (!whole) continue;
          const surface = readSurface(whole);
          if (surface.model !== body.model) throw new WrongData("a surface is of another model");
          stop();
          if (made) return;
          made = new Model(surface, stage.largestTexture);
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
    if (recorded && recorded.length < MAX_RECORDED) recorded.push({ body: body.id, state });
    let watched = this.bodies.get(body.id);
    if (!watched) {
      watched = { body, model, drawn: new Drawn(body, model), playout: new Playout(body.every) };
      watched.drawn.show(state, state, 0);
      this.bodies.set(body.id, watched);
      stage.scene.add(watched.drawn.mesh);
      if (numbers.firstPicture === 0) numbers.firstPicture = performance.now() - numbers.began;
    }
    if (frozen === undefined) watched.playout.push(state);
  }

  #remove(id: number): void {
    const watched = this.bodies.get(id);
    if (!watched) return;
    stage.scene.remove(watched.drawn.mesh);
    watched.drawn.dispose();
    this.bodies.delete(id);
  }

  draw(now: number): void {
    const catalog = this.catalog;
    if (!catalog) return;
    for (const { body, drawn, playout } of this.bodies.values()) {
      const delay = body.every * catalog.step * 1000 + MARGIN;
      const tick = frozen ?? this.clock.tick(now, delay);
      const pair = tick === undefined ? undefined : playout.at(tick);
      if (pair) drawn.show(...pair);
    }
    stage.frame(
      catalog,
      [...this.bodies.values()].map((watched) => watched.drawn),
    );
    stage.showHands(this.hands?.hands ?? [], plot.strongest);
    if (this.bodies.size > 0) {
      const people = this.hands ? `${this.hands.people} in the session, ` : "";
      const wrong = numbers.wrong > 0 ? `, ${numbers.wrong} wrong: ${lastWrong}` : "";
      const bodies = this.bodies.size === 1 ? "1 body" : `${this.bodies.size} bodies`;
      say(`${people}${bodies}, ${(numbers.bytes / 1024).toFixed(0)} KiB${wrong}`);
    }
  }

  end(): void {
    this.ended = true;
    for (const { end } of this.wanted.values()) end();
    for (const id of [...this.bodies.keys()]) this.#remove(id);
    for (const model of this.models.values()) model.end();
    stage.showHands([], 0);
  }
}

function checked(payload: Uint8Array): Uint8Array {
  if (payload.length > MAX_FRAME) throw new WrongData("a frame is too long");
  numbers.frames++;
  numbers.bytes += payload.length;
  return payload;
}

let lastWrong = "";
const wrongs = new Set<string>();
function told(error: unknown): void {
  const found = error instanceof Error ? error.message : String(error);
  // A track or a group that was closed is no fault. Wrong data are counted and named, and the page
  // goes on. The library has limits of its own for a frame and a group.
  const tooLong = found.includes("exceeds max size");
  const flood = error instanceof Group.Lagged;
  if (!(error instanceof WrongData) && !tooLong && !flood) {
    console.debug(`not read: ${found}`);
    return;
  }
  numbers.wrong++;
  lastWrong = tooLong ? "a frame is too long" : flood ? "a group comes faster than it is read" : found;
  if (wrongs.size < MAX_WRONGS) wrongs.add(lastWrong);
  sayBefore(`The session sends what this page does not take: ${lastWrong}`);
}

// For measurements: what was decoded, and a tick to hold the picture at.
let recorded: { body: number; state: State }[] | undefined;
let frozen: number | undefined;

const found = (body: number, tick: number) => {
  const one = recorded?.find((one) => one.body === body && one.state.tick === tick);
  const watched = session?.bodies.get(body);
  return one && watched ? { state: one.state, watched } : undefined;
};

const hooks = {
  numbers,
  record: () => {
    recorded = [];
  },
  wrongs: () => [...wrongs],
  bodies: () => [...(session?.bodies.keys() ?? [])],
  ticks: (body: number) => recorded?.filter((one) => one.body === body).map((one) => one.state.tick),
  /**
   * How far the shape of a body at a decoded tick is from given positions of its vertices, m: root
   * mean square and largest of the vertices, and the largest movement of the given ones from rest.
   */
  compare: (body: number, tick: number, truth: ArrayLike<number>) => {
    const one = found(body, tick);
    if (!one) return undefined;
    const surface = one.watched.model.surface;
    const shape = shapeOf(surface, one.state.q, one.watched.body.warps);
    if (shape.length !== truth.length) return undefined;
    let [sum, most, moved] = [0, 0, 0];
    for (let i = 0; i < shape.length; i += 3) {
      const off = [0, 1, 2].map((axis) => shape[i + axis]! - truth[i + axis]!);
      const away = [0, 1, 2].map((axis) => truth[i + axis]! - surface.positions[i + axis]!);
      const distance = Math.hypot(...off);
      sum += distance * distance;
      most = Math.max(most, distance);
      moved = Math.max(moved, Math.hypot(...away));
    }
    return { rms: Math.sqrt(sum / (shape.length / 3)), most, moved };
  },
  /** Draws one decoded tick and stays there. */
  freeze: (tick: number) => {
    frozen = tick;
    for (const body of session?.bodies.keys() ?? []) {
      const one = found(body, tick);
      if (!one) continue;
      one.watched.playout = new Playout(one.watched.body.every);
      one.watched.playout.push(one.state);
    }
  },
};
Object.assign(window, { pliant: hooks });

function draw(now: number): void {
  requestAnimationFrame(draw);
  session?.draw(now);
  stage.draw();
  plot.draw(now);
}
requestAnimationFrame(draw);

function open(): void {
  const link = new URLSearchParams(location.hash.slice(1));
  const relay = link.get("relay");
  const path = link.get("session");
  if (!relay || !path) {
    say("This page needs a link to a session: #relay=URL&session=NAME");
    return;
  }
  let url: URL;
  try {
    url = new URL(relay);
  } catch {
    say("The link's relay is no URL.");
    return;
  }
  say("connecting");
  // Tries again for as long as the page is open, since relays and hosts start again.
  const delay = { initial: 500, multiplier: 2, max: 5000, timeout: 0 };
  const hashes = link.getAll("certificate").slice(0, 8).map((value) => ({ value }));
  const webtransport = hashes.length > 0 ? { serverCertificateHashes: hashes } : {};
  const connection = new Connection.Reload({ url, delay, webtransport, enabled: true });
  const broadcast = connection.announcedBroadcast(Path.from(path));
  const change = (active: Broadcast.Consumer | undefined) => {
    session?.end();
    session = undefined;
    if (!active) {
      say(connection.status.peek() === "connected" ? "waiting for the host" : "connecting to the relay");
      return;
    }
    session = new Session(active);
    session.start();
  };
  connection.status.subscribe((status) => {
    if (!session && status === "connected") say("waiting for the host");
  });
  broadcast.active.subscribe(change);
  const present = broadcast.active.peek();
  if (present && !session) change(present);
}

open();
addEventListener("hashchange", () => location.reload());
