/** What is chosen in the controls, and the question that it makes of a motion. */

import type { ModelSummary, PredictRequest } from "../client";
import { button, element, input } from "./dom";
import type { Motion } from "./motion";
import type { Question } from "./take";
import type { Look } from "./view";

export const MIN_QUANTILE_SAMPLES = 10;

const MARGIN_S = 0.25; // observed beyond what the model sees

/** How many futures, for each kind of question; an action is long, and so is its answer. */
const numSamples = { predict: "20", perform: "8" };

type Model = ModelSummary | null;

export const performing = () => input("ask-perform").checked;
const kind = () => (performing() ? "perform" : "predict");

/** Let the controls be those of the question and the model. */
export function adaptTo(model: Model): void {
  element("script-box").hidden = !performing();
  for (const control of document.querySelectorAll<HTMLElement>(".predict-only")) {
    control.hidden = performing();
  }
  input("num-samples").value = numSamples[kind()];
  const steps = input("num-steps");
  const most = Math.max(model?.num_steps ?? 1, 1);
  const wasUsual = steps.value === (steps.dataset.usual ?? steps.value);
  steps.disabled = button("denoise").disabled = most < 2;
  steps.max = String(most);
  steps.dataset.usual = String(model?.default_steps ?? most);
  if (wasUsual || Number(steps.value) > most) steps.value = steps.dataset.usual;
  showSliders();
}

/** Say the values of the sliders beside them. */
export function showSliders(): void {
  numSamples[kind()] = input("num-samples").value;
  for (const slider of document.querySelectorAll<HTMLInputElement>(".slider input")) {
    const told = slider.parentElement?.querySelector("output");
    if (told) told.textContent = slider.value;
  }
}

export function look(): Omit<Look, "solo"> {
  return {
    crowd: input("show-crowd").checked,
    trails: input("show-trails").checked,
    regions: input("show-regions").checked,
    truth: input("show-truth").checked,
  };
}

/** What is asked of a prediction, beside the motion. */
export function options(model: Model) {
  const num_samples = Number(input("num-samples").value);
  const about = { model: model?.name ?? null, num_samples, seed: Number(input("seed").value) };
  return performing() ? about : { ...about, ...ofPredictions(num_samples) };
}

function ofPredictions(numSamples: number): Partial<PredictRequest> {
  const steps = input("num-steps");
  const returned: PredictRequest["return"] = ["futures", "modes"];
  if (numSamples >= MIN_QUANTILE_SAMPLES) returned.push("quantiles");
  return {
    return: returned,
    num_modes: Number(input("num-modes").value),
    ...(steps.value === steps.dataset.usual ? {} : { num_steps: Number(steps.value) }),
  };
}

/** What is asked of a motion whose frame `now` is the last one seen; null without a script. */
export function questionOf(
  motion: Motion,
  now: number,
  model: Model,
  script: readonly string[],
): Question | null {
  if (!model) return null;
  const sees = (model.num_observed ?? 1) / (model.fps ?? 30) + MARGIN_S;
  const from = Math.max(0, now + 1 - Math.ceil(sees * motion.fps));
  const observed = {
    poses: motion.poses.slice(from, now + 1),
    ...(motion.named === undefined ? {} : { skeleton: motion.named }),
    axes: motion.axes,
    fps: motion.fps,
  };
  if (!performing()) return { path: "/predict", body: { ...observed, ...options(model) } };
  if (script.length === 0) return null;
  return { path: "/predict_actions", body: { ...observed, ...options(model), actions: [...script] } };
}
