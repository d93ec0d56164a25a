/** What people take away: the request as a command or a program, and futures as files. */

import type { PredictActionsRequest, PredictRequest } from "../client";
import { AwayError, ProblemError } from "./api";
import type { Problem } from "../client";

export interface Question {
  path: "/predict" | "/predict_actions";
  body: PredictRequest | PredictActionsRequest;
}

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

/** Ask again for an answer as a file of some media type, and hand it to the browser. */
export async function save({ path, body }: Question, mediaType: string, name: string): Promise<void> {
  const answer = await fetch(path, {
    method: "POST",
    headers: { "Content-Type": "application/json", Accept: mediaType },
    body: JSON.stringify(body),
  }).catch((cause: unknown) => {
    throw new AwayError("The server does not answer.", { cause });
  });
  if (!answer.ok) throw new ProblemError((await answer.json()) as Problem);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await answer.blob());
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
