/** What the scene shows at a time: the observed person, the futures, the truth and the regions. */

import { Color, MeshBasicMaterial, MeshLambertMaterial, MeshStandardMaterial, Vector3 } from "three";
import type { Answer } from "./api";
import { Figures } from "./figures";
import { groundOf, type Motion, poseAt, type Track } from "./motion";
import type { Palette } from "./palette";
import { RegionBalls } from "./regions";
import { hipsOf, rootOf, watched } from "./skeleton";
import type { Stage } from "./stage";
import { type Trail, Trails } from "./trails";

/** Which futures are shown: all, those of one mode, or one. */
export type Solo = { mode: number } | { sample: number } | null;

export interface Look {
  crowd: boolean;
  trails: boolean;
  regions: boolean;
  truth: boolean;
  solo: Solo;
}

const MAX_WATCHED = 4;
const MAX_FRAMES = 700;

export class View {
  private motion: Motion | null = null;
  private now = 0;
  private answer: Answer | null = null;
  private answered = 0; // the last frame that the answer is about
  private look: Look = { crowd: true, trails: true, regions: false, truth: false, solo: null };
  private palette: Palette | null = null;
  private ground = 0;
  private root = 0;
  private joints: number[] = [];
  private pose = new Float32Array(0);
  private nowPose = new Float32Array(0);
  private startPose = new Float32Array(0);
  private readonly bodyMaterial = new MeshStandardMaterial({ roughness: 0.62, metalness: 0.05 });
  private readonly crowdMaterial = new MeshLambertMaterial({ transparent: true, depthWrite: false });
  private readonly chosenMaterial = new MeshStandardMaterial({
    transparent: true,
    opacity: 0.72,
    roughness: 0.5,
  });
  private readonly truthMaterial = new MeshBasicMaterial({ wireframe: true, transparent: true, opacity: 0.8 });
  private readonly body = new Figures({ material: this.bodyMaterial, shadow: true });
  private readonly crowd = new Figures({ material: this.crowdMaterial, thickness: 0.6, renderOrder: 2 });
  private readonly chosen = new Figures({ material: this.chosenMaterial, thickness: 0.8, shadow: true, renderOrder: 3 });
  private readonly truth = new Figures({ material: this.truthMaterial, thickness: 0.95, renderOrder: 4 });
  private readonly path = new Trails({ width: 3.5, opacity: 0.9 });
  private readonly paths = new Trails({ width: 1.6, opacity: 0.5 });
  private readonly chosenPaths = new Trails({ width: 3.5, opacity: 0.95 });
  private readonly regions = new RegionBalls(2, MAX_WATCHED, MAX_WATCHED * MAX_FRAMES);

  /** @param actionColour gives an action's place among the colours. */
  constructor(
    private readonly stage: Stage,
    private readonly actionColour: (action: string) => number,
  ) {
    for (const { group } of [this.body, this.crowd, this.chosen, this.truth, this.path, this.paths, this.chosenPaths, this.regions]) {
      stage.scene.add(group);
    }
  }

  paint(palette: Palette): void {
    this.palette = palette;
    this.truthMaterial.color = palette.truth;
    this.regions.paint(palette.region);
    this.stage.paint(palette);
    this.drawTrails();
  }

  /** Another person: the ground, the camera and all bodies change. */
  setMotion(motion: Motion, now: number): void {
    this.motion = motion;
    this.answer = null;
    this.ground = groundOf(motion.track);
    this.root = rootOf(motion.skeleton);
    this.joints = watched(motion.skeleton).slice(0, MAX_WATCHED);
    this.pose = new Float32Array(motion.track.joints * 3);
    this.nowPose = new Float32Array(motion.track.joints * 3);
    this.startPose = new Float32Array(motion.track.joints * 3);
    for (const figures of [this.body, this.crowd, this.chosen, this.truth]) {
      figures.setSkeleton(motion.skeleton);
    }
    this.setNow(now);
    this.stage.lookAt(this.rootOf(this.nowPose), this.ground, this.heading());
  }

  /** The last frame observed; until there is an answer about it, the one before is shown. */
  setNow(now: number): void {
    if (!this.motion) return;
    this.now = now;
    poseAt(this.motion.track, now, this.nowPose);
    this.drawTrails();
  }

  /** The newest frames of a motion that goes on. */
  replaceMotion(motion: Motion, now: number): void {
    this.motion = motion;
    this.answered = now;
    this.setNow(now);
  }

  /** Futures that begin after frame `at`. */
  setAnswer(answer: Answer, at: number): void {
    if (!this.motion) return;
    this.answer = answer;
    this.answered = at;
    poseAt(this.motion.track, at, this.startPose);
    this.drawTrails();
  }

  setLook(look: Look): void {
    this.look = look;
    this.drawTrails();
  }

  /** Draw a time in seconds from now. */
  draw(seconds: number): void {
    const { motion, answer, palette } = this;
    if (!motion || !palette) return;
    const frame = this.now + Math.min(seconds, 0) * motion.fps;
    this.body.begin(1);
    this.body.add(poseAt(motion.track, frame, this.pose), palette.body);
    this.body.end();
    const centre = this.rootOf(this.pose);

    const since = seconds + (this.now - this.answered) / motion.fps;
    const ahead = answer && seconds > 0 ? since * answer.fps - 1 : null;
    const there = this.drawFutures(ahead);
    this.drawTruth(seconds);
    if (ahead !== null && answer?.regions && this.look.regions) {
      this.regions.draw(answer.regions, this.joints, ahead);
    } else this.regions.hide();
    this.stage.follow(there ?? centre, centre);
    this.stage.invalidate();
  }

