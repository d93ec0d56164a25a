/** The page: what is chosen on it, what is asked of the server, and what is shown of the answer. */

import type { PredictActionsRequest } from "../client";
import * as api from "./api";
import { adaptTo, look, options, performing, questionOf, showSliders } from "./choices";
import { button, element, input, made } from "./dom";
import { listenForFiles } from "./files";
import { listenForKeys } from "./keys";
import { latest } from "./latest";
import { Models } from "./models";
import { ModeList } from "./modes";
import type { Axes, Motion } from "./motion";
import { Notice, type Subject } from "./notice";
import { onPaletteChange, readPalette } from "./palette";
import { Script } from "./script";
import { Server } from "./server";
import { DEMOS, demo, fromFiles } from "./sources";
import { Stage } from "./stage";
import { asCurl, asPython, type Question, save, type Suffix } from "./take";
import { tellAnswer, tellMotion, tellRegions, tellWebcam } from "./telling";
import { Timeline } from "./timeline";
import { type Solo, View } from "./view";
import { Webcam } from "./webcam";

const FIRST_NOW_S = 2.2; // into a demo
const PREVIEW_MS = 110; // at least, for a step to be seen
const LIVE_AHEAD_S = 0.6; // how far into the future the page looks with the webcam

let motion: Motion | null = null;
let now = 0;
let answer: api.Answer | null = null;
let webcam: Webcam | null = null;
let solo: Solo = null;
let loads = 0;
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
  adaptTo(models.current);
  void ask();
});
const modes = new ModeList((chosen) => {
  solo = chosen;
  showLook();
});
const notice = new Notice((key) => {
  api.useKey(key);
  void begin();
});
const server = new Server(() => void begin());

const ask = latest(() => answered(false));
const question = () => motion && questionOf(motion, now, models.current, script.wanted);

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
  models.offer(performing(), performing() ? defaults.perform : defaults.predict);
  adaptTo(models.current);
}

/** Watch the webcam, or stop watching it. */
async function watch(): Promise<void> {
  if (webcam) return stopWatching();
  loads++; // a motion that is still being read would end it
  const mine = (webcam = new Webcam());
  button("webcam").setAttribute("aria-pressed", "true");
  element("motion-text").textContent = "The camera is coming…";
  input("ask-predict").click();
  try {
    await mine.start(element<HTMLVideoElement>("video"), options(models.current), {
      moved: sawFrame,
      answered: (found, axes: Axes, seen) => {
        show(api.answerOf(found, axes, seen), now);
        notice.hide("answer");
      },
      waiting: (text) => (element("timing").textContent = text),
      failed: (error) => fail(error, "answer"),
    });
  } catch (error) {
    if (mine !== webcam) return; // nobody waits for it any more
    stopWatching();
    fail(error);
  }
}

function stopWatching(): void {
  webcam?.stop();
  webcam = null;
  button("webcam").setAttribute("aria-pressed", "false");
}

/** A frame of the webcam, which is now. */
function sawFrame(found: Motion): void {
  const first = motion?.name !== found.name;
  const ahead = first ? LIVE_AHEAD_S : timeline.player.time - timeline.nowSeconds;
  if (first) answer = null;
  motion = found;
  now = found.track.frames - 1;
  timeline.player.playing = false;
  timeline.set(found, now, answer);
  timeline.player.time = timeline.nowSeconds + ahead;
  if (first) {
    tellWebcam();
    view.setMotion(found, now);
    showPlaying();
  } else view.replaceMotion(found, now);
  redraw();
}

/** Show another motion, unless a later one is wanted by the time it is there. */
async function load(source: () => Promise<Motion>): Promise<void> {
  const mine = ++loads;
  try {
    const found = await source();
    if (mine !== loads) return;
    stopWatching();
    motion = found;
    answer = null;
    now = firstNow(found);
    timeline.set(found, now, null);
    timeline.player.time = timeline.nowSeconds;
    view.setMotion(found, now);
    tellMotion(found);
    notice.hide("motion");
    const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (calm) seek(timeline.nowSeconds + 1);
    else timeline.player.playing = true;
    showPlaying();
    await ask();
  } catch (error) {
    fail(error, "motion");
  }
}

/** Where a demo is alive, and most models have seen enough. */
function firstNow({ track, fps }: Motion): number {
  const last = track.frames - 1;
  return Math.min(last, Math.max(Math.round(FIRST_NOW_S * fps), Math.round(last * 0.3)));
}

