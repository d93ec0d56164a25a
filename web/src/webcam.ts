/** A person before the webcam as a motion that goes on, and its futures ten times a second. */

import type { PredictResponse } from "../client";
import * as api from "./api";
import { type Camera, checkFiles, openCamera } from "./camera";
import { Live } from "./live";
import { type Axes, type Motion, type Point, trackOf } from "./motion";
import type { Skeleton } from "./skeleton";
import { FixedBones, OneEuro } from "./smoothing";

const SKELETON = "mediapipe33";
const AXES: Axes = { up: "-y", units: "m" };
const FPS = 30; // about what cameras give; the server goes by the times of the frames
const KEPT_FRAMES = 60;

export interface WebcamNews {
  moved: (motion: Motion) => void;
  answered: (answer: PredictResponse, axes: Axes) => void;
  waiting: (text: string) => void;
  failed: (error: unknown) => void;
}

export class Webcam {
  private camera: Camera | null = null;
  private live: Live | null = null;
  private poses: Point[][] = [];

  /** Begin, with what is asked of each prediction; throws where there is no camera. */
  async start(video: HTMLVideoElement, options: object, news: WebcamNews): Promise<void> {
    await checkFiles();
    const skeleton = await skeletonOf(SKELETON);
    const [calm, bones] = [new OneEuro(), new FixedBones(skeleton.parents)];
    this.camera = await openCamera(video, (points, seconds) => {
      const pose = grounded(bones.fit(calm.filter(points, seconds)));
      this.poses = [...this.poses.slice(1 - KEPT_FRAMES), pose];
      this.live?.frame(pose, seconds);
      news.moved(motionOf(this.poses, skeleton));
    });
    this.live = new Live(asked(options), {
      futures: (answer) => news.answered(answer, AXES),
      waiting: (have, need) => news.waiting(`watching: ${have.toFixed(1)} of ${need.toFixed(1)} s`),
      problem: (problem) => news.failed(new api.ProblemError(problem)),
      lost: () => news.failed(new api.AwayError("The live connection was lost.")),
    });
  }

  ask(options: object): void {
    this.live?.ask(asked(options));
  }

  stop(): void {
    this.live?.end();
    this.camera?.stop();
  }
}

const asked = (options: object) => ({ ...options, skeleton: SKELETON, axes: AXES, fps: FPS });

/** The lowest joint stands on the ground: what MediaPipe sees has no place in the world. */
function grounded(pose: Point[]): Point[] {
  const lowest = Math.max(...pose.map(([, down]) => down));
  return pose.map(([x, down, z]) => [x, down - lowest, z]);
}

function motionOf(poses: Point[][], skeleton: Skeleton): Motion {
  const track = trackOf(poses, AXES);
  return { name: "webcam", poses, fps: FPS, axes: AXES, named: SKELETON, skeleton, track };
}

async function skeletonOf(wanted: string): Promise<Skeleton> {
  const { skeletons } = await api.skeletons();
  const found = skeletons.find(({ name }) => name === wanted);
  if (!found) throw new Error(`This server knows no skeleton ${wanted}, which the webcam needs.`);
  return found;
}
