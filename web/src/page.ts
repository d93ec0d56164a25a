/** The page: what is chosen on it, what is asked of the server, and what is shown of the answer. */

import type { PredictActionsRequest, PredictRequest } from "../client";
import * as api from "./api";
import { button, element, input, made } from "./dom";
import { latest } from "./latest";
import { Models } from "./models";
import { ModeList } from "./modes";
import type { Motion } from "./motion";
import { onPaletteChange, readPalette } from "./palette";
import { Script } from "./script";
import { Server } from "./server";
import { DEMOS, demo, fromFiles } from "./sources";
import { Stage } from "./stage";
import { asCurl, asPython, type Question, save } from "./take";
import { Timeline } from "./timeline";
import { type Solo, View } from "./view";

const FIRST_NOW_S = 2.2; // into a demo
const MARGIN_S = 0.25; // observed beyond what the model sees
const MIN_QUANTILE_SAMPLES = 10;
const PREVIEW_MS = 110; // at least, for a step to be seen

let motion: Motion | null = null;
let now = 0;
let answer: api.Answer | null = null;
let solo: Solo = null;
const numSamples = { predict: 20, perform: 8 }; // an action is long, and so is an answer
let defaults: { predict: string | null; perform: string | null } = { predict: null, perform: null };

const script = new Script(() => {
  timeline.player.time = timeline.nowSeconds;
  timeline.player.playing = true;
  showPlaying();
  void ask();
});
const stage = new Stage(element<HTMLCanvasElement>("canvas"), tick);
const view = new View(stage, script.colourOf);
const timeline = new Timeline({ seek, setNow }, script.colourOf);
const models = new Models(fail, () => {
  adaptToModel();
  void ask();
});
const modes = new ModeList((chosen) => {
  solo = chosen;
  showLook();
});
const server = new Server(() => void begin());

const performing = () => input("ask-perform").checked;
const ask = latest(() => answered(false));

/** Called whenever the server has come, or come back. */
async function begin(): Promise<void> {
  try {
    const [found, known, most] = await Promise.all([api.models(), api.actions(), api.limits()]);
    models.set(found.models);
    defaults = { predict: found.default, perform: known.default_model };
    script.offer(known.actions, most.max_actions);
    input("num-samples").max = String(Math.min(100, most.max_samples));
    offerModels();
    if (motion) await ask();
    else await load(() => demo(Object.keys(DEMOS)[0]));
  } catch (error) {
    fail(error);
  }
}

function offerModels(): void {
  input("num-samples").value = String(numSamples[performing() ? "perform" : "predict"]);
  models.offer(performing(), performing() ? defaults.perform : defaults.predict);
  adaptToModel();
}

/** Let the controls be those of the question and the model. */
function adaptToModel(): void {
  element("script-box").hidden = !performing();
  for (const control of document.querySelectorAll<HTMLElement>(".predict-only")) {
    control.hidden = performing();
  }
  const steps = input("num-steps");
  const most = models.current?.num_steps ?? 0;
  const all = steps.value === steps.max;
  steps.disabled = button("denoise").disabled = most < 2;
  steps.max = String(Math.max(most, 1));
  if (all || Number(steps.value) > most) steps.value = steps.max;
  showSliders();
}

/** Show another motion; now is where most models have seen enough, or where a demo is alive. */
async function load(source: () => Promise<Motion>): Promise<void> {
  try {
    const found = await source();
    motion = found;
    answer = null;
    now = firstNow(found);
    timeline.set({ fps: found.fps, frames: found.track.frames }, now, null);
    timeline.player.time = timeline.nowSeconds;
    view.setMotion(found, now);
    const seconds = (found.track.frames / found.fps).toFixed(1);
    element("motion-text").textContent =
      `${found.name}: ${seconds} s, ${found.track.joints} joints at ${Number(found.fps.toFixed(2))} Hz`;
    for (const chip of element("demos").children) {
      chip.setAttribute("aria-pressed", String((chip as HTMLElement).dataset.demo === found.name));
    }
    hideNotice();
    await ask();
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) timeline.player.playing = true;
    else seek(timeline.nowSeconds + 1);
    showPlaying();
  } catch (error) {
    fail(error);
  }
}

function firstNow({ track, fps }: Motion): number {
  const last = track.frames - 1;
  return Math.min(last, Math.max(Math.round(FIRST_NOW_S * fps), Math.round(last * 0.3)));
}

/** The question that the page asks now. */
function question(): Question | null {
  const model = models.current;
  if (!motion || !model) return null;
  const sees = (model.num_observed ?? 1) / (model.fps ?? 30) + MARGIN_S;
  const from = Math.max(0, now + 1 - Math.ceil(sees * motion.fps));
  const about = {
    poses: motion.poses.slice(from, now + 1),
    ...(motion.named === undefined ? {} : { skeleton: motion.named }),
    axes: motion.axes,
    fps: motion.fps,
    num_samples: Number(input("num-samples").value),
    seed: Number(input("seed").value),
    model: model.name,
  };
  if (performing()) {
    const body: PredictActionsRequest = { ...about, actions: [...script.wanted] };
    return script.wanted.length > 0 ? { path: "/predict_actions", body } : null;
  }
  const steps = input("num-steps");
  const returned: PredictRequest["return"] = ["futures", "modes"];
  if (about.num_samples >= MIN_QUANTILE_SAMPLES) returned.push("quantiles");
  const body: PredictRequest = { ...about, return: returned, num_modes: Number(input("num-modes").value) };
  if (!steps.disabled && steps.value !== steps.max) body.num_steps = Number(steps.value);
  return { path: "/predict", body };
}

