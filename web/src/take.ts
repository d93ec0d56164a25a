/** What people take away: the request as a command or a program, and futures as files. */

import { strFromU8, unzipSync } from "fflate";
import type { PredictActionsRequest, PredictRequest, Problem } from "../client";
import { AwayError, headers, ProblemError } from "./api";

export interface Question {
  path: "/predict" | "/predict_actions";
  body: PredictRequest | PredictActionsRequest;
}

const MEDIA_TYPES = { bvh: "model/bvh", glb: "model/gltf-binary", json: "application/json" };
export type Suffix = keyof typeof MEDIA_TYPES;

export function asCurl({ path, body }: Question): string {
  const json = JSON.stringify(body).replaceAll("'", "'\\''");
  return `curl -s ${location.origin}${path} -H 'content-type: application/json' -d '${json}'\n`;
}

export function asPython({ path, body }: Question): string {
  return [
    "import json",
    "",
    "import httpx",
    "",
    `request = json.loads(r"""${JSON.stringify(body)}""")`,
    `answer = httpx.post("${location.origin}${path}", json=request).raise_for_status().json()`,
    'print(len(answer["futures"]), "futures by", answer["model"]["name"], answer["timing_ms"])',
    "",
  ].join("\n");
}

/**
 * Ask again for an answer as a file of one sample, or of all, which are a zip unless in JSON; its name.
 *
 * The first k futures do not depend on how many are asked for, so no more than needed are.
 */
export async function save(question: Question, suffix: Suffix, name: string, sample: number | null): Promise<string> {
  const { path, body } = question;
  const wanted = sample === null ? body : { ...body, num_samples: sample + 1 };
  if (sample !== null && path === "/predict") Object.assign(wanted, { return: ["futures"] });
  const answer = await fetch(path, {
    method: "POST",
    headers: { ...headers(), "Content-Type": "application/json", Accept: MEDIA_TYPES[suffix] },
    body: JSON.stringify(wanted),
  }).catch((cause: unknown) => {
    throw new AwayError("The server does not answer.", { cause });
  });
  if (!answer.ok) throw new ProblemError((await answer.json()) as Problem);
  const zipped = answer.headers.get("content-type") === "application/zip";
  const content = new Uint8Array(await answer.arrayBuffer());
  if (sample === null) return hand(content, `${name}s.${zipped ? "zip" : suffix}`);
  const alone = zipped ? oneOf(content, suffix) : suffix === "json" ? last(content) : content;
  return hand(alone, `${name}-${sample + 1}.${suffix}`);
}

/** The last file of a zip of that kind. */
function oneOf(zip: Uint8Array, suffix: Suffix): Uint8Array {
  const files = unzipSync(zip, { filter: ({ name }) => name.endsWith(suffix) && name !== "answer.json" });
  return files[Object.keys(files).sort().pop() ?? ""];
}

/** An answer in JSON with its last future alone. */
function last(json: Uint8Array): Uint8Array {
  const answer = JSON.parse(strFromU8(json)) as { futures: unknown[] };
  return new TextEncoder().encode(JSON.stringify({ ...answer, futures: answer.futures.slice(-1) }));
}

/** Let the browser keep it; its name. */
function hand(content: Uint8Array, name: string): string {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content as Uint8Array<ArrayBuffer>]));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  return name;
}
