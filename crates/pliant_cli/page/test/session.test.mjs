// A session is followed as in the page, without a relay and without a picture: which tracks are
// asked for, what becomes of bodies and hands, and what the page says of them.

import assert from "node:assert/strict";
import { test } from "node:test";
import { Broadcast, Time } from "@moq/net";
import { Notes, Session } from "../node_modules/.watch-test/session.mjs";

const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

// The page's clock, which a test sets on so that it need not wait, or stops.
const clock = performance.now.bind(performance);
let skew = 0;
let stopped;
performance.now = () => (stopped ?? clock()) + skew;

async function until(what, so) {
  const began = clock();
  while (!so()) {
    assert.ok(clock() - began < 8000, `${what}: not within 8 s`);
    await sleep(5);
  }
}

/** Little-endian numbers, of these formats. */
function packed(...parts) {
  const out = [];
  for (const [kind, ...values] of parts) {
    for (const value of values) {
      if (kind === "text") out.push(...Buffer.from(value));
      else if (kind === "bytes") out.push(...value);
      else if (kind === "name") out.push(Buffer.from(value).length, ...Buffer.from(value));
      else if (kind === "u64") out.push(...new Uint8Array(BigUint64Array.of(BigInt(value)).buffer));
      else if (kind === "f64") out.push(...new Uint8Array(Float64Array.of(value).buffer));
      else if (kind === "f32") out.push(...new Uint8Array(Float32Array.of(value).buffer));
      else if (kind === "f24") out.push(...new Uint8Array(Float32Array.of(value).buffer).slice(1));
      else {
        const length = { u8: 1, u16: 2, u32: 4, tick: 6 }[kind];
        for (let k = 0; k < length; k++) out.push(Math.floor(value / 256 ** k) % 256);
      }
    }
  }
  return Uint8Array.from(out);
}

const MODEL = new Uint8Array(32).fill(7);
const OTHER = new Uint8Array(32).fill(8);
/** One triangle, which one coordinate moves. */
const surfaceOf = (model) =>
  packed(
    ["text", "PLWS"],
    ["u16", 1, 1],
    ["u32", 3, 1],
    ["bytes", model],
    ["f32", 1, 1e-3, 1e-3, 0, 0, 0, 1, 0, 0, 0, 1, 0],
    ["u32", 0, 1, 2],
    ["u16", ...new Array(18).fill(1)],
  );
const SURFACE = surfaceOf(MODEL);
const STEP = 1 / 60;
const BODY = {
  ...{ id: 1, name: "a body", model: MODEL, modes: 1, every: 2, warps: false, free: false },
  ...{ position: [0, 0, 0], orientation: [0, 0, 0, 1], scale: 1, color: [255, 0, 0, 255] },
};

function catalogOf(bodies, session = 1) {
  const each = bodies.flatMap((body) => [
    ["u16", body.id],
    ["name", body.name],
    ["bytes", body.model],
    ["u64", 0, body.surfaceBytes ?? SURFACE.length],
    ["u16", body.modes, body.every],
    ["u8", (body.warps ? 1 : 0) + (body.free ? 2 : 0)],
    ["f32", ...body.position, ...body.orientation, body.scale],
    ["u8", ...body.color],
  ]);
  const head = [["text", "PLWC"], ["u16", 1], ["u64", session], ["f64", STEP], ["name", "a session"]];
  return packed(...head, ["u16", bodies.length], ...each, ["u16", 0]);
}

/** A snapshot without coordinates. */
const frameOf = (tick, resting = false) => packed(["u8", resting ? 3 : 1], ["tick", tick], ["f32", 1], ["u16", 0]);

const handsOf = (tick, hands) =>
  packed(
    ["tick", tick],
    ["u16", 3],
    ["u8", 255],
    ["u32", 0, 0],
    ["u16", hands.length],
    ...hands.flatMap(({ user, target, reaction }) => [
      ["u16", 1, user, 0],
      ["f32", ...target],
      ["f24", ...reaction],
    ]),
  );

/** A host of which all tracks are asked for one by one, and a page that follows it. */
class Host {
  asked = [];
  tracks = new Map();
  said = [];
  framed = [];
  hands = [];
  notes = new Notes();
  #broadcast = new Broadcast.Producer();

