/** What a camera's landmarks need before anybody predicts from them: calm joints, fixed bones. */

import type { Point } from "./motion";

const LEAST_CUTOFF_HZ = 1.5;
const CUTOFF_PER_SPEED = 1.2; // Hz for each metre a second
const SPEED_CUTOFF_HZ = 1;
const MOST_SEEN = 90; // frames, after which a bone's length hardly changes

/** The One-Euro filter of each coordinate: smooth when slow, prompt when fast (Casiez et al. 2012). */
export class OneEuro {
  private values: Float64Array | null = null;
  private speeds = new Float64Array(0);
  private seconds = 0;

  filter(points: Point[], seconds: number): Point[] {
    const raw = Float64Array.from(points.flat());
    const passed = seconds - this.seconds;
    this.seconds = seconds;
    if (!this.values || this.values.length !== raw.length || passed <= 0 || passed > 1) {
      this.values = raw;
      this.speeds = new Float64Array(raw.length);
    } else {
      for (let i = 0; i < raw.length; i++) {
        const speed = (raw[i] - this.values[i]) / passed;
        this.speeds[i] += share(SPEED_CUTOFF_HZ, passed) * (speed - this.speeds[i]);
        const cutoff = LEAST_CUTOFF_HZ + CUTOFF_PER_SPEED * Math.abs(this.speeds[i]);
        this.values[i] += share(cutoff, passed) * (raw[i] - this.values[i]);
      }
    }
    const { values } = this;
    return points.map((_, i) => [values[3 * i], values[3 * i + 1], values[3 * i + 2]]);
  }
}

function share(cutoffHz: number, seconds: number): number {
  const rate = 2 * Math.PI * cutoffHz * seconds;
  return rate / (rate + 1);
}

/** Poses whose bones are as long as they were on average, along the tree from its root. */
export class FixedBones {
  private readonly order: number[];
  private readonly lengths: Float64Array;
  private seen = 0;

  constructor(private readonly parents: number[]) {
    this.order = parentsFirst(parents);
    this.lengths = new Float64Array(parents.length);
  }

  fit(points: Point[]): Point[] {
    this.seen = Math.min(this.seen + 1, MOST_SEEN);
    const fitted = points.map((point): Point => [...point]);
    for (const joint of this.order) {
      const parent = this.parents[joint];
      if (parent < 0) continue;
      const [x, y, z] = points[joint].map((value, axis) => value - points[parent][axis]);
      const length = Math.hypot(x, y, z);
      this.lengths[joint] += (length - this.lengths[joint]) / this.seen;
      const stretch = length > 0 ? this.lengths[joint] / length : 0;
      const [px, py, pz] = fitted[parent];
      fitted[joint] = [px + x * stretch, py + y * stretch, pz + z * stretch];
    }
    return fitted;
  }
}

/** Joints in an order in which each comes after its parent. */
function parentsFirst(parents: number[]): number[] {
  const depth = (joint: number): number => (parents[joint] < 0 ? 0 : 1 + depth(parents[joint]));
  return parents.map((_, joint) => joint).sort((a, b) => depth(a) - depth(b));
}
