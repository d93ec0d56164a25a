/** Where roots go on the ground: the path so far, and one line for each future. */

import { type Color, Group } from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
import type { Track } from "./motion";

const ABOVE_GROUND_M = 0.006;

export interface Trail {
  track: Track;
  from: number;
  to: number;
  /** Where the line begins, where that is not the first frame: the last pose observed. */
  start?: Float32Array;
  color: (frame: number) => Color;
}

export class Trails {
  readonly group = new Group();
  private readonly lines: LineSegments2;

  constructor(options: { width: number; opacity: number }) {
    const material = new LineMaterial({
      linewidth: options.width,
      vertexColors: true,
      transparent: true,
      opacity: options.opacity,
      depthWrite: false,
    });
    this.lines = new LineSegments2(new LineSegmentsGeometry(), material);
    this.lines.frustumCulled = false;
    this.group.add(this.lines);
  }

  draw(trails: Trail[], root: number, ground: number): void {
    const positions: number[] = [];
    const colors: number[] = [];
    for (const { track, from, to, start, color } of trails) {
      let [x, y] = start ? [start[root * 3], start[root * 3 + 1]] : [Number.NaN, Number.NaN];
      for (let frame = from; frame < to; frame++) {
        const at = (frame * track.joints + root) * 3;
        const [nextX, nextY] = [track.data[at], track.data[at + 1]];
        if (!Number.isNaN(x + nextX)) {
          const z = ground + ABOVE_GROUND_M;
          const { r, g, b } = color(frame);
          positions.push(x, y, z, nextX, nextY, z);
          colors.push(r, g, b, r, g, b);
        }
        [x, y] = [nextX, nextY];
      }
    }
    this.lines.visible = positions.length > 0;
    if (!this.lines.visible) return;
    this.lines.geometry.dispose();
    this.lines.geometry = new LineSegmentsGeometry();
    this.lines.geometry.setPositions(positions);
    this.lines.geometry.setColors(colors);
  }
}