  constructor() {
    const scene = { add: () => {}, remove: () => {} };
    this.view = {
      ...{ scene, largestTexture: 4096, title: () => {}, heard: () => {} },
      say: (text) => this.said.push(text),
      frame: (_, drawn) => this.framed.push([...drawn].length),
      showHands: (hands) => (this.hands = hands),
    };
    this.session = new Session(this.#broadcast.consume(), this.view, this.notes);
    void this.#serve();
    this.session.start();
  }

  async #serve() {
    for (let request = await this.#broadcast.requested(); request; request = await this.#broadcast.requested()) {
      const { name, priority } = request;
      const track = request.accept({ latencyMax: 60_000 });
      this.asked.push({ name, priority, at: clock() });
      this.tracks.set(name, track);
      // As a relay's line does: nobody reads it, so it is over.
      void track.unused().then(() => track.close());
      this.answer?.(name, track);
    }
  }

  times(name) {
    return this.asked.filter((one) => one.name === name).map((one) => one.at);
  }

  /** Writes a group of one frame, as soon as its track is asked for. */
  async write(name, payload) {
    await until(name, () => this.tracks.get(name)?.closed.peek() === undefined && this.tracks.has(name));
    this.tracks.get(name).writeFrame({ payload, timestamp: Time.Timestamp.now() });
  }

  /** A session with bodies that are seen. */
  async seen(bodies, tick = 100) {
    this.answer ??= (name, track) => {
      if (name.startsWith("surface/")) track.writeFrame({ payload: SURFACE, timestamp: Time.Timestamp.now() });
    };
    await this.write("catalog", catalogOf(bodies));
    for (const body of bodies) await this.write(`body/${body.id}`, frameOf(tick));
    await until("the bodies", () => this.session.bodies.size === bodies.length);
  }

  status(after = 0) {
    this.session.draw(performance.now() + after);
    return this.said.at(-1);
  }

  end() {
    this.session.end();
    this.#broadcast.close();
  }
}

const played = (name, run) =>
  test(name, { timeout: 30_000 }, async () => {
    const host = new Host();
    try {
      await run(host);
    } finally {
      skew = 0;
      stopped = undefined;
      host.end();
    }
  });

played("what is wanted most is served first, as in apps", async (host) => {
  await host.seen([BODY]);
  const found = Object.fromEntries(host.asked.map(({ name, priority }) => [name.split("/")[0], priority]));
  assert.deepEqual(found, { catalog: 3, body: 2, hands: 1, surface: 0 });
});

played("another place or color of a body is taken over, and asks for nothing anew", async (host) => {
  await host.seen([BODY]);
  const { drawn } = host.session.bodies.get(1);
  const half = Math.SQRT1_2;
  const moved = {
    ...{ ...BODY, name: "another name", position: [1, 2, 3], orientation: [0, half, 0, half], scale: 2 },
    color: [0, 255, 0, 51],
  };
  await host.write("catalog", catalogOf([moved]));
  await until("the other place", () => host.session.catalog.bodies[0].name === "another name");
  await sleep(700);
  host.session.draw(performance.now());
  assert.equal(host.times("body/1").length, 1, "the body's track is asked for once");
  assert.ok(host.session.bodies.get(1)?.drawn === drawn, "the same body is drawn");
  assert.equal(host.session.bodies.get(1).body.name, "another name");
  const { mesh } = drawn;
  assert.deepEqual(mesh.position.toArray(), [1, 2, 3]);
  assert.ok(Math.abs(mesh.quaternion.y - half) < 1e-6);
  assert.equal(mesh.scale.x, 2);
  assert.deepEqual(mesh.material.uniforms.color.value.toArray(), [0, 1, 0]);
  assert.ok(Math.abs(mesh.material.uniforms.opacity.value - 0.2) < 1e-6 && mesh.material.transparent);
  // What decoding or drawing leans on begins anew.
  await host.write("catalog", catalogOf([{ ...moved, warps: true }]));
  await until("the other body", () => host.session.bodies.get(1)?.drawn.mesh.material.uniforms.warps.value);
  const other = host.session.bodies.get(1).drawn;
  assert.deepEqual(other.mesh.position.toArray(), [1, 2, 3]);
  // Another session counts and draws anew, whatever its bodies are called.
  await host.write("catalog", catalogOf([{ ...moved, warps: true }], 2));
  await until("the body of the other session", () => (host.session.bodies.get(1)?.drawn ?? other) !== other);
});

