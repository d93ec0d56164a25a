/** Joints of a body as the page draws them: parents, and the joints that people look at. */

export interface Skeleton {
  joints: string[];
  parents: number[];
}

const [LEFT, RIGHT] = [/^l|left|[_.:]l/i, /^r|right|[_.:]r/i];
const WRIST = [/wrist/i, /hand$/i];
const SHOULDER = [/shoulder/i];
const HIP = [/up_?leg/i, /thigh|upper_?leg|femur/i, /hip(?!s)/i];

/** Indices of the joints whose regions are shown: root, head and both wrists. */
export function watched({ joints, parents }: Skeleton): number[] {
  const root = rootOf({ joints, parents });
  const found = [root, headOf(joints), jointOf(joints, WRIST, LEFT), jointOf(joints, WRIST, RIGHT)];
  return [...new Set(found.filter((joint) => joint >= 0))];
}

/** Where both legs meet; one of the hips in bodies that hang from their head. */
export function rootOf({ joints, parents }: Skeleton): number {
  const hips = hipsOf(joints);
  if (!hips) return Math.max(0, parents.indexOf(-1));
  const [left, right] = hips.map((hip) => lineOf(parents, hip));
  const meeting = left.find((joint) => right.includes(joint)) ?? hips[0];
  return meeting === headOf(joints) ? hips[0] : meeting;
}

/** A joint, its parent, and so on. */
function lineOf(parents: number[], joint: number): number[] {
  return joint < 0 ? [] : [joint, ...lineOf(parents, parents[joint])];
}

/** The joint at the base of the head; -1 where none is named so. */
export function headOf(joints: string[]): number {
  const head = joints.findIndex((name) => /(^|[^a-z])head$/i.test(name) || /^head/i.test(name));
  return head >= 0 ? head : joints.findIndex((name) => /nose|head/i.test(name));
}

/** Both hips, of which a person in between looks ahead; null where they are not named so. */
export const hipsOf = (joints: string[]) => bothOf(joints, HIP);

/** Both shoulders, likewise. */
export const shouldersOf = (joints: string[]) => bothOf(joints, SHOULDER);

function bothOf(joints: string[], parts: RegExp[]): [left: number, right: number] | null {
  const [left, right] = [jointOf(joints, parts, LEFT), jointOf(joints, parts, RIGHT)];
  return left >= 0 && right >= 0 ? [left, right] : null;
}

function jointOf(joints: string[], parts: RegExp[], side: RegExp): number {
  for (const part of parts) {
    const found = joints.findIndex((name) => part.test(name) && side.test(name));
    if (found >= 0) return found;
  }
  return -1;
}