/** Ask, and show what comes; in steps, each step as it comes. */
async function answered(inSteps: boolean): Promise<void> {
  const asked = question();
  if (!asked || !motion) return;
  const { axes } = motion;
  try {
    const found =
      asked.path === "/predict_actions"
        ? await api.predictActions(asked.body as PredictActionsRequest, axes)
        : inSteps
          ? await api.predictInSteps(asked.body, axes, showPreview)
          : await api.predict(asked.body, axes);
    show(found);
    hideNotice();
  } catch (error) {
    fail(error);
  }
}

function show(found: api.Answer): void {
  if (!motion) return;
  answer = found;
  element("preview").hidden = true;
  modes.set(found);
  view.setAnswer(found);
  timeline.set({ fps: motion.fps, frames: motion.track.frames }, now, found);
  const { timing, steps, roundTripMs, warnings } = found;
  const inside = Object.values(timing).reduce((sum, ms) => sum + ms, 0);
  const run = steps && steps.of > 1 ? ` · ${steps.run} of ${steps.of} steps` : "";
  const told = element("timing");
  told.textContent =
    `${found.futures.length} futures · server ${inside.toFixed(0)} ms · round trip ${roundTripMs.toFixed(0)} ms${run}`;
  told.title = Object.entries(timing).map(([stage, ms]) => `${stage} ${ms.toFixed(1)} ms`).join(", ");
  Object.assign(told.dataset, { model: found.model, futures: String(found.futures.length), seed: String(found.seed) });
  element("warnings").replaceChildren(...warnings.map((warning) => made("li", warning)));
  showLook();
}

/** The futures as they stand after a step, for long enough to be seen. */
async function showPreview({ futures, steps }: api.Preview): Promise<void> {
  if (!answer || answer.segments.length > 0) return;
  view.setAnswer({ ...answer, futures, modes: answer.modes.filter(({ sample }) => sample < futures.length) });
  const told = element("preview");
  told.hidden = false;
  told.textContent = `denoising: step ${steps.run} of ${steps.of}`;
  told.dataset.step = String(steps.run);
  redraw();
  await new Promise((resolve) => setTimeout(resolve, PREVIEW_MS));
}

function showLook(): void {
  view.setLook({
    crowd: input("show-crowd").checked,
    trails: input("show-trails").checked,
    regions: input("show-regions").checked,
    truth: input("show-truth").checked,
    solo,
  });
  const sample = solo && "sample" in solo ? solo.sample : (answer?.modes[solo?.mode ?? 0]?.sample ?? 0);
  timeline.setSample(sample);
  element("legend-truth").hidden = !input("show-truth").checked;
  element("regions-text").textContent = regionsText();
  redraw();
}

function regionsText(): string {
  if (!input("show-regions").checked || !answer) return "";
  if (performing()) return "Regions are of what comes next, not of actions.";
  if (!answer.regions) return `Regions need ${MIN_QUANTILE_SAMPLES} futures or more.`;
  return answer.regions.calibrated
    ? "Of root, head and wrists; as wide as was measured on people that the model had not seen."
    : "Of root, head and wrists; as wide as the samples say, not measured on people.";
}

function showSliders(): void {
  for (const slider of document.querySelectorAll<HTMLInputElement>(".slider input")) {
    const told = slider.parentElement?.querySelector("output");
    if (told) told.textContent = slider.value;
  }
}

function redraw(): void {
  timeline.showTime();
  view.draw(timeline.player.time - timeline.nowSeconds);
}

function tick(seconds: number): boolean {
  const moved = timeline.player.tick(seconds);
  if (moved) redraw();
  return moved;
}

function seek(seconds: number): void {
  timeline.player.playing = false;
  timeline.player.time = Math.max(0, seconds);
  showPlaying();
  redraw();
}

function setNow(frame: number): void {
  if (!motion) return;
  const ahead = timeline.player.time - timeline.nowSeconds;
  now = timeline.bounded(frame);
  timeline.set({ fps: motion.fps, frames: motion.track.frames }, now, answer);
  timeline.player.time = timeline.nowSeconds + ahead;
  view.setNow(now);
  redraw();
  void ask();
}

function play(): void {
  timeline.player.playing = !timeline.player.playing;
  showPlaying();
}

