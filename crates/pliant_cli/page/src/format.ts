// The formats of pliant_stream::watch, as a page reads them. What arrives is not to be trusted:
// every length, range and number is checked, and nothing is allocated beyond the bytes given.

/** Version of the formats. */
export const VERSION = 1;
/** Largest frame that is read, bytes. */
export const MAX_FRAME = 1 << 18;
/** Most frames of one group of a body. */
export const MAX_GROUP_FRAMES = 1 << 10;
/** Largest surface, bytes. */
export const MAX_SURFACE = 30 << 20;

const MAX_MODES = 4096;
const MAX_BODIES = 4096;
const MAX_CAMERAS = 64;
const MAX_HANDS = 1024;
const LIMIT = 1e9;
const LARGEST = 2 ** 30 - 1;
const TICK_LIMIT = 2 ** 48;

/** What arrived is wrong. */
export class WrongData extends Error {}

function check(inside: boolean, what: string): void {
  if (!inside) throw new WrongData(what);
}

/** Reads little-endian numbers. */
class Reader {
  #view: DataView;
  #at = 0;

  constructor(bytes: Uint8Array) {
    this.#view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  }

  get left(): number {
    return this.#view.byteLength - this.#at;
  }

  #step(count: number, what: string): number {
    check(count <= this.left, `${what} is cut off`);
    this.#at += count;
    return this.#at - count;
  }

  take(count: number, what: string): Uint8Array {
    const at = this.#step(count, what);
    return new Uint8Array(this.#view.buffer, this.#view.byteOffset + at, count);
  }

  u8(what: string): number {
    return this.#view.getUint8(this.#step(1, what));
  }

  u16(what: string): number {
    return this.#view.getUint16(this.#step(2, what), true);
  }

  i16(what: string): number {
    return this.#view.getInt16(this.#step(2, what), true);
  }

  u32(what: string): number {
    return this.#view.getUint32(this.#step(4, what), true);
  }

  u64(what: string): bigint {
    return this.#view.getBigUint64(this.#step(8, what), true);
  }

  f64(what: string): number {
    return this.#view.getFloat64(this.#step(8, what), true);
  }

  f32(what: string): number {
    const x = this.#view.getFloat32(this.#step(4, what), true);
    check(Math.abs(x) <= LIMIT, `${what} is out of range`);
    return x;
  }

  /** A number in the upper 3 bytes of an f32. */
  f24(what: string): number {
    const high = this.take(3, what);
    const bytes = new DataView(new Uint8Array([0, high[0]!, high[1]!, high[2]!]).buffer);
    const x = bytes.getFloat32(0, true);
    check(Math.abs(x) <= LIMIT, `${what} is out of range`);
    return x;
  }

  tick(what: string): number {
    const low = this.u32(what);
    return low + this.u16(what) * 2 ** 32;
  }

  vector(what: string): Vector {
    return [this.f32(what), this.f32(what), this.f32(what)];
  }

  name(): string {
    const length = this.u8("a name");
    check(length <= 64, "a name is too long");
    try {
      return new TextDecoder("utf-8", { fatal: true }).decode(this.take(length, "a name"));
    } catch {
      throw new WrongData("a name is no text");
    }
  }

  finish(what: string): void {
    check(this.left === 0, `${what} has bytes too many`);
  }
}

/** Reads whole numbers of some bits, the least significant bit first. */
class Bits {
  #from: Reader;
  #pending = 0;
  #count = 0;

  constructor(from: Reader) {
    this.#from = from;
  }

  // Sums below 2^40 are exact, where shifts would end at 32 bits.
  take(bits: number): number {
    while (this.#count < bits) {
      this.#pending += this.#from.u8("a frame") * 2 ** this.#count;
      this.#count += 8;
    }
    const size = 2 ** bits;
    const x = this.#pending % size;
    this.#pending = Math.floor(this.#pending / size);
    this.#count -= bits;
    return x;
  }

  signed(bits: number): number {
    if (bits === 0) return 0;
    const x = this.take(bits);
    return x < 2 ** (bits - 1) ? x : x - 2 ** bits;
  }

