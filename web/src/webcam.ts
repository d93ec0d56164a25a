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
const FPS = 30; // of the futures
const KEPT_FRAMES = 60;

export interface WebcamNews {
  moved: (motion: Motion) => void;
  /** Of a picture that was seen at `milliseconds` of the page. */
  answered: (answer: PredictResponse, axes: Axes, milliseconds: number) => void;
  waiting: (text: string) => void;
  failed: (error: unknown) => void;
}

export class Webcam {
  private camera: Camera | null = null;
  private live: Live | null = null;
  private seen: { pose: Point[]; seconds: number }[] = [];
  private ended = false;

  /** Begin, with what is asked of each prediction; throws where there is no camera. */
  async start(video: HTMLVideoElement, options: object, news: WebcamNews): Promise<void> {
    await checkFiles();
    const skeleton = await skeletonOf(SKELETON);
    const [calm, bones] = [new OneEuro(), new FixedBones(skeleton.parents)];
    const camera = await openCamera(video, (points, seconds) => {
      const pose = grounded(bones.fit(calm.filter(points, seconds)));
      this.seen = [...this.seen.slice(1 - KEPT_FRAMES), { pose, seconds }];
      this.live?.frame(pose, seconds);
      news.moved(this.motion(skeleton));
    });
    if (this.ended) return camera.stop(); // while the camera was still coming
    this.camera = camera;
    this.live = new Live(asked(options), {
      futures: (answer, seconds) => news.answered(answer, AXES, seconds * 1000),
      waiting: (have, need) => news.waiting(`watching: ${have.toFixed(1)} of ${need.toFixed(1)} s`),
      problem: (problem) => news.failed(new api.ProblemError(problem)),
      lost: () => news.failed(new api.AwayError("The live connection was lost.")),
    });
  }

  ask(options: object): void {
    this.live?.ask(asked(options));
  }

  /** At the rate at which poses came: cameras, and what finds people in their pictures, are slow or fast. */
  private motion(skeleton: Skeleton): Motion {
    const poses = this.seen.map(({ pose }) => pose);
    const passed = this.seen[this.seen.length - 1].seconds - this.seen[0].seconds;
    const fps = passed > 0 ? Math.round((poses.length - 1) / passed) || 1 : FPS;
    return { name: "webcam", poses, fps, axes: AXES, named: SKELETON, skeleton, track: trackOf(poses, AXES) };
  }

  stop(): void {
    this.ended = true;
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

async function skeletonOf(wanted: string): Promise<Skeleton> {
  const { skeletons } = await api.skeletons();
  const found = skeletons.find(({ name }) => name === wanted);
  if (!found) throw new Error(`This server knows no skeleton ${wanted}, which the webcam needs.`);
  return found;
}
