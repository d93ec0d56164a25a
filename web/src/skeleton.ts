/** Joints of a body as the page draws them: parents, and the joints that people look at. */

export interface Skeleton {
  joints: string[];
  parents: number[];
}

/** Indices of the joints whose regions are shown: root, head and both wrists. */
export function watched({ joints, parents }: Skeleton): number[] {
  const root = Math.max(0, parents.indexOf(-1));
  const found = [root, headOf(joints), wristOf(joints, /^l|left|[_.:]l/i), wristOf(joints, /^r|right|[_.:]r/i)];
  return [...new Set(found.filter((joint) => joint >= 0))];
}

/** The joint at the base of the head; -1 where none is named so. */
export function headOf(joints: string[]): number {
  const head = joints.findIndex((name) => /(^|[^a-z])head$/i.test(name) || /^head/i.test(name));
  return head >= 0 ? head : joints.findIndex((name) => /nose|head/i.test(name));
}

function wristOf(joints: string[], side: RegExp): number {
  for (const part of [/wrist/i, /hand$/i]) {
    const found = joints.findIndex((name) => part.test(name) && side.test(name));
    if (found >= 0) return found;
  }
  return -1;
}
