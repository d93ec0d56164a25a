/** The balls that hold a joint so often: at the time that is shown, and the tubes they have swept. */

import {
  type Color,
  DynamicDrawUsage,
  Group,
  InstancedMesh,
  Matrix4,
  NotEqualStencilFunc,
  ReplaceStencilOp,
  MeshBasicMaterial,
  ShaderMaterial,
  SphereGeometry,
  Vector3,
} from "three";
import type { Track } from "./motion";

export interface Regions {
  levels: number[];
  calibrated: boolean;
  centre: Track;
  /** In metres, [levels][frames][joints] in one array. */
  radius: Float32Array;
}

const BALL = new SphereGeometry(1, 48, 32);
const SWEPT = new SphereGeometry(1, 20, 14);
const MATRIX = new Matrix4();
const EVERY = 2; // frames, of those swept

export class RegionBalls {
  readonly group = new Group();
  private readonly balls: InstancedMesh[] = [];
  private readonly tube: InstancedMesh;

  constructor(numLevels: number, maxBalls: number, maxSwept: number) {
    this.tube = this.added(SWEPT, sweptMaterial(), maxSwept, 5);
    for (let level = 0; level < numLevels; level++) {
      this.balls.push(this.added(BALL, rimMaterial(level === 0 ? 0.75 : 0.4), maxBalls, 8 - level));
    }
  }

  paint(color: Color): void {
    for (const { material } of this.balls) {
      (material as ShaderMaterial).uniforms.color.value = color;
    }
    (this.tube.material as MeshBasicMaterial).color = color;
  }

  hide(): void {
    this.group.visible = false;
  }

  /** The balls of some joints at a frame, and what those of the first level went through. */
  draw({ centre, radius }: Regions, joints: number[], frame: number): void {
    const last = Math.min(Math.max(Math.round(frame), 0), centre.frames - 1);
    const put = (mesh: InstancedMesh, level: number, when: number, joint: number): void => {
      const r = radius[(level * centre.frames + when) * centre.joints + joint];
      const at = (when * centre.joints + joint) * 3;
      MATRIX.makeScale(r, r, r).setPosition(new Vector3(...centre.data.subarray(at, at + 3)));
      mesh.setMatrixAt(mesh.count++, MATRIX);
      mesh.instanceMatrix.needsUpdate = true;
    };
    this.group.visible = true;
    this.tube.count = 0;
    for (let when = last; when >= 0; when -= EVERY) {
      for (const joint of joints) put(this.tube, 0, when, joint);
    }
    this.balls.forEach((mesh, level) => {
      mesh.count = 0;
      for (const joint of joints) put(mesh, level, last, joint);
    });
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
function sweptMaterial(): MeshBasicMaterial {
  return new MeshBasicMaterial({
    transparent: true,
    opacity: 0.13,
    depthWrite: false,
    stencilWrite: true,
    stencilRef: 1,
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
        gl_FragColor = vec4(color, opacity * (0.04 + 0.96 * pow(1.0 - abs(facing), 4.0)));
        #include <colorspace_fragment>
      }`,
  });
}