  finish(): void {
    check(this.#pending === 0, "a frame has bits too many");
  }
}

export type Vector = [number, number, number];

export interface CatalogBody {
  id: number;
  name: string;
  /** Hash of the model, 64 hexadecimal digits. */
  model: string;
  surfaceBytes: number;
  modes: number;
  every: number;
  warps: boolean;
  free: boolean;
  position: Vector;
  orientation: [number, number, number, number];
  scale: number;
  color: [number, number, number, number];
}

export interface Camera {
  eye: Vector;
  at: Vector;
  fieldOfView: number;
}

export interface Catalog {
  session: bigint;
  step: number;
  name: string;
  bodies: CatalogBody[];
  cameras: Camera[];
}

const hex = (bytes: Uint8Array) => Array.from(bytes, (b) => b.toString(16).padStart(2, "0")).join("");

function readMagic(r: Reader, magic: string): void {
  const found = String.fromCharCode(...r.take(4, "the data"));
  check(found === magic, "the data are of another kind");
  check(r.u16("a version") === VERSION, "the host has another version");
}

export function readCatalog(bytes: Uint8Array): Catalog {
  const r = new Reader(bytes);
  readMagic(r, "PLWC");
  const session = r.u64("the catalog");
  const step = r.f64("the step");
  check(step >= 1e-6 && step <= 10, "the step is out of range");
  const name = r.name();
  const count = r.u16("the catalog");
  check(count <= MAX_BODIES, "the catalog has too many bodies");
  const bodies: CatalogBody[] = [];
  const seen = new Set<number>();
  for (let k = 0; k < count; k++) {
    const body = readBody(r);
    check(!seen.has(body.id), "the catalog has a body twice");
    seen.add(body.id);
    bodies.push(body);
  }
  const views = r.u16("the catalog");
  check(views <= MAX_CAMERAS, "the catalog has too many cameras");
  const cameras: Camera[] = [];
  for (let k = 0; k < views; k++) {
    const camera = { eye: r.vector("a camera"), at: r.vector("a camera"), fieldOfView: r.f32("a camera") };
    check(camera.fieldOfView > 0 && camera.fieldOfView < Math.PI, "a camera is out of range");
    cameras.push(camera);
  }
  r.finish("the catalog");
  return { session, step, name, bodies, cameras };
}

function readBody(r: Reader): CatalogBody {
  const id = r.u16("a body");
  const name = r.name();
  const model = hex(r.take(32, "a model"));
  r.u64("a model");
  const surfaceBytes = Number(r.u64("a surface"));
  const modes = r.u16("a body");
  check(modes <= MAX_MODES, "a body has too many coordinates");
  const every = r.u16("a body");
  check(every > 0, "a body has no ticks");
  const flags = r.u8("a body");
  check(flags < 4, "a body has unknown flags");
  const position = r.vector("a place");
  const orientation: [number, number, number, number] = [...r.vector("a place"), r.f32("a place")];
  const scale = r.f32("a place");
  const numbers = [...position, ...orientation, scale];
  const length = orientation.reduce((sum, x) => sum + x * x, 0);
  const near = numbers.every((x) => Math.abs(x) < 1e6) && Math.abs(length - 1) < 1e-3;
  check(near && scale > 1e-6, "a place is out of range");
  const color = Array.from(r.take(4, "a color")) as [number, number, number, number];
  const [warps, free] = [(flags & 1) !== 0, (flags & 2) !== 0];
  return { id, name, model, surfaceBytes, modes, every, warps, free, position, orientation, scale, color };
}

/** The surface of a model and its modes. */
export interface Surface {
  model: string;
  modes: number;
  /** The value in each coordinate of one meter of displacement. */
  places: Float32Array;
  positions: Float32Array;
  triangles: Uint32Array;
  /** Rows of displacement and rotation, [mode][vertex][axis]. */
  displacement: Float32Array;
  rotation: Float32Array;
}

export function readSurface(bytes: Uint8Array): Surface {
  const r = new Reader(bytes);
  readMagic(r, "PLWS");
  const modes = r.u16("a surface");
  const [vertices, triangles] = [r.u32("a surface"), r.u32("a surface")];
  const model = hex(r.take(32, "a surface"));
  // Products of these counts are below 2^53, and the bytes are there before memory is taken.
  const length = 12 * (modes + vertices + triangles + vertices * modes);
  check(modes <= MAX_MODES && bytes.length <= MAX_SURFACE && r.left === length, "a surface has another length");
  const floats = (count: number) => Float32Array.from({ length: count }, () => r.f32("a surface"));
  const places = floats(modes);
  check(
    places.every((x) => x > 0),
    "a surface has a coordinate without a place",
  );
  const scales = floats(2 * modes);
  const positions = floats(3 * vertices);
  const corners = new Uint32Array(3 * triangles);
  for (let k = 0; k < corners.length; k++) {
    corners[k] = r.u32("a triangle");
    check(corners[k]! < vertices, "a triangle names a missing vertex");
  }
  const rows = (which: number) => {
    const out = new Float32Array(3 * vertices * modes);
    for (let k = 0; k < out.length; k++) {
      const mode = Math.floor(k / (3 * vertices));
      out[k] = r.i16("a surface") * scales[2 * mode + which]!;
    }
    return out;
  };
  const displacement = rows(0);
  return { model, modes, places, positions, triangles: corners, displacement, rotation: rows(1) };
}

/** Puts pieces together. Memory grows with what arrives, up to what the catalog said. */
export class Assembler {
  #bytes: Uint8Array[] = [];
  #length = 0;
  #expected: number;

