// Which state is drawn when: the same cases as the tests of pliant_stream's playout.rs.

import assert from "node:assert/strict";
import { test } from "node:test";
import { Playout, TickClock } from "../node_modules/.watch-test/playout.mjs";

const state = (tick, x, resting = false) => ({ tick, q: Float64Array.of(x), resting });
const drawn = (playout, tick) => {
  const [from, to, part] = playout.at(tick);
  return from.q[0] + (to.q[0] - from.q[0]) * part;
};

test("sleep, new counts of ticks, and floods", () => {
  const playout = new Playout(2);
  assert.equal(playout.at(0), undefined);
  playout.push(state(100, 1, true));
  playout.push(state(500, 2));
  assert.equal(drawn(playout, 400), 1, "a body that slept until just now does not glide");
  assert.equal(drawn(playout, 499), 1.5);
  playout.push(state(480, 9));
  assert.equal(playout.newest.tick, 500, "an old state is left out");
  assert.equal(drawn(playout, 1e9), 2);
  for (let tick = 501; tick < 5000; tick++) playout.push(state(tick, 0));
  // Of 4,500 the last 64 are there.
  assert.equal(playout.at(0)[0].tick, 4936);
  playout.push(state(7, 3));
  assert.equal(playout.newest.tick, 7, "a host that has started again counts from the beginning");
});

test("the clock follows the earliest arrivals", () => {
  const clock = new TickClock(1 / 60);
  assert.equal(clock.tick(0, 0), undefined);
  let seed = 1;
  for (let frame = 0; frame < 600; frame++) {
    seed = (seed * 48271) % 2147483647;
    const late = (30 * seed) / 2147483647;
    const now = 1000 + (frame * 1000) / 30 + late;
    clock.arrived(5000 + 2 * frame, now);
    if (frame < 60) continue;
    const due = 5000 + 2 * frame + (60 * (late - 73)) / 1000;
    assert.ok(Math.abs(clock.tick(now, 73) - due) < 0.5, `frame ${frame}`);
  }
  clock.arrived(7, 30_000);
  assert.ok(Math.abs(clock.tick(30_000, 0) - 7) < 1e-9);
});