/** Ask, and show what comes; in steps, each step as it comes. */
async function answered(inSteps: boolean): Promise<void> {
  if (webcam) return webcam.ask(options(models.current));
  const asked = question();
  if (!asked || !motion) return;
  const [about, at] = [motion, now];
  const { axes } = about;
  try {
    const found =
      asked.path === "/predict_actions"
        ? await api.predictActions(asked.body as PredictActionsRequest, axes)
        : inSteps
          ? await api.predictInSteps(asked.body, axes, showPreview)
          : await api.predict(asked.body, axes);
    if (about !== motion) return; // it is about a motion that is gone
    show(found, at);
    notice.hide("answer");
  } catch (error) {
    fail(error, "answer");
  }
}

/** Show futures from frame `at` of the motion. */
function show(found: api.Answer, at: number): void {
  if (!motion) return;
  answer = found;
  element("preview").hidden = true;
  modes.set(found);
  view.setAnswer(found, at);
  timeline.set(motion, now, found);
  tellAnswer(found);
  showLook();
}

/** The futures as they stand after a step, for long enough to be seen. */
async function showPreview({ futures, steps }: api.Preview): Promise<void> {
  if (!answer || answer.segments.length > 0) return;
  view.setAnswer({ ...answer, futures, modes: answer.modes.filter(({ sample }) => sample < futures.length) }, now);
  const told = element("preview");
  told.hidden = false;
  told.textContent = `denoising: step ${steps.run} of ${steps.of}`;
  told.dataset.step = String(steps.run);
  redraw();
  await new Promise((resolve) => setTimeout(resolve, PREVIEW_MS));
}

function showLook(): void {
  view.setLook({ ...look(), solo });
  const sample = chosenSample();
  timeline.setSample(sample);
  script.tell(answer?.segments[sample] ?? [], answer?.fps ?? 1);
  element("legend-truth").hidden = !input("show-truth").checked;
  tellRegions(answer, input("show-regions").checked);
  redraw();
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
  if (!motion || webcam) return;
  const ahead = timeline.player.time - timeline.nowSeconds;
  now = timeline.bounded(frame);
  timeline.set(motion, now, answer);
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
function fail(error: unknown, about: Subject = "page"): void {
  if (error instanceof api.AwayError) server.lost();
  else {
    const wantsKey = error instanceof api.ProblemError && error.problem.status === 401;
    notice.show(error instanceof Error ? error.message : String(error), { about, wantsKey });
  }
}

function copy(written: (question: Question) => string): void {
  const [asked, told] = [question(), element("take-text")];
  if (!asked) {
    told.textContent = "Nothing is asked yet.";
    return;
  }
  const text = written(asked);
  navigator.clipboard.writeText(text).then(
    () => (told.textContent = `Copied ${text.length} characters.`),
    () => (told.textContent = "The browser did not let the page copy."),
  );
}

/** The future that is shown alone, or else all of them, as a file. */
async function download(suffix: Suffix): Promise<void> {
  const [asked, told] = [question(), element("take-text")];
  if (!asked || !motion) return;
  told.textContent = "…";
  try {
    const name = `${motion.name.replace(/\.\w+$/, "")}-future`;
    told.textContent = `Saved ${await save(asked, suffix, name, solo && chosenSample())}.`;
  } catch (error) {
    told.textContent = "";
    fail(error);
  }
}

/** The future that stands for what is shown. */
const chosenSample = (): number =>
  solo && "sample" in solo ? solo.sample : (answer?.modes[solo?.mode ?? 0]?.sample ?? 0);

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

function act(key: string, target: HTMLElement): boolean {
  const turn = target.id === "canvas" ? TURNS[key] : undefined;
  if (turn) stage.orbit(...turn);
  else if (key in KEYS) KEYS[key]();
  else if (/^[1-8]$/.test(key)) modes.toggle(Number(key) - 1);
  else return false;
  return true;
}

function listen(): void {
  listenForKeys(act);
  listenForFiles((files) => void load(() => fromFiles(files)));
  button("play").addEventListener("click", play);
  for (const radio of document.querySelectorAll("input[name=ask]")) {
    radio.addEventListener("change", () => {
      if (performing()) stopWatching(); // what is told begins where the camera saw the person last
      offerModels();
      void ask();
    });
  }
  for (const slider of document.querySelectorAll(".slider input")) {
    slider.addEventListener("input", () => {
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
  button("copy-curl").addEventListener("click", () => copy(asCurl));
  button("copy-python").addEventListener("click", () => copy(asPython));
  for (const suffix of ["bvh", "glb", "json"] as const) {
    button(`save-${suffix}`).addEventListener("click", () => void download(suffix));
  }
  button("webcam").addEventListener("click", () => void watch());
  onPaletteChange(() => view.paint(readPalette()));
  for (const [name, label] of Object.entries(DEMOS)) {
    const chip = made("button", label, { type: "button", className: "chip" });
    chip.dataset.demo = name;
    chip.addEventListener("click", () => void load(() => demo(name)));
    element("demos").append(chip);
  }
}

listen();
showSliders();
view.paint(readPalette());
void server.look();
