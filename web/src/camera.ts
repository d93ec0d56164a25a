/** A person before the camera as 33 points, by MediaPipe, whose files an operator may add. */

import type * as MediaPipe from "@mediapipe/tasks-vision";
import type { Point } from "./motion";

const FOLDER = "/viewer/mediapipe";
const BUNDLE = `${FOLDER}/vision_bundle.mjs`;
const MODEL = `${FOLDER}/pose_landmarker.task`;

export interface Camera {
  stop: () => void;
}

/** Throws, in a sentence for people, where the operator has not added MediaPipe's files. */
export async function checkFiles(): Promise<void> {
  for (const file of [BUNDLE, MODEL]) {
    const found = await fetch(file, { method: "HEAD" }).catch(() => null);
    if (found?.ok) continue;
    throw new Error(
      `The webcam needs MediaPipe, of which this server does not have ${file.slice(FOLDER.length + 1)}. ` +
        "Who runs it gets the files by `make webcam` and names their folder in POSEFUTURES_POSE_LANDMARKER.",
    );
  }
}

/**
 * Give each pose that is seen to `seen`: metres, x to the right, y down, z away, hips at the origin.
 *
 * Throws where the camera may not be used.
 */
export async function openCamera(
  video: HTMLVideoElement,
  seen: (points: Point[], seconds: number) => void,
): Promise<Camera> {
  const stream = await camera();
  try {
    const { FilesetResolver, PoseLandmarker } = (await import(BUNDLE)) as typeof MediaPipe;
    const landmarker = await PoseLandmarker.createFromOptions(
      await FilesetResolver.forVisionTasks(`${FOLDER}/wasm`),
      {
        baseOptions: { modelAssetPath: MODEL, delegate: "GPU" },
        runningMode: "VIDEO",
        numPoses: 1,
      },
    );
    video.srcObject = stream;
    video.hidden = false;
    await video.play();
    let running = true;
    const frame = (milliseconds: number): void => {
      if (!running) return;
      const [points] = landmarker.detectForVideo(video, milliseconds).worldLandmarks;
      if (points) seen(points.map(({ x, y, z }): Point => [x, y, z]), milliseconds / 1000);
      video.requestVideoFrameCallback(frame);
    };
    video.requestVideoFrameCallback(frame);
    return {
      stop: () => {
        running = false;
        landmarker.close();
        release(video, stream);
      },
    };
  } catch (cause) {
    release(video, stream);
    throw cause;
  }
}

async function camera(): Promise<MediaStream> {
  if (!navigator.mediaDevices) {
    throw new Error("Browsers give no camera to this page: it must come over https, or from localhost.");
  }
  try {
    return await navigator.mediaDevices.getUserMedia({ video: { width: 640, height: 480 } });
  } catch (cause) {
    throw new Error("The browser gives no camera: it was not allowed, or there is none.", { cause });
  }
}

function release(video: HTMLVideoElement, stream: MediaStream): void {
  for (const track of stream.getTracks()) track.stop();
  video.srcObject = null;
  video.hidden = true;
}
