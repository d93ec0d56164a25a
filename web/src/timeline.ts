/** The track below the scene: now, the time that is shown, and what happens when. */

import type { Answer } from "./api";
import { colour, element, input } from "./dom";
import type { Motion } from "./motion";
import { Player } from "./player";
import { rootOf } from "./skeleton";

const THUMB_PX = 14; // as in style.css; a thumb's middle moves between half of it and the rest
const NOW_ROW_PX = 20;
const SECONDS_ROW_PX = 13;
const BEFORE_S = 1; // of the observation in the loop

export interface TimelineWishes {
  seek: (seconds: number) => void;
  setNow: (frame: number) => void;
}

export class Timeline {
  readonly player = new Player();
  private readonly canvas = element<HTMLCanvasElement>("track-canvas");
  private readonly now = input("now");
  private readonly playhead = input("playhead");
  private readonly clock = element<HTMLOutputElement>("clock");
  private fps = 30;
  private frames = 1;
  private root = 0;
  private nowFrame = 0;
  private answer: Answer | null = null;
  private sample = 0;

  constructor(
    wishes: TimelineWishes,
    private readonly actionColour: (action: string) => number,
  ) {
    this.playhead.addEventListener("input", () => wishes.seek(Number(this.playhead.value)));
    this.now.addEventListener("input", () => {
      wishes.setNow(this.bounded(Number(this.now.value)));
      this.now.value = String(this.nowFrame);
    });
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  get nowSeconds(): number {
    return this.nowFrame / this.fps;
  }

  /** Seconds until the last future ends, or else the motion. */
  private get end(): number {
    const known = (this.frames - 1) / this.fps;
    const { answer } = this;
    if (!answer) return Math.max(known, this.nowSeconds + 0.5);
    const longest = Math.max(...answer.futures.map(({ frames }) => frames));
    return Math.max(known, this.nowSeconds + longest / answer.fps);
  }

  set(motion: Motion, now: number, answer: Answer | null): void {
    this.fps = motion.fps;
    this.frames = motion.track.frames;
    this.root = rootOf(motion.skeleton);
    this.nowFrame = now;
    this.answer = answer;
    const ahead = answer ? Math.max(...answer.futures.map(({ frames }) => frames)) / answer.fps : 0;
    this.player.loop(Math.max(0, this.nowSeconds - BEFORE_S), this.nowSeconds + ahead);
    this.now.max = String(this.end * this.fps);
    this.now.value = String(now);
    this.now.setAttribute("aria-valuetext", `${this.nowSeconds.toFixed(2)} seconds into the motion`);
    this.playhead.max = String(this.end);
    this.showTime();
    this.draw();
  }

  /** The future whose actions are told in full. */
  setSample(sample: number): void {
    this.sample = sample;
    this.draw();
  }

  showTime(): void {
    const ahead = this.player.time - this.nowSeconds;
    const text = Math.abs(ahead) < 0.005 ? "now" : `${ahead > 0 ? "+" : "−"}${Math.abs(ahead).toFixed(2)} s`;
    this.playhead.value = String(this.player.time);
    this.playhead.setAttribute("aria-valuetext", text === "now" ? "now" : `${text} from now`);
    this.clock.textContent = text;
    this.clock.dataset.ahead = ahead.toFixed(3);
  }

  bounded(frame: number): number {
    return Math.min(Math.max(Math.round(frame), 1), this.frames - 1);
  }

  draw(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = Math.min(devicePixelRatio, 2);
    [this.canvas.width, this.canvas.height] = [width * ratio, height * ratio];
    const pen = this.canvas.getContext("2d");
    if (!pen || width === 0) return;
    pen.scale(ratio, ratio);
    const style = getComputedStyle(this.canvas);
    const ink = (name: string) => style.getPropertyValue(name).trim();
    const x = (seconds: number) => THUMB_PX / 2 + (seconds / this.end) * (width - THUMB_PX);
    const [top, now] = [NOW_ROW_PX, x(this.nowSeconds)];
    const box = height - top - SECONDS_ROW_PX;

    pen.fillStyle = ink("--track");
    pen.beginPath();
    pen.roundRect(x(0), top, x(this.end) - x(0), box, 5);
    pen.fill();
    pen.save();
    pen.clip();
    pen.fillStyle = ink("--track-known");
    pen.fillRect(now, top, x((this.frames - 1) / this.fps) - now, box);
    pen.fillStyle = ink("--track-seen");
    pen.fillRect(x(0), top, now - x(0), box);
    if (this.answer?.segments.length) this.drawSegments(pen, x, top, box, ink);
    else if (this.answer?.regions) this.drawSpread(pen, x, top, box, ink("--accent"));
    pen.restore();
    this.drawSeconds(pen, x, height, ink("--faint"));
    pen.fillStyle = ink("--accent");
    pen.fillRect(now - 1, top - 4, 2, box + 4);
  }

  private drawSeconds(pen: CanvasRenderingContext2D, x: (s: number) => number, height: number, faint: string): void {
    pen.fillStyle = faint;
    pen.font = "10px system-ui, sans-serif";
    const every = this.end > 40 ? 10 : this.end > 14 ? 2 : 1;
    pen.textAlign = "center";
    for (let second = 0; second <= this.end; second += every) {
      pen.fillText(second ? String(second) : "0 s", x(second), height - 2);
    }
    pen.textAlign = "start";
  }

  /** The 90 % region of the root grows with time. */
  private drawSpread(pen: CanvasRenderingContext2D, x: (s: number) => number, top: number, box: number, accent: string): void {
    const { answer } = this;
    if (!answer?.regions) return;
    const { centre, radius, levels } = answer.regions;
    pen.fillStyle = accent;
    for (let level = 0; level < levels.length; level++) {
      pen.globalAlpha = 0.22;
      pen.beginPath();
      pen.moveTo(x(this.nowSeconds), top + box / 2);
      const outline: [number, number][] = [];
      for (let frame = 0; frame < centre.frames; frame++) {
        const metres = radius[(level * centre.frames + frame) * centre.joints + this.root];
        outline.push([x(this.nowSeconds + (frame + 1) / answer.fps), Math.min(metres, 1) * box * 0.5]);
      }
      for (const [at, tall] of outline) pen.lineTo(at, top + box / 2 - tall);
      for (const [at, tall] of outline.reverse()) pen.lineTo(at, top + box / 2 + tall);
      pen.fill();
    }
    pen.globalAlpha = 1;
  }

  /** A row for each future: the chosen one tall and named, the others thin. */
  private drawSegments(
    pen: CanvasRenderingContext2D,
    x: (s: number) => number,
    top: number,
    box: number,
    ink: (name: string) => string,
  ): void {
    const { answer } = this;
    if (!answer) return;
    const at = (frame: number) => x(this.nowSeconds + frame / answer.fps);
    const fill = (action: string) => ink(colour(this.actionColour(action)).slice(4, -1));
    const others = answer.segments.filter((_, sample) => sample !== this.sample);
    const tall = Math.min(18, box * 0.5);
    const thin = Math.min(4, (box - tall - 4) / Math.max(others.length, 1));
    const bar = (segments: typeof others[number], y: number, height: number, gap: number) => {
      for (const { action, start, end } of segments) {
        pen.fillStyle = fill(action);
        pen.fillRect(at(start), y, at(end) - at(start) - gap, height);
      }
    };
    const chosen = answer.segments[this.sample] ?? answer.segments[0];
    bar(chosen, top + 1, tall, 1);
    pen.font = "600 11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    for (const { action, start, end } of chosen) {
      pen.save();
      pen.beginPath();
      pen.rect(at(start), top, at(end) - at(start) - 3, tall + 2);
      pen.clip();
      pen.fillStyle = ink("--on-colour");
      pen.fillText(action.replaceAll("-", " "), at(start) + 5, top + 1 + tall / 2 + 1);
      pen.restore();
    }
    pen.textBaseline = "alphabetic";
    pen.globalAlpha = 0.7;
    others.forEach((segments, row) => bar(segments, top + tall + 4 + row * thin, Math.max(thin - 0.5, 0.5), 0));
    pen.globalAlpha = 1;
  }
}
