// The page: opens the session of its link and draws it.
//
// The link's fragment says where: #relay=URL&session=PATH, and certificate=HASH for a relay with a
// certificate of its own. A fragment never reaches the web server, so a token in the relay's URL
// stays between watcher and relay.

import { Connection, Path } from "@moq/net";
import type { Broadcast } from "@moq/net";
import { shapeOf } from "./format";
import { HandsPlayout, Playout } from "./playout";
import { Plot } from "./plot";
import { Stage } from "./scene";
import { Notes, Session, type View } from "./session";

const byId = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;
const status = byId("status");
const title = byId("title");

function say(text: string): void {
  // Names and errors come from outside: they are text and never markup.
  status.textContent = text;
}

/** Without a stage nothing else is begun: no relay is asked for what is not shown. */
function staged(): Stage {
  try {
    return new Stage(byId<HTMLCanvasElement>("scene"));
  } catch (error) {
    say("This browser cannot draw the session: it has no WebGL 2, or WebGL is switched off.");
    throw error;
  }
}

const stage = staged();
const plot = new Plot(byId<HTMLCanvasElement>("plot"));

const view: View = {
  scene: stage.scene,
  largestTexture: stage.largestTexture,
  frame: (catalog, drawn) => stage.frame(catalog, drawn),
  showHands: (hands) => stage.showHands(hands, plot.strongest),
  heard: (hands) => {
    const strongest = Math.max(0, ...hands.hands.map((hand) => Math.hypot(...hand.reaction)));
    plot.push(performance.now(), strongest, hands.loss);
  },
  say,
  title: (text) => {
    title.textContent = text;
  },
};

const notes = new Notes();
let session: Session | undefined;

const found = (body: number, tick: number) => {
  const one = notes.recorded?.find((one) => one.body === body && one.state.tick === tick);
  const watched = session?.bodies.get(body);
  return one && watched ? { state: one.state, watched } : undefined;
};

// For measurements: what was decoded, and a tick to hold the picture at.
const hooks = {
  numbers: notes.numbers,
  record: () => {
    notes.recorded = [];
    notes.recordedHands = [];
  },
  wrongs: () => [...notes.wrongs],
  bodies: () => [...(session?.bodies.keys() ?? [])],
  ticks: (body: number) => notes.recorded?.filter((one) => one.body === body).map((one) => one.state.tick),
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
  /** A body's surface: corners of its triangles, the shape at a decoded tick, and where it is. */
  surface: (body: number, tick: number) => {
    const one = found(body, tick);
    if (!one) return undefined;
    const { model, body: entry } = one.watched;
    const shape = shapeOf(model.surface, one.state.q, entry.warps);
    const { position, orientation, scale } = entry;
    return { triangles: [...model.surface.triangles], shape: [...shape], position, orientation, scale };
  },
  /** What the graphics card draws of the bodies alone, and from where. */
  drawn: () => ({ ...stage.pixels(), ...stage.view() }),
  view: () => stage.view(),
  /** Draws one decoded tick and stays there. */
  freeze: (tick: number) => {
    notes.frozen = tick;
    if (session) session.handsPlayout = new HandsPlayout();
    for (const hands of notes.recordedHands) if (hands.tick <= tick) session?.handsPlayout.push(hands);
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
    session = new Session(active, view, notes);
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
