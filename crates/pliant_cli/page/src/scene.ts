// Draws bodies, hands and forces. The vertex shader sums the modes, so a frame of a body uploads
// its coordinates and nothing else.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Camera, Catalog, CatalogBody, Hand, State, Surface } from "./format";
import { WrongData } from "./format";
import { keyOf } from "./playout";

const VERTEX = /* glsl */ `
precision highp float;
precision highp sampler2D;
uniform sampler2D displacement;
uniform sampler2D rotation;
uniform sampler2D coordinates;
uniform int modes;
uniform int vertices;
uniform int across;
uniform bool warps;
out vec3 toEye;
out vec3 shaded;

void main() {
  vec3 d = vec3(0.0);
  vec3 w = vec3(0.0);
  for (int k = 0; k < modes; k++) {
    float q = texelFetch(coordinates, ivec2(k, 0), 0).r;
    int index = k * vertices + gl_VertexID;
    ivec2 at = ivec2(index % across, index / across);
    d += q * texelFetch(displacement, at, 0).xyz;
    w += q * texelFetch(rotation, at, 0).xyz;
  }
  // Modal warping (Choi and Ko 2005).
  float s = dot(w, w);
  float t = sqrt(s);
  bool small = s < 0.01;
  float a = small ? 0.5 - s / 24.0 + s * s / 720.0 : (1.0 - cos(t)) / s;
  float b = small ? 1.0 / 6.0 - s / 120.0 + s * s / 5040.0 : (t - sin(t)) / (s * t);
  float c = small ? 1.0 - s / 6.0 + s * s / 120.0 : sin(t) / t;
  vec3 bent = warps ? d + a * cross(w, d) + b * cross(w, cross(w, d)) : d;
  // The normal at rest, turned as the surface turns here.
  vec3 turned = normal + c * cross(w, normal) + a * cross(w, cross(w, normal));
  vec4 seen = modelViewMatrix * vec4(position + bent, 1.0);
  toEye = -seen.xyz;
  shaded = normalMatrix * turned;
  gl_Position = projectionMatrix * seen;
}
`;

const FRAGMENT = /* glsl */ `
precision highp float;
uniform vec3 color;
uniform float opacity;
in vec3 toEye;
in vec3 shaded;
out vec4 drawn;

void main() {
  vec3 eye = normalize(toEye);
  vec3 n = normalize(shaded);
  if (dot(n, eye) < 0.0) n = -n;
  vec3 key = normalize(vec3(0.4, 0.8, 0.6));
  float light = 0.35 + 0.65 * max(dot(n, key), 0.0);
  float shine = pow(max(dot(n, normalize(key + eye)), 0.0), 40.0);
  vec3 lit = color * light + 0.18 * shine;
  // From linear light to what screens show.
  drawn = vec4(pow(lit, vec3(1.0 / 2.2)), opacity);
}
`;

/** A texture of whole rows, for texelFetch. */
function texture(values: Float32Array, channels: 1 | 4, across: number): THREE.DataTexture {
  const count = values.length / channels;
  const down = Math.max(1, Math.ceil(count / across));
  const data = new Float32Array(across * down * channels);
  data.set(values);
  const format = channels === 4 ? THREE.RGBAFormat : THREE.RedFormat;
  const made = new THREE.DataTexture(data, across, down, format, THREE.FloatType);
  made.needsUpdate = true;
  return made;
}

function widened(rows: Float32Array): Float32Array {
  const out = new Float32Array((rows.length / 3) * 4);
  for (let k = 0, at = 0; k < rows.length; k += 3, at += 4) out.set(rows.subarray(k, k + 3), at);
  return out;
}

const TOO_LARGE = "a model is too large for this graphics card";

/** A model on the graphics card, for all of its bodies. */
export class Model {
  readonly surface: Surface;
  readonly geometry = new THREE.BufferGeometry();
  readonly across: number;
  readonly displacement: THREE.DataTexture;
  readonly rotation: THREE.DataTexture;

