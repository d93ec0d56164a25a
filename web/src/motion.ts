/** Motions as the page draws them: metres, +Z up, joint after joint in one array. */

import type { PredictRequest } from "../client";
import type { Skeleton } from "./skeleton";

export type Point = [number, number, number];
export type Poses = (Point | null)[][];
export type Axes = { up: Up; units: Units; handed?: "right" | "left" };
type Up = "x" | "-x" | "y" | "-y" | "z" | "-z";
type Units = "m" | "cm" | "mm";

/** Positions of J joints over frames, in metres; a joint that was not seen is NaN. */
export interface Track {
  frames: number;
  joints: number;
  data: Float32Array;
}

/** A motion in its owner's words, beside what is drawn of it. */
export interface Motion {
  name: string;
  poses: Poses;
  fps: number;
  axes: Axes;
  named: PredictRequest["skeleton"];
  skeleton: Skeleton;
  track: Track;
}

export const METRES_Z_UP: Axes = { up: "z", units: "m" };

const UNITS_PER_METRE: Record<Units, number> = { m: 1, cm: 100, mm: 1000 };

/** Rows give our x, y and z in the owner's axes, as the server has them. */
const TO_Z_UP: Record<Up, [Point, Point, Point]> = {
  x: [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
  "-x": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]],
  y: [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
  "-y": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
  z: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
  "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
};

export function metres(length: number, { units }: Axes): number {
  return length / UNITS_PER_METRE[units];
}

export function trackOf(poses: Poses, axes: Axes): Track {
  const joints = poses[0]?.length ?? 0;
  const data = new Float32Array(poses.length * joints * 3);
  const [ahead, left, up] = TO_Z_UP[axes.up];
  const rows = [ahead, axes.handed === "left" ? left.map((part) => -part) : left, up];
  const scale = 1 / UNITS_PER_METRE[axes.units];
  let at = 0;
  for (const pose of poses) {
    for (const point of pose) {
      for (const row of rows) {
        data[at++] = point
          ? scale * (row[0] * point[0] + row[1] * point[1] + row[2] * point[2])
          : Number.NaN;
      }
    }
  }
  return { frames: poses.length, joints, data };
}

/** The pose at a frame, which may lie between two, into `out` (J * 3). */
export function poseAt(track: Track, frame: number, out: Float32Array): Float32Array {
  const size = track.joints * 3;
  const clamped = Math.min(Math.max(frame, 0), track.frames - 1);
  const first = Math.floor(clamped);
  const share = clamped - first;
  const from = first * size;
  const to = Math.min(first + 1, track.frames - 1) * size;
  for (let i = 0; i < size; i++) {
    out[i] = track.data[from + i] * (1 - share) + track.data[to + i] * share;
  }
  return out;
}

/** The height of the ground: what the lowest joint reaches in most frames. */
export function groundOf(track: Track): number {
  const lowest: number[] = [];
  for (let frame = 0; frame < track.frames; frame++) {
    let low = Number.POSITIVE_INFINITY;
    for (let joint = 0; joint < track.joints; joint++) {
      const z = track.data[(frame * track.joints + joint) * 3 + 2];
      if (z < low) low = z;
    }
    if (Number.isFinite(low)) lowest.push(low);
  }
  lowest.sort((a, b) => a - b);
  return lowest[Math.floor(lowest.length * 0.1)] ?? 0;
}
