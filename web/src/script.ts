/** A script of actions: buttons add to it, and each of its entries can be taken out again. */

import type { Action, ActionSegment } from "../client";
import { button, colour, element, made } from "./dom";

export class Script {
  private labels: string[] = [];
  private actions: Action[] = [];
  private most = 16;

  constructor(perform: () => void) {
    button("perform").addEventListener("click", perform);
    button("clear").addEventListener("click", () => this.set([]));
  }

  get wanted(): readonly string[] {
    return this.labels;
  }

  /** Its place among the colours. */
  colourOf = (action: string): number =>
    Math.max(0, this.actions.findIndex(({ label }) => label === action));

  /** The actions that a model knows, and how many the server takes in a row. */
  offer(actions: Action[], most: number): void {
    this.actions = actions;
    this.most = most;
    const known = new Set(actions.map(({ label }) => label));
    element("actions").replaceChildren(
      ...actions.map(({ label, example }, index) => {
        const chip = made("button", label.replaceAll("-", " "), { type: "button", className: "chip" });
        chip.style.setProperty("--own", colour(index));
        chip.dataset.action = label;
        if (example) chip.title = example;
        chip.addEventListener("click", () => this.set([...this.labels, label]));
        return chip;
      }),
    );
    this.set(this.labels.filter((label) => known.has(label)));
  }

  /** Tell how long each action takes in the future that is shown. */
  tell(segments: ActionSegment[], fps: number): void {
    for (const [index, entry] of [...element("script").children].entries()) {
      const segment = segments[index];
      const seconds = segment?.action === this.labels[index] ? (segment.end - segment.start) / fps : null;
      const told = entry.querySelector("small");
      if (told) told.textContent = seconds === null ? "" : `${seconds.toFixed(1)} s`;
    }
  }

  private set(labels: string[]): void {
    this.labels = labels.slice(0, this.most);
    element("script").replaceChildren(
      ...this.labels.map((label, index) => {
        const entry = made("li", label.replaceAll("-", " "));
        entry.style.setProperty("--own", colour(this.colourOf(label)));
        const out = made("button", "×", { type: "button" });
        out.setAttribute("aria-label", `Take out ${label}, number ${index + 1}`);
        out.addEventListener("click", () => this.set(this.labels.filter((_, i) => i !== index)));
        entry.append(made("small"), out);
        return entry;
      }),
    );
    button("perform").disabled = this.labels.length === 0;
    button("clear").disabled = this.labels.length === 0;
  }
}
