/** What the page asks the server, and what it tells people when there is no answer. */

import * as api from "../client";
import type { ActionSegment, Mode, Problem, PredictActionsRequest, PredictRequest } from "../client";
import { client } from "../client/client.gen";
import { type Axes, metres, type Poses, trackOf, type Track } from "./motion";
import type { Regions } from "./regions";

client.setConfig({ baseUrl: location.origin });

/** The server cannot be reached, or is starting or stopping. */
export class AwayError extends Error {}

/** The server has said what is wrong, in its own words. */
export class ProblemError extends Error {
  constructor(readonly problem: Problem) {
    super(problem.detail);
  }
}

export interface Answer {
  fps: number;
  model: string;
  seed: number;
  futures: Track[];
  segments: ActionSegment[][];
  modes: Mode[];
  regions: Regions | null;
  steps: api.Steps | null;
  warnings: string[];
  timing: Record<string, number>;
  roundTripMs: number;
}

export interface Preview {
  futures: Track[];
  steps: { run: number; of: number };
}

let key: string | null = null;

/** Send this key with each request from now on. */
export function useKey(wanted: string): void {
  key = wanted;
  client.setConfig({ headers: headers() });
}

/** What goes with each request. */
export const headers = (): Record<string, string> => (key ? { Authorization: `Bearer ${key}` } : {});

/** What goes with a WebSocket, of which browsers let no more be said: its name, and a key in base64url. */
export function protocols(): string[] {
  if (!key) return [];
  const text = btoa(String.fromCharCode(...new TextEncoder().encode(key)));
  const safe = text.replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
  return ["posefutures", `posefutures.bearer.${safe}`];
}

interface Reply<T> {
  data?: T;
  error?: unknown;
  response?: Response;
}

/** The data of a reply; every way in which there is none is one of two errors. */
async function told<T>(asked: Promise<Reply<T>>): Promise<T> {
  const { data, error, response } = await asked.catch((cause: unknown) => {
    if (cause instanceof DOMException && cause.name === "AbortError") throw cause;
    throw new AwayError("The server does not answer.", { cause });
  });
  if (response?.ok && data !== undefined) return data;
  const problem = error as Partial<Problem> | undefined;
  if (!response || response.status === 503 || !problem?.detail) {
    throw new AwayError(problem?.detail ?? "The server does not answer.");
  }
  throw new ProblemError(problem as Problem);
}

export const models = () => told(api.models());
export const model = (name: string) => told(api.model({ path: { name } }));
export const actions = () => told(api.actions());
export const skeletons = () => told(api.skeletons());
export const limits = () => told(api.limits());

/** Whether predictions are answered; loading and draining count as away. */
export const ready = () => told(api.readyz());

export async function predict(body: PredictRequest, axes: Axes): Promise<Answer> {
  const started = performance.now();
  const found = await told(api.predict({ body }));
  return answerOf(found, axes, started);
}

/** The same; `show` gets the futures as they stand after each step. */
export async function predictInSteps(
  body: PredictRequest,
  axes: Axes,
  show: (preview: Preview) => Promise<void>,
): Promise<Answer> {
  const started = performance.now();
  const headers = { Accept: "application/x-ndjson" };
  const stream: unknown = await told(api.predict({ body, headers, parseAs: "stream" }));
  for await (const { event, data } of lines(stream as ReadableStream)) {
    if (event === "preview") {
      const { futures, steps } = data as { futures: Poses[]; steps: Preview["steps"] };
      await show({ futures: futures.map((poses) => trackOf(poses, axes)), steps });
    } else if (event === "final") return answerOf(data as api.PredictResponse, axes, started);
    else if (event === "error") throw new ProblemError(data as Problem);
  }
  throw new AwayError("The server stopped in the midst of its answer.");
}

export async function predictActions(body: PredictActionsRequest, axes: Axes): Promise<Answer> {
  const started = performance.now();
  const found = await told(api.predictActions({ body }));
  const futures = found.futures ?? [];
  return {
    ...about(found, started),
    futures: futures.map(({ poses }) => trackOf(poses as Poses, axes)),
    segments: futures.map(({ segments }) => segments),
    modes: [],
    regions: null,
    steps: null,
  };
}

export function answerOf(found: api.PredictResponse, axes: Axes, started: number): Answer {
  return {
    ...about(found, started),
    futures: (found.futures ?? []).map((poses) => trackOf(poses as Poses, axes)),
    segments: [],
    modes: found.modes ?? [],
    regions: found.quantiles ? regionsOf(found.quantiles, axes) : null,
    steps: found.steps,
  };
}

type Said = api.PredictResponse | api.PredictActionsResponse;

function about({ fps, model, seed, warnings, timing_ms }: Said, started: number) {
  const roundTripMs = performance.now() - started;
  return { fps, model: model.name, seed, warnings, timing: timing_ms, roundTripMs };
}

function regionsOf({ levels, calibrated, centre, radius }: api.Quantiles, axes: Axes): Regions {
  const flat = (radius as number[][][]).flat(2).map((length) => metres(length, axes));
  return {
    levels,
    calibrated,
    centre: trackOf(centre as Poses, axes),
    radius: Float32Array.from(flat),
  };
}

interface Line {
  event: string;
  data: unknown;
}

async function* lines(stream: ReadableStream<BufferSource>): AsyncGenerator<Line> {
  const reader = stream.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read().catch((cause: unknown) => {
      throw new AwayError("The connection to the server was lost.", { cause });
    });
    if (done) return;
    const parts = (rest + value).split("\n");
    rest = parts.pop() ?? "";
    for (const part of parts) if (part) yield JSON.parse(part) as Line;
  }
}

/** What the server finds in a motion file. */
export const observations = (file: File | Blob, name: string) =>
  told(api.observations({ body: file, query: { name } }));
