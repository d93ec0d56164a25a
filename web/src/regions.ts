/** The balls that hold a joint so often: at the time that is shown, and the tubes they have swept. */

import {
  type Color,
  DynamicDrawUsage,
  Group,
  InstancedMesh,
  NotEqualStencilFunc,
  ReplaceStencilOp,
  MeshBasicMaterial,
  ShaderMaterial,
  SphereGeometry,
} from "three";
import type { Track } from "./motion";

export interface Regions {
  levels: number[];
  calibrated: boolean;
  centre: Track;
  /** In metres, [levels][frames][joints] in one array. */
  radius: Float32Array;
}

const BALL = new SphereGeometry(1, 24, 16);
const SWEPT = new SphereGeometry(1, 14, 10);
const EVERY = 2; // frames, of those swept

export class RegionBalls {
  readonly group = new Group();
  private readonly balls: InstancedMesh[] = [];
  private readonly tubes: InstancedMesh[] = [];

  constructor(numLevels: number, maxBalls: number, maxSwept: number) {
    for (let level = 0; level < numLevels; level++) {
      const inner = level === 0;
      this.tubes.push(this.added(SWEPT, sweptMaterial(level), maxSwept, 6 - level));
      this.balls.push(this.added(BALL, rimMaterial(inner ? 0.5 : 0.3), maxBalls, 8 - level));
    }
  }

  paint(color: Color): void {
    for (const { material } of this.balls) {
      (material as ShaderMaterial).uniforms.color.value = color;
    }
    for (const { material } of this.tubes) (material as MeshBasicMaterial).color = color;
  }

  hide(): void {
    this.group.visible = false;
  }

  /** The balls of some joints at a frame of the futures, and what they went through until then. */
  draw({ centre, radius }: Regions, joints: number[], frame: number): void {
    const last = Math.min(Math.max(Math.round(frame), 0), centre.frames - 1);
    this.group.visible = true;
    for (let level = 0; level < this.balls.length; level++) {
      const at = (mesh: InstancedMesh, index: number, when: number, joint: number): void => {
        const r = radius[(level * centre.frames + when) * centre.joints + joint];
        const p = (when * centre.joints + joint) * 3;
        const [x, y, z] = [centre.data[p], centre.data[p + 1], centre.data[p + 2]];
        mesh.instanceMatrix.array.set([r, 0, 0, 0, 0, r, 0, 0, 0, 0, r, 0, x, y, z, 1], index * 16);
      };
      const [balls, tubes] = [this.balls[level], this.tubes[level]];
      joints.forEach((joint, index) => at(balls, index, last, joint));
      balls.count = joints.length;
      let swept = 0;
      for (let when = last; when >= 0; when -= EVERY) {
        for (const joint of joints) at(tubes, swept++, when, joint);
      }
      tubes.count = swept;
      for (const mesh of [balls, tubes]) mesh.instanceMatrix.needsUpdate = true;
    }
  }

  private added(
    geometry: SphereGeometry,
    material: ShaderMaterial | MeshBasicMaterial,
    count: number,
    renderOrder: number,
  ): InstancedMesh {
    const mesh = new InstancedMesh(geometry, material, count);
    mesh.instanceMatrix.setUsage(DynamicDrawUsage);
    mesh.frustumCulled = false;
    mesh.renderOrder = renderOrder;
    mesh.count = 0;
    this.group.add(mesh);
    return mesh;
  }
}

/** One even tint however many balls overlap: each pixel is painted once. */
function sweptMaterial(level: number): MeshBasicMaterial {
  return new MeshBasicMaterial({
    transparent: true,
    opacity: 0.09,
    depthWrite: false,
    stencilWrite: true,
    stencilRef: level + 1,
    stencilFunc: NotEqualStencilFunc,
    stencilZPass: ReplaceStencilOp,
  });
}

/** A bubble: clear in the middle, tinted at its rim. */
function rimMaterial(opacity: number): ShaderMaterial {
  return new ShaderMaterial({
    transparent: true,
    depthWrite: false,
    uniforms: { color: { value: null }, opacity: { value: opacity } },
    vertexShader: `
      varying float facing;
      void main() {
        vec4 at = modelViewMatrix * instanceMatrix * vec4(position, 1.0);
        facing = dot(normalize(normalMatrix * normalize(mat3(instanceMatrix) * normal)), normalize(-at.xyz));
        gl_Position = projectionMatrix * at;
      }`,
    fragmentShader: `
      uniform vec3 color;
      uniform float opacity;
      varying float facing;
      void main() {
        gl_FragColor = vec4(color, opacity * (0.12 + 0.88 * pow(1.0 - abs(facing), 3.0)));
        #include <colorspace_fragment>
      }`,
  });
}
