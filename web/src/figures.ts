/** Many bodies in a few draw calls: a spindle for each bone and a ball for each head. */

import {
  Color,
  DynamicDrawUsage,
  Group,
  InstancedMesh,
  LatheGeometry,
  type Material,
  Matrix4,
  SphereGeometry,
  Vector2,
  Vector3,
} from "three";
import { headOf, hipsOf, rootOf, shouldersOf, type Skeleton } from "./skeleton";

const SPINDLE = spindle(10, 8);
const BALL = new SphereGeometry(1, 14, 10);
const THICKNESS = { least: 0.013, most: 0.058, ofLength: 0.17 };
const TORSO = [0.3, 0.19]; // half its width and depth, of its length
const HEAD_M = 0.1;
const LOOSE_M = 0.03; // a joint without a bone
const MATRIX = new Matrix4();

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
  private torso: Torso | null = null;
  private loose: number[] = [];
  private spindles: InstancedMesh | null = null;
  private balls: InstancedMesh | null = null;
  private capacity = 0;
  private numSpindles = 0;
  private numBalls = 0;

  constructor(options: FiguresOptions) {
    this.options = { thickness: 1, shadow: false, renderOrder: 0, ...options };
  }

  setSkeleton(skeleton: Skeleton): void {
    const { joints, parents } = skeleton;
    this.bones = parents.flatMap((parent, joint) => (parent >= 0 ? [[joint, parent]] : []));
    const head = headOf(joints);
    this.head = head >= 0 ? { joint: head, from: parents[head] } : null;
    this.torso = torsoOf(skeleton, this.head?.from ?? -1);
    this.loose = this.bones.length > 0 ? [] : parents.map((_, joint) => joint);
    this.capacity = 0;
  }

  begin(numFigures: number): void {
    if (numFigures > this.capacity) this.reserve(numFigures);
    this.numSpindles = 0;
    this.numBalls = 0;
  }

  add(pose: Float32Array, color: Color): void {
    for (const [child, parent] of this.bones) this.addBone(pose, child, parent, color);
    if (this.torso) this.addTorso(pose, this.torso, color);
    for (const joint of this.loose) this.addBall(pose, joint, new Vector3(), LOOSE_M, color);
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
    this.spindles = make(SPINDLE, (this.bones.length + 1) * this.capacity);
    this.balls = make(BALL, (this.loose.length + 1) * this.capacity);
  }

  private addBone(pose: Float32Array, child: number, parent: number, color: Color): void {
    const along = between(pose, parent, child);
    const length = along.length();
    if (!(length > 1e-4)) return; // an unseen joint is NaN
    const { least, most, ofLength } = THICKNESS;
    const wide = Math.min(Math.max(length * ofLength, least), most) * this.options.thickness;
    // Any axis across the bone: that of the world which it is least along.
    const across = new Vector3(0, 0, 1);
    if (Math.abs(along.z) > 0.9 * length) across.set(1, 0, 0);
    this.addSpindle(pointOf(pose, parent), along, across, [wide, wide], wide, color);
  }

  private addTorso(pose: Float32Array, torso: Torso, color: Color): void {
    const start = middle(pose, torso.from);
    const along = middle(pose, torso.to).sub(start);
    const sideways = between(pose, ...torso.hips);
    if (!(along.length() > 1e-4) || !(sideways.length() > 1e-4)) return;
    const [wide, deep] = TORSO.map((share) => share * along.length() * this.options.thickness);
    this.addSpindle(start, along, sideways, [wide, deep], deep, color);
  }

  /** A spindle from a point along a vector, a little beyond both ends so that limbs join. */
  private addSpindle(
    from: Vector3,
    along: Vector3,
    across: Vector3,
    [wide, deep]: number[],
    beyond: number,
    color: Color,
  ): void {
    if (!this.spindles) return;
    const direction = along.clone().normalize();
    const z = new Vector3().crossVectors(across, direction).normalize();
    const x = new Vector3().crossVectors(direction, z);
    const reach = along.length() + beyond;
    const start = from.clone().addScaledVector(direction, -beyond / 2);
    MATRIX.makeBasis(x.multiplyScalar(wide), direction.multiplyScalar(reach), z.multiplyScalar(deep));
    this.spindles.setMatrixAt(this.numSpindles, MATRIX.setPosition(start));
    this.spindles.setColorAt(this.numSpindles++, color);
  }

  private addHead(pose: Float32Array, joint: number, from: number, color: Color): void {
    const up = from < 0 ? new Vector3() : between(pose, from, joint).setLength(0.6 * HEAD_M);
    this.addBall(pose, joint, up, HEAD_M, color);
  }

  private addBall(pose: Float32Array, joint: number, beyond: Vector3, radius: number, color: Color): void {
    const at = pointOf(pose, joint).add(beyond);
    if (!this.balls || Number.isNaN(at.x)) return;
    const wide = radius * (0.75 + 0.25 * this.options.thickness);
    MATRIX.makeScale(wide, wide, wide * 1.15).setPosition(at);
    this.balls.setMatrixAt(this.numBalls, MATRIX);
    this.balls.setColorAt(this.numBalls++, color);
  }
}

interface Torso {
  hips: [number, number];
  from: number[];
  to: number[];
}

/** From the root to the neck, else from between the hips to between the shoulders; turned as the hips are. */
function torsoOf(skeleton: Skeleton, neck: number): Torso | null {
  const [hips, root] = [hipsOf(skeleton.joints), rootOf(skeleton)];
  if (!hips || neck === root) return null;
  if (neck >= 0) return { hips, from: [root], to: [neck] };
  const shoulders = shouldersOf(skeleton.joints);
  return shoulders && { hips, from: hips, to: shoulders };
}

const pointOf = (pose: Float32Array, joint: number) => new Vector3().fromArray(pose, joint * 3);

const between = (pose: Float32Array, from: number, to: number) => pointOf(pose, to).sub(pointOf(pose, from));

function middle(pose: Float32Array, joints: number[]): Vector3 {
  const sum = new Vector3();
  for (const joint of joints) sum.add(pointOf(pose, joint));
  return sum.divideScalar(joints.length);
}

/** A limb of length 1 along +Y and of radius 1: full in the middle, round at its ends. */
function spindle(rings: number, sides: number): LatheGeometry {
  const outline = Array.from({ length: rings + 1 }, (_, ring) => {
    const along = (1 - Math.cos((Math.PI * ring) / rings)) / 2;
    return new Vector2(Math.sin(Math.PI * along) ** 0.55, along);
  });
  return new LatheGeometry(outline, sides);
}