played("a body that moved before its first frame is seen where it is", async (host) => {
  host.answer = (name, track) => {
    if (name.startsWith("surface/")) track.writeFrame({ payload: SURFACE, timestamp: Time.Timestamp.now() });
  };
  await host.write("catalog", catalogOf([BODY]));
  await until("the body's track", () => host.times("body/1").length === 1);
  await host.write("catalog", catalogOf([{ ...BODY, position: [5, 0, 0] }]));
  await until("the other place", () => host.session.catalog.bodies[0].position[0] === 5);
  await host.write("body/1", frameOf(100));
  await until("the body", () => host.session.bodies.size === 1);
  assert.equal(host.session.bodies.get(1).drawn.mesh.position.x, 5);
});

played("a surface that is cut off or wrong is asked for anew, later each time", async (host) => {
  const surface = `surface/${"07".repeat(32)}`;
  let tries = 0;
  host.answer = (name, track) => {
    if (name !== surface) return;
    tries++;
    const group = track.appendGroup();
    const write = (payload) => group.writeFrame({ payload, timestamp: Time.Timestamp.now() });
    if (tries === 1) {
      write(SURFACE.slice(0, 50));
      setTimeout(() => group.close(new Error("the stream was reset")), 20);
    } else if (tries === 2) {
      write(surfaceOf(OTHER));
    } else if (tries === 3) {
      track.close(new Error("the track was reset"));
    } else {
      write(SURFACE.slice(0, 50));
      write(SURFACE.slice(50));
      group.close();
    }
  };
  await host.write("catalog", catalogOf([BODY]));
  await host.write("body/1", frameOf(100));
  await until("the body", () => host.session.bodies.size === 1);
  const times = host.times(surface);
  const pauses = times.slice(1).map((at, k) => at - times[k]);
  assert.equal(pauses.length, 3, `${pauses}`);
  assert.ok(pauses[0] > 450 && pauses[1] > 950 && pauses[2] > 1900, `${pauses}`);
  assert.equal(host.notes.numbers.wrong, 1, "the surface of another model is told of");
  await sleep(700);
  assert.equal(host.times(surface).length, 4, "what has come is not asked for again");
});

played("a surface of a body that has gone is asked for no longer", async (host) => {
  const surface = `surface/${"07".repeat(32)}`;
  host.answer = (name, track) => {
    if (name === surface) track.appendGroup().close(new Error("the stream was reset"));
  };
  await host.write("catalog", catalogOf([BODY]));
  await until("a second try", () => host.times(surface).length === 2);
  await host.write("catalog", catalogOf([]));
  await sleep(2500);
  assert.equal(host.times(surface).length, 2);
  assert.equal(host.session.models.size, 0);
});

played("a surface that stands still is asked for anew", async (host) => {
  const surface = `surface/${"07".repeat(32)}`;
  let tries = 0;
  host.answer = (name, track) => {
    if (name !== surface) return;
    const group = track.appendGroup();
    const payload = ++tries === 1 ? SURFACE.slice(0, 50) : SURFACE;
    group.writeFrame({ payload, timestamp: Time.Timestamp.now() });
  };
  await host.write("catalog", catalogOf([BODY]));
  await until("a part of it", () => host.said.some((text) => text.startsWith("model: ")));
  await sleep(1500);
  assert.equal(tries, 1, "it may pause");
  skew = 31_000;
  await host.write("body/1", frameOf(100));
  await until("the body", () => host.session.bodies.size === 1);
  assert.equal(tries, 2);
});

played("a surface of any length beside it takes no other one's place", async (host) => {
  const surface = `surface/${"07".repeat(32)}`;
  let tries = 0;
  host.answer = (name, track) => {
    if (name !== surface) return;
    if (++tries === 1) track.appendGroup().close(new Error("the stream was reset"));
    else track.writeFrame({ payload: SURFACE, timestamp: Time.Timestamp.now() });
  };
  const huge = { ...BODY, id: 2, model: OTHER, surfaceBytes: 2n ** 64n - 1n };
  await host.write("catalog", catalogOf([BODY, huge]));
  await host.write("body/1", frameOf(100));
  await until("the body", () => host.session.bodies.size === 1);
});

played("a model that the graphics card cannot hold is told of, and not asked for again", async (host) => {
  const surface = `surface/${"07".repeat(32)}`;
  host.view.largestTexture = 1;
  host.answer = (name, track) => {
    if (name === surface) track.writeFrame({ payload: SURFACE, timestamp: Time.Timestamp.now() });
  };
  await host.write("catalog", catalogOf([BODY]));
  await until("a word", () => host.said.some((text) => text.includes("too large for this graphics card")));
  await sleep(1500);
  assert.equal(host.times(surface).length, 1);
});

