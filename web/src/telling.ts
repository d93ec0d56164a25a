/** What the page says of a motion and of an answer, in words. */

import type { Answer } from "./api";
import { MIN_QUANTILE_SAMPLES, performing } from "./choices";
import { element, made } from "./dom";
import type { Motion } from "./motion";

export function tellMotion({ name, fps, track }: Motion): void {
  const seconds = (track.frames / fps).toFixed(1);
  tellSource(name, `${name}: ${seconds} s, ${track.joints} joints at ${Number(fps.toFixed(2))} Hz`);
}

export function tellWebcam(): void {
  tellSource("webcam", "You, as the camera sees you; nothing is stored.");
}

function tellSource(name: string, text: string): void {
  element("motion-text").textContent = text;
  element("timing").removeAttribute("data-futures"); // there are none of it yet
  for (const chip of element("demos").children) {
    chip.setAttribute("aria-pressed", String((chip as HTMLElement).dataset.demo === name));
  }
}

export function tellAnswer({ futures, model, seed, timing, steps, roundTripMs, warnings }: Answer): void {
  const inside = Object.values(timing).reduce((sum, ms) => sum + ms, 0);
  const run = steps && steps.of > 1 ? ` · ${steps.run} of ${steps.of} steps` : "";
  const told = element("timing");
  told.textContent =
    `${futures.length} futures · server ${inside.toFixed(0)} ms · round trip ${roundTripMs.toFixed(0)} ms${run}`;
  told.title = Object.entries(timing).map(([stage, ms]) => `${stage} ${ms.toFixed(1)} ms`).join(", ");
  Object.assign(told.dataset, { model, futures: String(futures.length), seed: String(seed) });
  element("warnings").replaceChildren(...warnings.map((warning) => made("li", warning)));
}

export function tellRegions(answer: Answer | null, wanted: boolean): void {
  element("regions-text").textContent = wanted && answer ? aboutRegions(answer) : "";
}

function aboutRegions({ regions }: Answer): string {
  if (performing()) return "Regions are of what comes next, not of actions.";
  if (!regions) return `Regions need ${MIN_QUANTILE_SAMPLES} futures or more.`;
  return regions.calibrated
    ? "Of root, head and wrists; as wide as was measured on people that the model had not seen."
    : "Of root, head and wrists; as wide as the samples say, not measured on people.";
}
