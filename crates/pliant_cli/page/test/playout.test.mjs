// Which state is drawn when: the same cases as the tests of pliant_stream's playout.rs.

import assert from "node:assert/strict";
import { test } from "node:test";
import { HandsPlayout, Playout, TickClock } from "../node_modules/.watch-test/playout.mjs";

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

test("hands go straight between two messages, and come and go at their own ticks", () => {
  const playout = new HandsPlayout();
  const hand = (user, x) => ({ body: 1, user, grab: 0, target: [x, 0, 0], reaction: [0, -x, 0] });
  const shown = (tick) => Object.fromEntries(playout.at(tick).map((one) => [one.user, one]));
  assert.deepEqual(playout.at(0), []);
  playout.push({ tick: 100, hands: [hand(1, 10), hand(2, 0)] });
  playout.push({ tick: 104, hands: [hand(1, 14), hand(3, 0)] });
  playout.push({ tick: 102, hands: [] });
  assert.deepEqual(playout.at(99), []);
  let now = shown(101);
  assert.deepEqual([now[1].target, now[1].reaction], [[11, 0, 0], [0, -11, 0]]);
  assert.deepEqual(Object.keys(now), ["1", "2"]);
  assert.deepEqual(Object.keys(shown(103.9)), ["1", "2"]);
  now = shown(104);
  assert.deepEqual(Object.keys(now), ["1", "3"]);
  assert.deepEqual(shown(1e9)[1].target, [14, 0, 0], "beyond the newest they stay");
  for (let tick = 105; tick < 1000; tick++) playout.push({ tick, hands: [] });
  assert.deepEqual(playout.at(900), [], "of many messages the last ones are there");
  playout.push({ tick: 3, hands: [hand(7, 1)] });
  assert.deepEqual(playout.at(3), [], "a message from before is left out");
  playout.push({ tick: 5000, hands: [] });
  playout.push({ tick: 3, hands: [hand(7, 1)] });
  assert.deepEqual(Object.keys(shown(3)), ["7"], "a host that has started again counts from the beginning");
});