played("a body's track that ends is asked for again, whatever hangs in it", async (host) => {
  await host.seen([BODY]);
  const track = host.tracks.get("body/1");
  track.appendGroup().writeFrame({ payload: frameOf(102), timestamp: Time.Timestamp.now() });
  await sleep(100);
  track.close();
  await until("the track", () => host.times("body/1").length === 2);
  await host.write("body/1", frameOf(104));
  await until("the frame", () => host.session.bodies.get(1).playout.newest.tick === 104);
});

played("the page says how old the newest picture is, unless the bodies rest", async (host) => {
  const hands = () => host.write("hands", handsOf(100, []));
  await host.seen([BODY, { ...BODY, id: 2 }]);
  stopped = clock();
  await hands();
  await until("the hands", () => host.session.hands);
  assert.match(host.status(), /^3 in the session, 2 bodies, \d+ KiB$/);
  assert.doesNotMatch(host.status(1500), /nothing new/);
  assert.match(host.status(7300), /, nothing new for 7 s/);
  skew = 7300;
  await host.write("body/1", frameOf(500));
  await until("a frame", () => host.session.bodies.get(1).playout.newest.tick === 500);
  assert.match(host.status(), /, nothing new of 1 body for 7 s/);
  // Both rest: then hands' messages tell that the host is there.
  for (const id of [1, 2]) {
    await host.write(`body/${id}`, frameOf(502, true));
    await until("the rest", () => host.session.bodies.get(id).playout.newest.resting);
  }
  skew += 6000;
  host.session.hands = undefined;
  await hands();
  await until("more hands", () => host.session.hands);
  assert.doesNotMatch(host.status(1000), /nothing new/);
  assert.match(host.status(5100), /, nothing new for 5 s/);
});

played("hands are shown at the tick that the bodies are shown at", async (host) => {
  await host.seen([BODY]);
  // Everything arrives at once, so that the clock is at tick 100 now.
  const now = performance.now();
  for (const tick of [100, 102, 104, 106]) {
    const hand = { user: 4, target: [tick, 0, 0], reaction: [0, 2 * tick, 0] };
    await host.write("hands", handsOf(tick, tick === 106 ? [hand, { ...hand, user: 5 }] : [hand]));
  }
  await until("the hands", () => host.notes.numbers.frames >= 7);
  await sleep(50);
  const at = (tick) => {
    // Newer ticks have arrived since, so the clock is ahead: ask it, as bodies do.
    const behind = 2 * STEP * 1000 + 40;
    const first = host.session.clock.tick(now, behind);
    host.session.draw(now + (tick - first) * STEP * 1000);
    return Object.fromEntries(host.hands.map((hand) => [hand.user, hand]));
  };
  const between = at(103);
  assert.ok(Math.abs(between[4].target[0] - 103) < 0.01, `${between[4].target}`);
  assert.ok(Math.abs(between[4].reaction[1] - 206) < 0.02, `${between[4].reaction}`);
  assert.equal(between[5], undefined, "a hand that has not come yet");
  assert.equal(at(105.9)[5], undefined, "nor a moment before it");
  assert.equal(at(106.1)[5].target[0], 106);
});

played("the view waits for the bodies that the catalog names, and looks anew at another session", async (host) => {
  const second = { ...BODY, id: 2 };
  host.answer = (name, track) => {
    if (name.startsWith("surface/")) track.writeFrame({ payload: SURFACE, timestamp: Time.Timestamp.now() });
  };
  await host.write("catalog", catalogOf([BODY, second]));
  await host.write("body/1", frameOf(100));
  await until("a body", () => host.session.bodies.size === 1);
  for (let k = 0; k < 3; k++) host.status();
  assert.deepEqual(host.framed, [1], "something is seen at once");
  await host.write("body/2", frameOf(100));
  await until("both", () => host.session.bodies.size === 2);
  for (let k = 0; k < 3; k++) host.status(10 * k);
  assert.deepEqual(host.framed, [1, 2]);
  // A body that comes later moves no camera.
  await host.write("catalog", catalogOf([BODY, second, { ...BODY, id: 3 }]));
  await host.write("body/3", frameOf(102));
  await until("all three", () => host.session.bodies.size === 3);
  host.status(5000);
  assert.deepEqual(host.framed, [1, 2]);
  // Another session; of its two bodies one never comes.
  await host.write("catalog", catalogOf([BODY, { ...second, id: 4 }], 2));
  await until("the other session", () => host.session.catalog.session === 2n && host.session.bodies.size === 1);
  for (const after of [0, 500, 1100, 1200]) host.status(after);
  assert.deepEqual(host.framed, [1, 2, 1, 1]);
});
