/** Whether the server is there: said plainly, watched, and told when it has come back. */

import * as api from "./api";
import { element } from "./dom";

const PATIENCE_MS = 15_000; // between two looks while it answers
const HASTE_MS = 1_000; // while it does not

export class Server {
  private away = true;
  private timer = 0;

  constructor(private readonly back: () => void) {
    document.addEventListener("visibilitychange", () => {
      if (document.visibilityState === "visible") void this.look();
    });
  }

  /** Ask it how it is, and again later. */
  async look(): Promise<void> {
    window.clearTimeout(this.timer);
    try {
      const { models } = await api.ready();
      const count = Object.values(models).filter((state) => state === "ready").length;
      this.say("ready", `${count} models ready`);
      const wasAway = this.away;
      this.away = false;
      if (wasAway) this.back();
    } catch {
      this.lost();
      return;
    }
    this.timer = window.setTimeout(() => void this.look(), PATIENCE_MS);
  }

  /** It did not answer: say so, and look until it does. */
  lost(): void {
    this.away = true;
    this.say("away", "The server is away; the page goes on as soon as it is back.");
    window.clearTimeout(this.timer);
    this.timer = window.setTimeout(() => void this.look(), HASTE_MS);
  }

  private say(state: "ready" | "away", text: string): void {
    element("server").dataset.state = state;
    element("server-text").textContent = text;
  }
}
