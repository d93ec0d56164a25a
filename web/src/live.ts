/** Frames to WS /stream, futures of the latest back; a lost connection goes on where it was. */

import type { PredictResponse, Problem } from "../client";
import { protocols } from "./api";
import type { Point } from "./motion";

const AGAIN_MS = 1000;

interface LiveNews {
  /** Of frames until `seconds`. */
  futures: (answer: PredictResponse, seconds: number) => void;
  waiting: (haveSeconds: number, needSeconds: number) => void;
  problem: (problem: Problem) => void;
  lost: () => void;
}

type Message =
  | { type: "ready"; session: string }
  | { type: "futures"; t: number; answer: PredictResponse }
  | { type: "waiting"; have_s: number; need_s: number }
  | { type: "error"; problem: Problem };

export class Live {
  private socket: WebSocket | null = null;
  private session: string | null = null;
  private ended = false;

  constructor(private options: object, private readonly news: LiveNews) {
    this.connect();
  }

  /** Ask for something else from now on. */
  ask(options: object): void {
    this.options = options;
    this.start();
  }

  frame(pose: Point[], seconds: number): void {
    this.send({ type: "frame", t: seconds, pose });
  }

  end(): void {
    this.ended = true;
    this.socket?.close();
  }

  private connect(): void {
    const socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/stream`, protocols());
    this.socket = socket;
    socket.addEventListener("open", () => this.start());
    socket.addEventListener("message", ({ data }) => this.hear(JSON.parse(data as string) as Message));
    socket.addEventListener("close", () => {
      if (this.ended) return;
      this.news.lost();
      setTimeout(() => this.ended || this.connect(), AGAIN_MS);
    });
  }

  private start(): void {
    this.send({ type: "start", session: this.session, rate_hz: 10, options: this.options });
  }

  private send(message: object): void {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  private hear(message: Message): void {
    if (message.type === "ready") this.session = message.session;
    else if (message.type === "waiting") this.news.waiting(message.have_s, message.need_s);
    else if (message.type === "error") this.news.problem(message.problem);
    else this.news.futures(message.answer, message.t);
  }
}