  constructor(expected: number) {
    check(expected > 0 && expected <= MAX_SURFACE, "a surface is too large");
    this.#expected = expected;
  }

  push(piece: Uint8Array): Uint8Array | undefined {
    check(piece.length > 0 && piece.length <= this.#expected - this.#length, "a surface has pieces too many");
    this.#bytes.push(piece);
    this.#length += piece.length;
    if (this.#length < this.#expected) return undefined;
    const all = new Uint8Array(this.#length);
    let at = 0;
    for (const one of this.#bytes) {
      all.set(one, at);
      at += one.length;
    }
    return all;
  }

  get progress(): number {
    return this.#length / this.#expected;
  }
}

const clamped = (x: number) => Math.min(Math.max(x, -LARGEST), LARGEST);

/** The past of one number: see residual.rs of pliant_stream, which this follows. */
class Past {
  a: number;
  b: number;
  c: number;
  errors: [number, number, number];

  constructor(value: number, before: number, level: number) {
    const error = level === 0 ? 0 : 2 ** (level + 2);
    [this.a, this.b, this.c] = [value, before, clamped(2 * before - value)];
    this.errors = [2 * error, error, 2 * error];
  }

  read(bits: Bits): number {
    const { a, b, c, errors } = this;
    const predictions = [a, clamped(2 * a - b), clamped(3 * a - 3 * b + c)];
    let best = 0;
    for (let k = 1; k < 3; k++) if (errors[k]! < errors[best]!) best = k;
    let scaled = Math.floor((errors[best]! * 11) / 64);
    let parameter = 0;
    while (scaled >= 2) {
      scaled = Math.floor(scaled / 2);
      parameter++;
    }
    parameter = Math.min(parameter, 30);
    let quotient = 0;
    while (quotient < 20 && bits.take(1) === 1) quotient++;
    const zigzag = quotient < 20 ? quotient * 2 ** parameter + bits.take(parameter) : bits.take(32);
    const residual = zigzag % 2 === 0 ? zigzag / 2 : -(zigzag + 1) / 2;
    const value = predictions[best]! + residual;
    check(Math.abs(value) <= LARGEST, "a coordinate is out of range");
    for (let k = 0; k < 3; k++) {
      errors[k] = errors[k]! + Math.abs(value - predictions[k]!) - Math.floor(errors[k]! / 8);
    }
    [this.a, this.b, this.c] = [value, a, b];
    return value;
  }
}

/** What a watcher sees of a body at a tick. */
export interface State {
  tick: number;
  q: Float64Array;
  position?: Vector;
  rotation?: [number, number, number, number];
  resting: boolean;
}

/** Reads the frames of a body. A wrong frame ends its group. */
export class BodyDecoder {
  #places: Float32Array;
  #unit = 0;
  #turn = 0;
  #modes = 0;
  #past: Past[] = [];
  #frames = 0;
  #tick = 0;

  constructor(places: Float32Array) {
    this.#places = places;
  }

  decode(frame: Uint8Array): State {
    try {
      check(frame.length <= MAX_FRAME, "a frame is too long");
      const r = new Reader(frame);
      const head = r.u8("a frame");
      if ((head & 1) !== 0) this.#snapshot(head, r);
      else this.#difference(head, r);
      r.finish("a frame");
      return this.#state((head & 2) !== 0);
    } catch (error) {
      this.#frames = 0;
      this.#past = [];
      throw error;
    }
  }

  #snapshot(head: number, r: Reader): void {
    check(head < 8, "a frame has unknown flags");
    const tick = r.tick("a frame");
    const unit = r.f32("a unit");
    const turn = (head & 4) !== 0 ? r.f32("a unit") : 1;
    check(unit > 0 && turn > 0, "a unit is not above 0");
    const modes = r.u16("a frame");
    check(modes <= this.#places.length, "a frame has too many coordinates");
    const bits = new Bits(r);
    this.#past = [];
    for (let k = 0; k < modes + ((head & 4) !== 0 ? 7 : 0); k++) {
      const level = bits.take(5);
      const [wide, wideStep] = [bits.take(5), bits.take(5)];
      const [value, step] = [bits.signed(wide), bits.signed(wideStep)];
      check(Math.abs(value) <= LARGEST && Math.abs(step) <= LARGEST, "a coordinate is out of range");
      this.#past.push(new Past(value, clamped(value - step), level));
    }
    bits.finish();
    [this.#unit, this.#turn, this.#modes, this.#frames, this.#tick] = [unit, turn, modes, 1, tick];
  }

  #difference(head: number, r: Reader): void {
    check(this.#frames > 0, "a frame came without its snapshot");
    check(this.#frames < MAX_GROUP_FRAMES, "a group does not end");
    const few = head >> 2;
    const ticks = few > 0 ? few : r.u16("a frame");
    check(ticks > 0 && this.#tick + ticks < TICK_LIMIT, "ticks do not ascend");
    const bits = new Bits(r);
    for (const past of this.#past) past.read(bits);
    bits.finish();
    this.#frames++;
    this.#tick += ticks;
  }

  #state(resting: boolean): State {
    const q = new Float64Array(this.#modes);
    for (let k = 0; k < q.length; k++) q[k] = this.#past[k]!.a * this.#unit * this.#places[k]!;
    const state: State = { tick: this.#tick, q, resting };
    if (this.#past.length > this.#modes) {
      const pose = this.#past.slice(this.#modes).map((past) => past.a);
      const position = pose.slice(0, 3).map((x) => x * this.#unit) as Vector;
      const turned = pose.slice(3).map((x) => x * this.#turn);
      // Added in the order of pliant_stream, so that the result is the same.
      const norm = Math.sqrt(turned.reduce((sum, x) => sum + x * x, 0));
      check(norm >= 0.5 && norm < 2, "a rotation is none");
      check(
        position.every((x) => Math.abs(x) <= LIMIT),
        "a position is out of range",
      );
      state.position = position;
      state.rotation = turned.map((x) => x / norm) as [number, number, number, number];
    }
    check(
      q.every((x) => Math.abs(x) <= LIMIT),
      "a coordinate is out of range",
    );
    return state;
  }
}

export interface Hand {
  body: number;
  user: number;
  grab: number;
  target: Vector;
  reaction: Vector;
}

/** Hands and numbers of the session. */
export interface Hands {
  tick: number;
  people: number;
  loss: number | undefined;
  roundTrip: number;
  dropped: number;
  hands: Hand[];
}

export function readHands(bytes: Uint8Array): Hands {
  const r = new Reader(bytes);
  const tick = r.tick("hands");
  const people = r.u16("hands");
  const loss = r.u8("hands");
  const [roundTrip, dropped] = [r.u32("hands") * 1e-6, r.u32("hands")];
  const count = r.u16("hands");
  check(count <= MAX_HANDS, "there are too many hands");
  const hands: Hand[] = [];
  for (let k = 0; k < count; k++) {
    const [body, user, grab] = [r.u16("a hand"), r.u16("a hand"), r.u16("a hand")];
    const target = r.vector("a hand");
    const reaction: Vector = [r.f24("a hand"), r.f24("a hand"), r.f24("a hand")];
    hands.push({ body, user, grab, target, reaction });
  }
  r.finish("hands");
  return { tick, people, loss: loss === 255 ? undefined : loss / 254, roundTrip, dropped, hands };
}

/** Positions of the vertices at coordinates `q`, m, body axes: what the vertex shader computes. */
export function shapeOf(surface: Surface, q: Float64Array, warps: boolean): Float64Array {
  const rows = surface.positions.length;
  const [moved, turned] = [new Float64Array(rows), new Float64Array(rows)];
  for (let k = 0; k < Math.min(q.length, surface.modes); k++) {
    for (let i = 0; i < rows; i++) {
      moved[i] = moved[i]! + q[k]! * surface.displacement[k * rows + i]!;
      turned[i] = turned[i]! + q[k]! * surface.rotation[k * rows + i]!;
    }
  }
  const out = new Float64Array(rows);
  for (let i = 0; i < rows; i += 3) {
    let u: Vector = [moved[i]!, moved[i + 1]!, moved[i + 2]!];
    if (warps) u = warp([turned[i]!, turned[i + 1]!, turned[i + 2]!], u);
    for (let axis = 0; axis < 3; axis++) out[i + axis] = surface.positions[i + axis]! + u[axis]!;
  }
  return out;
}

const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];

/** Modal warping (Choi and Ko 2005): the integral of the rotation from 0 to `w`, of `d`. */
function warp(w: Vector, d: Vector): Vector {
  const s = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
  const t = Math.sqrt(s);
  const [a, b] =
    s < 0.01
      ? [1 / 2 - s / 24 + (s * s) / 720, 1 / 6 - s / 120 + (s * s) / 5040]
      : [(1 - Math.cos(t)) / s, (t - Math.sin(t)) / (s * t)];
  const c = cross(w, d);
  const e = cross(w, c);
  return [d[0] + a * c[0] + b * e[0], d[1] + a * c[1] + b * e[1], d[2] + a * c[2] + b * e[2]];
}