  constructor(surface: Surface, largest: number) {
    this.surface = surface;
    const rows = (surface.modes * surface.positions.length) / 3;
    this.across = Math.max(1, Math.min(4096, largest, rows));
    if (Math.ceil(rows / this.across) > largest) throw new WrongData(TOO_LARGE);
    this.displacement = texture(widened(surface.displacement), 4, this.across);
    this.rotation = texture(widened(surface.rotation), 4, this.across);
    this.geometry.setAttribute("position", new THREE.BufferAttribute(surface.positions, 3));
    this.geometry.setIndex(new THREE.BufferAttribute(surface.triangles, 1));
    this.geometry.computeVertexNormals();
  }

  dispose(): void {
    this.geometry.dispose();
    this.displacement.dispose();
    this.rotation.dispose();
  }
}

/** A body that is drawn. */
export class Drawn {
  readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.RawShaderMaterial | THREE.ShaderMaterial>;
  #coordinates: THREE.DataTexture;
  #values: Float32Array;
  #body: CatalogBody;
  /** Where a body with poses in its frames was drawn last, in its own meters. */
  #pose: { position: THREE.Vector3; turned: THREE.Quaternion } | undefined;

  constructor(body: CatalogBody, model: Model) {
    this.#body = body;
    this.#values = new Float32Array(Math.max(1, model.surface.modes));
    this.#coordinates = texture(this.#values, 1, this.#values.length);
    const material = new THREE.ShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: THREE.DoubleSide,
      uniforms: {
        displacement: { value: model.displacement },
        rotation: { value: model.rotation },
        coordinates: { value: this.#coordinates },
        modes: { value: model.surface.modes },
        vertices: { value: model.surface.positions.length / 3 },
        across: { value: model.across },
        warps: { value: body.warps },
        color: { value: new THREE.Color() },
        opacity: { value: 1 },
      },
    });
    this.mesh = new THREE.Mesh(model.geometry, material);
    // The shader moves the vertices, so the bounds at rest say nothing.
    this.mesh.frustumCulled = false;
    this.place(body);
  }

  /** Takes over where the body is, how large it is, and its color. */
  place(body: CatalogBody): void {
    this.#body = body;
    this.mesh.position.set(...body.position);
    this.mesh.quaternion.set(...body.orientation);
    this.mesh.scale.setScalar(body.scale);
    this.#take();
    const [r, g, b, a] = body.color;
    const { material } = this.mesh;
    material.uniforms.color!.value.setRGB(r / 255, g / 255, b / 255, THREE.SRGBColorSpace);
    material.uniforms.opacity!.value = a / 255;
    if (material.transparent === a < 255) return;
    material.transparent = a < 255;
    material.needsUpdate = true;
  }

  /** Draws the body between two states, `part` of the way from the first to the second. */
  show(from: State, to: State, part: number): void {
    const data = this.#coordinates.image.data as Float32Array;
    for (let k = 0; k < data.length; k++) {
      const [a, b] = [from.q[k] ?? 0, to.q[k] ?? 0];
      data[k] = a + (b - a) * part;
    }
    this.#coordinates.needsUpdate = true;
    if (from.position && to.position && from.rotation && to.rotation) {
      const position = new THREE.Vector3(...from.position).lerp(new THREE.Vector3(...to.position), part);
      const turned = new THREE.Quaternion(...from.rotation);
      turned.slerp(new THREE.Quaternion(...to.rotation), part);
      this.#pose = { position, turned };
      this.#take();
    }
  }

  /**
   * A body with poses in its frames is where these say, and not where the catalog does: a free one,
   * and an anchored one that is moved.
   */
  #take(): void {
    if (!this.#pose) return;
    this.mesh.position.copy(this.#pose.position).multiplyScalar(this.#body.scale);
    this.mesh.quaternion.copy(this.#pose.turned);
  }

  dispose(): void {
    this.mesh.material.dispose();
    this.#coordinates.dispose();
  }
}

/** The color of a user: as in the apps, a golden angle apart. */
export function colorOf(user: number): THREE.Color {
  return new THREE.Color().setHSL(((200 + 137.50776 * user) % 360) / 360, 0.7, 0.55);
}

/** Angle of view in the smaller of the picture's two directions, where the host gives none, rad. */
const FIELD_OF_VIEW = Math.PI / 4;
/** Room around the bodies, as a share of their distance: they move out of their bounds at rest. */
const ROOM = 1.1;

/** The camera, and from where it looks until somebody moves it. */
export class Eye {
  readonly camera = new THREE.PerspectiveCamera(45, 1, 0.001, 1000);
  readonly target = new THREE.Vector3();
  /** Somebody has moved the camera: it is theirs from then on. */
  touched = false;
  /** Length of the diagonal of all bodies, m. */
  size = 1;
  #fieldOfView = FIELD_OF_VIEW;

  constructor() {
    this.camera.position.set(0.3, 0.25, 0.5);
  }

  /**
   * Takes over the size of the picture. The angle of view is that of its smaller side, so what is
   * seen on a wide screen is seen on a phone, too, however it is turned.
   */
  resize(wide: number, high: number): void {
    const { camera } = this;
    // A picture without a size is one that is not seen.
    camera.aspect = wide > 0 && high > 0 ? wide / high : 1;
    const half = Math.tan(this.#fieldOfView / 2) / Math.min(1, camera.aspect);
    camera.fov = (2 * Math.atan(half) * 180) / Math.PI;
    camera.updateProjectionMatrix();
  }

  /** Looks from a camera of the host, or so that all bodies are in the picture. */
  frame(bounds: THREE.Box3, view: Camera | undefined): void {
    if (bounds.isEmpty()) return;
    this.size = Math.max(bounds.getSize(new THREE.Vector3()).length(), 1e-6);
    this.camera.near = this.size / 200;
    this.camera.far = this.size * 200;
    if (!this.touched) {
      this.#fieldOfView = view?.fieldOfView ?? FIELD_OF_VIEW;
      if (view) {
        this.camera.position.set(...view.eye);
        this.target.set(...view.at);
      } else {
        // The ball around all bodies touches the edges of the picture, but for the room.
        bounds.getCenter(this.target);
        const away = (ROOM * this.size) / 2 / Math.sin(FIELD_OF_VIEW / 2);
        const from = new THREE.Vector3(0.5, 0.4, 1).setLength(away);
        this.camera.position.copy(this.target).add(from);
      }
      this.camera.lookAt(this.target);
    }
    this.resize(this.camera.aspect, 1);
  }
}

/** The scene with its camera. */
export class Stage {
  readonly renderer: THREE.WebGLRenderer;
  readonly scene = new THREE.Scene();
  readonly eye = new Eye();
  readonly controls: OrbitControls;
  #hands = new Map<string, { ball: THREE.Mesh; arrow: THREE.ArrowHelper }>();
  #ball = new THREE.SphereGeometry(1, 20, 14);
  /** Where the last picture, or the last framing, has left the camera. */
  #left = new THREE.Vector3();

  constructor(canvas: HTMLCanvasElement) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.scene.background = new THREE.Color(0x16181d);
    // One finger turns, two move and zoom.
    this.controls = new OrbitControls(this.eye.camera, canvas);
    this.controls.target = this.eye.target;
    this.controls.enableDamping = true;
    this.#left.copy(this.eye.camera.position);
  }

  get largestTexture(): number {
    return this.renderer.capabilities.maxTextureSize;
  }

  /** Looks from the catalog's first camera, or so that all bodies are in the picture. */
  frame(catalog: Catalog, drawn: Iterable<Drawn>): void {
    const bounds = new THREE.Box3();
    for (const one of drawn) {
      one.mesh.geometry.computeBoundingBox();
      one.mesh.updateWorldMatrix(true, false);
      bounds.union(one.mesh.geometry.boundingBox!.clone().applyMatrix4(one.mesh.matrixWorld));
    }
    this.#notice();
    this.eye.frame(bounds, catalog.cameras[0]);
    this.controls.update();
    this.#left.copy(this.eye.camera.position);
  }

  /** Draws the hands and their forces. The strongest force is as long as a third of the scene. */
  showHands(hands: Hand[], strongest: number): void {
    const present = new Set<string>();
    for (const hand of hands) {
      const key = keyOf(hand);
      present.add(key);
      let shown = this.#hands.get(key);
      if (!shown) {
        const color = colorOf(hand.user);
        const ball = new THREE.Mesh(this.#ball, new THREE.MeshBasicMaterial({ color }));
        const arrow = new THREE.ArrowHelper(undefined, undefined, 1, color);
        // A body pulls back into itself: its force is seen through it.
        for (const part of [ball, arrow.line, arrow.cone]) {
          const material = part.material as THREE.Material;
          material.depthTest = false;
          material.transparent = true;
          part.renderOrder = 1;
        }
        shown = { ball, arrow };
        this.#hands.set(key, shown);
        this.scene.add(ball, arrow);
      }
      shown.ball.position.set(...hand.target);
      shown.ball.scale.setScalar(0.015 * this.eye.size);
      const force = new THREE.Vector3(...hand.reaction);
      const size = force.length();
      shown.arrow.visible = size > 0;
      if (size > 0) {
        const length = (0.33 * this.eye.size * size) / Math.max(strongest, size);
        shown.arrow.position.copy(shown.ball.position);
        shown.arrow.setDirection(force.divideScalar(size));
        shown.arrow.setLength(length, Math.min(0.05 * this.eye.size, 0.3 * length), 0.02 * this.eye.size);
      }
    }
    for (const [key, { ball, arrow }] of this.#hands) {
      if (present.has(key)) continue;
      this.scene.remove(ball, arrow);
      (ball.material as THREE.Material).dispose();
      arrow.dispose();
      this.#hands.delete(key);
    }
  }

  /**
   * Whatever moved the camera since the last picture, in whichever handler, was somebody: framing
   * says what it did. Rounding moves it by less, and a touch alone does not.
   */
  #notice(): void {
    const { camera, size } = this.eye;
    if (this.#left.distanceTo(camera.position) > 1e-4 * size) this.eye.touched = true;
    this.#left.copy(camera.position);
  }

  draw(): void {
    const canvas = this.renderer.domElement;
    const [wide, high] = [canvas.clientWidth, canvas.clientHeight];
    // A window may go to another screen, and a page may be zoomed.
    const ratio = Math.min(2, devicePixelRatio);
    if (this.renderer.getPixelRatio() !== ratio) this.renderer.setPixelRatio(ratio);
    if (canvas.width !== Math.floor(wide * ratio) || canvas.height !== Math.floor(high * ratio)) {
      this.renderer.setSize(wide, high, false);
      this.eye.resize(wide, high);
    }
    this.controls.update();
    this.#notice();
    this.renderer.render(this.scene, this.eye.camera);
  }

  /** For measurements: where the camera is, at what it looks, and its vertical angle, rad. */
  view() {
    const { camera, target, touched } = this.eye;
    return {
      touched,
      eye: camera.position.toArray(),
      turned: camera.quaternion.toArray(),
      target: target.toArray(),
      fieldOfView: (camera.fov * Math.PI) / 180,
    };
  }

  /**
   * For measurements: draws the bodies without the hands, and reads which pixels are not those of
   * the background. Rows from below, as lengths of runs that begin with the background.
   */
  pixels() {
    const hands = [...this.#hands.values()].flatMap(({ ball, arrow }) => [ball, arrow]);
    for (const one of hands) one.removeFromParent();
    this.draw();
    const gl = this.renderer.getContext();
    const [wide, high] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
    const read = new Uint8Array(4 * wide * high);
    // In the same task as the drawing: the picture is gone when it has been shown.
    gl.readPixels(0, 0, wide, high, gl.RGBA, gl.UNSIGNED_BYTE, read);
    if (hands.length > 0) this.scene.add(...hands);
    const runs = [0];
    let inside = false;
    for (let at = 0; at < read.length; at += 4) {
      const off = [0x16, 0x18, 0x1d].some((color, k) => Math.abs(read[at + k]! - color) > 3);
      if (off !== inside) runs.push(0);
      inside = off;
      runs[runs.length - 1]!++;
    }
    return { wide, high, runs };
  }
}
