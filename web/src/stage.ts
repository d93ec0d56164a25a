/** The world that bodies stand in: camera, light, ground, and a picture when something changed. */

import {
  DirectionalLight,
  HemisphereLight,
  MathUtils,
  Mesh,
  NeutralToneMapping,
  Object3D,
  PCFShadowMap,
  PerspectiveCamera,
  PlaneGeometry,
  Scene,
  ShaderMaterial,
  ShadowMaterial,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { Palette } from "./palette";

Object3D.DEFAULT_UP.set(0, 0, 1);

const REACH_M = 60; // of the ground, from the person
const CALM_S = 0.35; // in which the camera catches up with the person
const LEFT_M = 4; // across a square view, beyond which what lies behind is left

export class Stage {
  readonly scene = new Scene();
  private readonly renderer: WebGLRenderer;
  private readonly camera = new PerspectiveCamera(38, 1, 0.05, 200);
  private readonly controls: OrbitControls;
  private readonly sun = new DirectionalLight(0xffffff, 2.4);
  private readonly sky = new HemisphereLight(0xffffff, 0x888888, 1.6);
  private readonly grid: Mesh<PlaneGeometry, ShaderMaterial>;
  private readonly shadow: Mesh<PlaneGeometry, ShadowMaterial>;
  private readonly wanted = { at: new Vector3(), far: 1 };
  private far = 1; // times the distance that was chosen, so that all is in view
  private changed = true;
  private drawn = 0;

  /** @param tick lets time pass and moves what moves; whether anything did. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    tick: (seconds: number) => boolean,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true, stencil: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.toneMapping = NeutralToneMapping;
    this.renderer.toneMappingExposure = 1;

    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.maxPolarAngle = Math.PI / 2 - 0.03;
    this.controls.minDistance = 1;
    this.controls.maxDistance = 25;
    this.controls.addEventListener("change", () => this.invalidate());

    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    this.sun.shadow.radius = 5;
    this.sun.shadow.bias = -0.0005;
    const view = this.sun.shadow.camera;
    [view.left, view.right, view.top, view.bottom, view.near, view.far] = [-3, 3, 3, -3, 1, 16];
    this.grid = new Mesh(new PlaneGeometry(2 * REACH_M, 2 * REACH_M), gridMaterial());
    this.grid.renderOrder = -2;
    this.shadow = new Mesh(
      new PlaneGeometry(2 * REACH_M, 2 * REACH_M),
      new ShadowMaterial({ opacity: 0.25, depthWrite: false }),
    );
    this.shadow.receiveShadow = true;
    this.shadow.renderOrder = -1;
    this.scene.add(this.sun, this.sun.target, this.sky, this.grid, this.shadow);

    new ResizeObserver(() => this.resize()).observe(canvas);
    let before = performance.now();
    const frame = (now: number): void => {
      requestAnimationFrame(frame);
      const seconds = Math.min((now - before) / 1000, 0.1);
      before = now;
      if (tick(seconds)) this.changed = true;
      if (this.catchUp(seconds)) this.changed = true;
      this.controls.update();
      if (!this.changed) return;
      this.changed = false;
      this.renderer.render(this.scene, this.camera);
      canvas.dataset.drawn = String(++this.drawn);
    };
    requestAnimationFrame(frame);
  }

  invalidate(): void {
    this.changed = true;
  }

  paint(palette: Palette): void {
    this.grid.material.uniforms.color.value = palette.grid;
    this.shadow.material.opacity = palette.dark ? 0.5 : 0.22;
    this.sky.groundColor.set(palette.dark ? 0x2a3242 : 0x9aa0ab);
    this.sky.intensity = palette.dark ? 1.3 : 2;
    this.invalidate();
  }

  /** Look at a person who stands at `at` on the ground and faces `heading`, from the front side. */
  lookAt(at: Vector3, ground: number, heading: number): void {
    this.grid.position.z = ground;
    this.shadow.position.z = ground + 0.002;
    this.follow(at, at);
    this.far = this.wanted.far;
    this.controls.target.copy(at);
    const azimuth = heading + 0.95;
    const portrait = this.camera.aspect < 1 ? 1.25 : 1;
    const away = 4.7 * portrait;
    this.camera.position.set(
      at.x + away * Math.cos(azimuth),
      at.y + away * Math.sin(azimuth),
      ground + 1.9 * portrait,
    );
    this.catchUp(0);
    this.invalidate();
  }

  /** Keep a place in view, and `behind`, where what is there came from, until that is too far away. */
  follow(place: Vector3, behind: Vector3): void {
    const apart = place.distanceTo(behind) / this.camera.aspect;
    if (!Number.isFinite(apart)) return;
    const share = MathUtils.clamp(apart / LEFT_M - 0.5, 0.5, 1);
    this.wanted.at.lerpVectors(behind, place, share);
    this.wanted.far = Math.max(1, (1 - share) * apart);
  }

  orbit(azimuth: number, closer: number): void {
    const away = this.camera.position.clone().sub(this.controls.target);
    away.applyAxisAngle(Object3D.DEFAULT_UP, azimuth).multiplyScalar(closer);
    this.camera.position.copy(this.controls.target).add(away);
    this.invalidate();
  }

  private catchUp(seconds: number): boolean {
    const left = this.wanted.at.clone().sub(this.controls.target);
    left.z = 0;
    const share = 1 - Math.exp(-seconds / CALM_S);
    const step = left.multiplyScalar(share);
    const back = (this.wanted.far - this.far) * share;
    const moves = step.length() > 1e-4 || Math.abs(back) > 1e-4;
    if (moves) {
      const away = this.camera.position.sub(this.controls.target).multiplyScalar(1 + back / this.far);
      this.far += back;
      this.controls.target.add(step);
      away.add(this.controls.target);
    }
    const { x, y } = this.controls.target;
    for (const plane of [this.grid, this.shadow]) [plane.position.x, plane.position.y] = [x, y];
    this.sun.target.position.set(x, y, this.grid.position.z + 0.8);
    this.sun.position.set(x + 2.2, y + 2.6, this.grid.position.z + 6);
    return moves;
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.invalidate();
  }
}

/** Lines of half metres and metres, which fade with the distance from the person. */
function gridMaterial(): ShaderMaterial {
  return new ShaderMaterial({
    transparent: true,
    depthWrite: false,
    uniforms: { color: { value: null } },
    vertexShader: `
      varying vec2 world;
      varying vec2 away;
      void main() {
        vec4 at = modelMatrix * vec4(position, 1.0);
        world = at.xy;
        away = position.xy;
        gl_Position = projectionMatrix * viewMatrix * at;
      }`,
    fragmentShader: `
      uniform vec3 color;
      varying vec2 world;
      varying vec2 away;
      float lines(float spacing, float width) {
        vec2 cells = world / spacing;
        vec2 pixel = fwidth(cells);
        vec2 near = abs(fract(cells - 0.5) - 0.5) / max(pixel, 1e-6);
        vec2 sharp = clamp(width - near, 0.0, 1.0) * clamp(0.5 / max(pixel, 1e-6) - 1.0, 0.0, 1.0);
        return max(sharp.x, sharp.y);
      }
      void main() {
        float fade = exp(-pow(length(away) / 7.0, 2.0));
        float ink = max(0.35 * lines(0.5, 1.0), lines(1.0, 1.2));
        gl_FragColor = vec4(color, (ink * 0.55 + 0.035) * fade);
        #include <colorspace_fragment>
      }`,
  });
}