function showPlaying(): void {
  const { playing } = timeline.player;
  button("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  element("play-icon").setAttribute("d", playing ? "M7 5h4v14H7zM13 5h4v14h-4z" : "M8 5v14l11-7z");
}

/** Say what went wrong; where the server is away, the page goes on when it is back. */
function fail(error: unknown): void {
  if (error instanceof api.AwayError) server.lost();
  else {
    const wantsKey = error instanceof api.ProblemError && error.problem.status === 401;
    element("notice-text").textContent = error instanceof Error ? error.message : String(error);
    element("key-form").hidden = !wantsKey;
    element("notice").hidden = false;
  }
}

function hideNotice(): void {
  element("notice").hidden = true;
}

function copy(text: string): void {
  const told = element("take-text");
  navigator.clipboard.writeText(text).then(
    () => (told.textContent = `Copied ${text.length} characters.`),
    () => (told.textContent = "The browser did not let the page copy."),
  );
}

/** The request for the one future that is shown alone, or else for all. */
async function download(mediaType: string, suffix: string): Promise<void> {
  const asked = question();
  if (!asked) return;
  try {
    await save(asked, mediaType, `${motion?.name.replace(/\.\w+$/, "") ?? "motion"}-futures.${suffix}`);
  } catch (error) {
    fail(error);
  }
}

const KEYS: Record<string, () => void> = {
  " ": play,
  ",": () => motion && seek(timeline.player.time - 1 / motion.fps),
  ".": () => motion && seek(timeline.player.time + 1 / motion.fps),
  n: () => motion && setNow(timeline.player.time * motion.fps),
  t: () => input("show-truth").click(),
  r: () => input("show-regions").click(),
  Escape: () => modes.choose(null),
};
const TURNS: Record<string, [azimuth: number, closer: number]> = {
  ArrowLeft: [0.12, 1], ArrowRight: [-0.12, 1], "+": [0, 0.9], "-": [0, 1.1],
};

function listen(): void {
  document.addEventListener("keydown", (event) => {
    const target = event.target as HTMLElement;
    const typing = target.closest("dialog[open], select, input:not([type=range], [type=checkbox], [type=radio])");
    const pressing = event.key === " " && target.closest("button, input[type=checkbox], input[type=radio], a");
    if (typing || pressing || event.ctrlKey || event.metaKey || event.altKey) return;
    const turn = target.id === "canvas" ? TURNS[event.key] : undefined;
    const act = turn ? () => stage.orbit(...turn) : KEYS[event.key];
    if (act) act();
    else if (/^[1-8]$/.test(event.key)) modes.toggle(Number(event.key) - 1);
    else return;
    event.preventDefault();
  });
  button("play").addEventListener("click", play);
  for (const radio of document.querySelectorAll("input[name=ask]")) {
    radio.addEventListener("change", () => {
      offerModels();
      void ask();
    });
  }
  for (const slider of document.querySelectorAll(".slider input")) {
    slider.addEventListener("input", () => {
      numSamples[performing() ? "perform" : "predict"] = Number(input("num-samples").value);
      showSliders();
      void ask();
    });
  }
  for (const id of ["show-crowd", "show-trails", "show-regions", "show-truth"]) {
    input(id).addEventListener("change", showLook);
  }
  button("denoise").addEventListener("click", () => {
    timeline.player.playing = false;
    seek(Math.max(timeline.player.time, timeline.nowSeconds + 1));
    void answered(true);
  });
  button("copy-curl").addEventListener("click", () => copy(asCurl(question() ?? unasked())));
  button("copy-python").addEventListener("click", () => copy(asPython(question() ?? unasked())));
  button("save-bvh").addEventListener("click", () => void download("model/bvh", "bvh"));
  button("save-json").addEventListener("click", () => void download("application/json", "json"));
  button("notice-close").addEventListener("click", hideNotice);
  element("key-form").addEventListener("submit", (event) => {
    event.preventDefault();
    api.useKey(input("key").value);
    hideNotice();
    void begin();
  });
  onPaletteChange(() => view.paint(readPalette()));
  listenForFiles();
}

function unasked(): Question {
  throw new Error("nothing is asked yet");
}

function listenForFiles(): void {
  for (const [name, label] of Object.entries(DEMOS)) {
    const chip = made("button", label, { type: "button", className: "chip" });
    chip.dataset.demo = name;
    chip.addEventListener("click", () => void load(() => demo(name)));
    element("demos").append(chip);
  }
  const open = (files: FileList | null | undefined) => {
    const some = [...(files ?? [])];
    if (some.length > 0) void load(() => fromFiles(some));
  };
  const chooser = input("file");
  button("open").addEventListener("click", () => chooser.click());
  chooser.addEventListener("change", () => {
    open(chooser.files);
    chooser.value = "";
  });
  const over = (on: boolean) => document.body.classList.toggle("dropping", on);
  document.addEventListener("dragover", (event) => {
    event.preventDefault();
    over(true);
  });
  document.addEventListener("dragleave", ({ relatedTarget }) => relatedTarget ?? over(false));
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    over(false);
    open(event.dataTransfer?.files);
  });
}

listen();
showSliders();
view.paint(readPalette());
void server.look();