  /** Where they are on average. */
  private drawFutures(ahead: number | null): Vector3 | null {
    const { answer } = this;
    const { chosen, crowd } = ahead === null || !answer ? { chosen: [], crowd: [] } : this.shown();
    this.crowdMaterial.opacity = Math.min(0.5, 0.16 + 2 / Math.max(crowd.length, 1));
    this.crowd.begin(crowd.length);
    this.chosen.begin(chosen.length);
    const mean = new Vector3();
    for (const [figures, samples] of [[this.crowd, crowd], [this.chosen, chosen]] as const) {
      for (const sample of samples) {
        const track = answer?.futures[sample];
        if (!track || ahead === null) continue;
        this.futurePose(track, ahead);
        figures.add(this.pose, this.colourOf(sample, ahead));
        mean.add(this.rootOf(this.pose));
      }
      figures.end();
    }
    const count = chosen.length + crowd.length;
    return count > 0 ? mean.divideScalar(count) : null;
  }

  private drawTruth(seconds: number): void {
    const { motion, palette } = this;
    const frame = motion ? this.now + seconds * motion.fps : 0;
    const known = motion && seconds > 0 && this.look.truth && frame <= motion.track.frames - 1;
    this.truth.begin(1);
    if (known && palette) this.truth.add(poseAt(motion.track, frame, this.pose), palette.truth);
    this.truth.end();
  }

  private drawTrails(): void {
    const { motion, answer, palette, look } = this;
    if (!motion || !palette) return;
    const seen = { track: motion.track, to: this.now + 1, color: () => palette.body };
    const from = Math.max(0, Math.round(this.now - 3 * motion.fps));
    const truth: Trail = { track: motion.track, from: this.now, to: motion.track.frames, color: () => palette.truth };
    const { chosen, crowd } = answer ? this.shown() : { chosen: [], crowd: [] };
    const trail = (sample: number): Trail => ({
      track: (answer as Answer).futures[sample],
      from: 0,
      to: (answer as Answer).futures[sample].frames,
      start: this.startPose,
      color: (frame) => this.colourOf(sample, frame),
    });
    const on = look.trails;
    this.path.draw(on ? [{ ...seen, from }, ...(look.truth ? [truth] : [])] : [], this.root, this.ground);
    this.paths.draw(on ? crowd.map(trail) : [], this.root, this.ground);
    this.chosenPaths.draw(on ? chosen.map(trail) : [], this.root, this.ground);
    this.stage.invalidate();
  }

  /** The futures that stand for others, and the others. */
  private shown(): { chosen: number[]; crowd: number[] } {
    const { answer, look } = this;
    if (!answer) return { chosen: [], crowd: [] };
    const { solo } = look;
    if (solo && "sample" in solo) return { chosen: [solo.sample], crowd: [] };
    const all = answer.futures.map((_, sample) => sample);
    const mode = solo ? answer.modes[solo.mode] : null;
    const chosen = mode ? [mode.sample] : answer.modes.length > 0 ? answer.modes.map((m) => m.sample) : [0];
    const crowd = look.crowd ? (mode?.members ?? all).filter((sample) => !chosen.includes(sample)) : [];
    return { chosen: chosen.filter((sample) => sample < all.length), crowd };
  }

  private colourOf(sample: number, frame: number): Color {
    const { answer, palette } = this;
    if (!answer || !palette) return new Color();
    const segments = answer.segments[sample];
    const at = Math.max(0, Math.floor(frame));
    const index = segments
      ? this.actionColour((segments.find(({ end }) => at < end) ?? segments[segments.length - 1]).action)
      : Math.max(0, answer.modes.findIndex(({ members }) => members.includes(sample)));
    return palette.colours[index % palette.colours.length];
  }

  private futurePose(track: Track, frame: number): void {
    poseAt(track, frame, this.pose);
    if (frame >= 0) return;
    const share = Math.min(-frame, 1); // before the first frame: from the last one observed
    for (let i = 0; i < this.pose.length; i++) {
      this.pose[i] = this.pose[i] * (1 - share) + this.startPose[i] * share;
    }
  }

  private rootOf(pose: Float32Array): Vector3 {
    const at = this.root * 3;
    return new Vector3(pose[at], pose[at + 1], this.ground + 0.92);
  }

  /** Across the line from the right hip to the left. */
  private ahead(): Vector3 {
    const hips = this.motion && hipsOf(this.motion.skeleton.joints);
    if (!hips) return new Vector3(1, 0, 0);
    const [left, right] = hips.map((joint) => this.nowPose.subarray(joint * 3, joint * 3 + 2));
    return new Vector3(left[1] - right[1], right[0] - left[0], 0);
  }

  /** Where the person has gone in the last second, else where it goes next or looks, as an angle. */
  private heading(): number {
    if (!this.motion) return 0;
    const { track, fps } = this.motion;
    const other = new Float32Array(track.joints * 3);
    const before = this.rootOf(poseAt(track, this.now - fps, other));
    const here = this.rootOf(this.nowPose);
    const way = here.clone().sub(before);
    if (way.length() < 0.1) way.copy(this.rootOf(poseAt(track, this.now + 2 * fps, other))).sub(here);
    if (way.length() < 0.1) way.copy(this.ahead());
    return Math.atan2(way.y, way.x);
  }
}
