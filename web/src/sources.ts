/** Where motions come from: the demos beside the page, and files that people bring. */

import { zipSync } from "fflate";
import type { PredictRequest } from "../client";
import * as api from "./api";
import { type Axes, METRES_Z_UP, type Motion, type Poses, trackOf } from "./motion";
import type { Skeleton } from "./skeleton";

export const DEMOS: Record<string, string> = {
  "stroll-and-wave": "Stroll",
  "round-the-corner": "Corner",
  sprint: "Sprint",
  hello: "Hello",
};

/** What POST /predict takes of a motion; `parents` say how to draw it. */
interface Observed {
  poses: Poses;
  skeleton?: PredictRequest["skeleton"];
  axes?: Partial<Axes>;
  fps?: number;
  name?: string;
  parents?: number[];
}

export async function demo(name: string): Promise<Motion> {
  const answer = await fetch(`/viewer/demos/${name}.json`).catch((cause: unknown) => {
    throw new api.AwayError("The server does not answer.", { cause });
  });
  return motionOf((await answer.json()) as Observed, name);
}

/**
 * The motion in a file, or in files that need each other, such as an .amc and its .asf.
 *
 * JSON in the shape of a request is read here, the rest by the server.
 */
export async function fromFiles(files: File[]): Promise<Motion> {
  const [file] = files;
  if (files.length > 1) {
    const contents = files.map(async (one) => [one.name, new Uint8Array(await one.arrayBuffer())]);
    const zip = zipSync(Object.fromEntries(await Promise.all(contents)));
    return motionOf((await api.observations(new Blob([zip as Uint8Array<ArrayBuffer>]), "motion.zip")) as Observed, file.name);
  }
  const found = /\.json$/i.test(file.name) ? asObserved(await file.text()) : null;
  return motionOf(found ?? ((await api.observations(file, file.name)) as Observed), file.name);
}

function asObserved(text: string): Observed | null {
  try {
    const found = JSON.parse(text) as Partial<Observed> | null;
    return Array.isArray(found?.poses) ? (found as Observed) : null;
  } catch {
    return null; // the server says what is wrong with it
  }
}

async function motionOf(found: Observed, name: string): Promise<Motion> {
  const { axes: usual, ...skeleton } = await skeletonOf(found);
  const axes = { ...METRES_Z_UP, ...usual, ...found.axes };
  const track = trackOf(found.poses, axes);
  if (track.joints !== skeleton.joints.length) {
    throw new Error(
      `${name}: found poses of ${track.joints} joints; its skeleton has ${skeleton.joints.length}.`,
    );
  }
  return {
    name: found.name ?? name,
    poses: found.poses,
    fps: found.fps ?? 30,
    axes,
    named: found.skeleton,
    skeleton,
    track,
  };
}

/** Names and parents, and the usual axes; joints without parents stand alone. */
async function skeletonOf({ skeleton, parents, poses }: Observed): Promise<Skeleton & { axes?: Partial<Axes> }> {
  if (skeleton && typeof skeleton === "object") {
    const alone = skeleton.joints.map(() => -1);
    return { joints: skeleton.joints, parents: parents ?? skeleton.parents ?? alone };
  }
  const { skeletons } = await api.skeletons();
  const count = poses[0]?.length;
  const standard =
    skeletons.find(({ name }) => name === skeleton) ??
    skeletons.find(({ joints }) => !skeleton && joints.length === count);
  if (!standard) throw new Error(`skeleton: found ${skeleton ?? "none"}; GET /skeletons lists them.`);
  return { joints: standard.joints, parents: parents ?? standard.parents, axes: standard.axes };
}
