/** Joints of a body as the page draws them: parents, and the joints that people look at. */

export interface Skeleton {
  joints: string[];
  parents: number[];
}

const [LEFT, RIGHT] = [/^l|left|[_.:]l/i, /^r|right|[_.:]r/i];
const WRIST = [/wrist/i, /hand$/i];
const HIP = [/hip(?!s)/i, /up_?leg/i, /thigh|upper_?leg/i];

/** Indices of the joints whose regions are shown: root, head and both wrists. */
export function watched({ joints, parents }: Skeleton): number[] {
  const root = Math.max(0, parents.indexOf(-1));
  const found = [root, headOf(joints), jointOf(joints, WRIST, LEFT), jointOf(joints, WRIST, RIGHT)];
  return [...new Set(found.filter((joint) => joint >= 0))];
}

/** The joint at the base of the head; -1 where none is named so. */
export function headOf(joints: string[]): number {
  const head = joints.findIndex((name) => /(^|[^a-z])head$/i.test(name) || /^head/i.test(name));
  return head >= 0 ? head : joints.findIndex((name) => /nose|head/i.test(name));
}

/** Both hips, of which a person in between looks ahead; null where they are not named so. */
export function hipsOf(joints: string[]): [left: number, right: number] | null {
  const [left, right] = [jointOf(joints, HIP, LEFT), jointOf(joints, HIP, RIGHT)];
  return left >= 0 && right >= 0 ? [left, right] : null;
}

function jointOf(joints: string[], parts: RegExp[], side: RegExp): number {
  for (const part of parts) {
    const found = joints.findIndex((name) => part.test(name) && side.test(name));
    if (found >= 0) return found;
  }
  return -1;
}
