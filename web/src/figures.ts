/** Many bodies in a few draw calls: a spindle for each bone and a ball for each head. */

import {
  Color,
  DynamicDrawUsage,
  Group,
  InstancedMesh,
  LatheGeometry,
  type Material,
  SphereGeometry,
  Vector2,
} from "three";
import { headOf, type Skeleton } from "./skeleton";

const SPINDLE = spindle(10, 8);
const BALL = new SphereGeometry(1, 14, 10);
const THICKNESS = { least: 0.013, most: 0.058, ofLength: 0.17 };
const HEAD_M = 0.1;

export interface FiguresOptions {
  material: Material;
  /** Relative to the observed person's. */
  thickness?: number;
  shadow?: boolean;
  renderOrder?: number;
}

/** Bodies of one skeleton; `begin`, then `add` for each, then `end`. */
export class Figures {
  readonly group = new Group();
  private readonly options: Required<FiguresOptions>;
  private bones: [child: number, parent: number][] = [];
  private head: { joint: number; from: number } | null = null;
  private loose: number[] = [];
  private spindles: InstancedMesh | null = null;
  private balls: InstancedMesh | null = null;
  private capacity = 0;
  private numSpindles = 0;
  private numBalls = 0;

  constructor(options: FiguresOptions) {
    this.options = { thickness: 1, shadow: false, renderOrder: 0, ...options };
  }

  setSkeleton({ joints, parents }: Skeleton): void {
    this.bones = parents.flatMap((parent, joint) => (parent >= 0 ? [[joint, parent]] : []));
    const head = headOf(joints);
    this.head = head >= 0 && parents[head] >= 0 ? { joint: head, from: parents[head] } : null;
    const jointed = new Set(this.bones.flat());
    this.loose = parents.flatMap((_, joint) => (jointed.has(joint) ? [] : [joint]));
    this.capacity = 0;
  }

  begin(numFigures: number): void {
    if (numFigures > this.capacity) this.reserve(numFigures);
    this.numSpindles = 0;
    this.numBalls = 0;
  }

  add(pose: Float32Array, color: Color): void {
    for (const [child, parent] of this.bones) this.addBone(pose, child, parent, color);
    for (const joint of this.loose) this.addBall(pose, joint, 0, 0, 0, 0.03, color);
    if (this.head) this.addHead(pose, this.head.joint, this.head.from, color);
  }

  end(): void {
    for (const [mesh, count] of [
      [this.spindles, this.numSpindles],
      [this.balls, this.numBalls],
    ] as const) {
      if (!mesh) continue;
      mesh.count = count;
      mesh.instanceMatrix.needsUpdate = true;
      if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
    }
  }

  private reserve(numFigures: number): void {
    this.capacity = Math.max(numFigures, 1);
    this.group.clear();
    this.spindles?.dispose();
    this.balls?.dispose();
    const make = (geometry: LatheGeometry | SphereGeometry, count: number): InstancedMesh => {
      const mesh = new InstancedMesh(geometry, this.options.material, Math.max(count, 1));
      mesh.instanceMatrix.setUsage(DynamicDrawUsage);
      mesh.setColorAt(0, new Color());
      mesh.frustumCulled = false;
      mesh.castShadow = this.options.shadow;
      mesh.renderOrder = this.options.renderOrder;
      mesh.count = 0;
      this.group.add(mesh);
      return mesh;
    };
    this.spindles = make(SPINDLE, this.bones.length * this.capacity);
    this.balls = make(BALL, (this.loose.length + 1) * this.capacity);
  }

  private addBone(pose: Float32Array, child: number, parent: number, color: Color): void {
    const from = parent * 3;
    const to = child * 3;
    const x = pose[to] - pose[from];
    const y = pose[to + 1] - pose[from + 1];
    const z = pose[to + 2] - pose[from + 2];
    const length = Math.hypot(x, y, z);
    if (!(length > 1e-4) || !this.spindles) return; // an unseen joint is NaN
    const { least, most, ofLength } = THICKNESS;
    const wide = Math.min(Math.max(length * ofLength, least), most) * this.options.thickness;
    const reach = length + wide; // half a thickness beyond each joint, so that limbs join
    const [dx, dy, dz] = [x / length, y / length, z / length];
    // Any two axes across the bone: the first from the world axis that it is least along.
    const along = Math.abs(dz) < 0.9;
    const [ux, uy, uz] = along ? [-dy, dx, 0] : [0, -dz, dy];
    const norm = wide / Math.hypot(ux, uy, uz);
    const [ax, ay, az] = [ux * norm, uy * norm, uz * norm];
    const [bx, by, bz] = [dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax];
    // biome-ignore format: the columns of the matrix
    this.spindles.instanceMatrix.array.set([
      bx, by, bz, 0,
      dx * reach, dy * reach, dz * reach, 0,
      ax, ay, az, 0,
      pose[from] - dx * wide * 0.5, pose[from + 1] - dy * wide * 0.5, pose[from + 2] - dz * wide * 0.5, 1,
    ], this.numSpindles * 16);
    this.spindles.setColorAt(this.numSpindles++, color);
  }

  private addHead(pose: Float32Array, joint: number, from: number, color: Color): void {
    const [a, b] = [from * 3, joint * 3];
    const [x, y, z] = [pose[b] - pose[a], pose[b + 1] - pose[a + 1], pose[b + 2] - pose[a + 2]];
    const length = Math.hypot(x, y, z);
    if (!(length > 1e-4)) return;
    const up = (0.6 * HEAD_M) / length;
    this.addBall(pose, joint, x * up, y * up, z * up, HEAD_M, color);
  }

  private addBall(
    pose: Float32Array,
    joint: number,
    x: number,
    y: number,
    z: number,
    radius: number,
    color: Color,
  ): void {
    const at = joint * 3;
    if (!this.balls || Number.isNaN(pose[at])) return;
    const wide = radius * (0.75 + 0.25 * this.options.thickness);
    // biome-ignore format: the columns of the matrix
    this.balls.instanceMatrix.array.set([
      wide, 0, 0, 0,
      0, wide, 0, 0,
      0, 0, wide * 1.15, 0,
      pose[at] + x, pose[at + 1] + y, pose[at + 2] + z, 1,
    ], this.numBalls * 16);
    this.balls.setColorAt(this.numBalls++, color);
  }
}

/** A limb of length 1 along +Y and of radius 1: full in the middle, round at its ends. */
function spindle(rings: number, sides: number): LatheGeometry {
  const outline = Array.from({ length: rings + 1 }, (_, ring) => {
    const along = (1 - Math.cos((Math.PI * ring) / rings)) / 2;
    return new Vector2(Math.sin(Math.PI * along) ** 0.55, along);
  });
  return new LatheGeometry(outline, sides);
}
