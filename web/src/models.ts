/** The chooser of models, and the card of the one that is chosen. */

import { marked } from "marked";
import type { ModelDetail, ModelSummary } from "../client";
import * as api from "./api";
import { button, element, made, select } from "./dom";

// A card is somebody's text: HTML in it is shown, not run.
marked.use({
  renderer: {
    html: ({ text }) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;"),
    image: ({ text }) => text,
  },
});

export class Models {
  private readonly chooser = select("model");
  private readonly dialog = element<HTMLDialogElement>("card");
  private all: ModelSummary[] = [];

  constructor(private readonly failed: (error: unknown) => void, chosen: () => void) {
    this.chooser.addEventListener("change", () => {
      this.tell();
      chosen();
    });
    button("card-open").addEventListener("click", () => void this.open());
    button("card-close").addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("click", ({ target }) => {
      if (target === this.dialog) this.dialog.close();
    });
  }

  set(models: ModelSummary[]): void {
    this.all = models.filter(({ state }) => state === "ready");
  }

  get current(): ModelSummary | null {
    return this.all.find(({ name }) => name === this.chooser.value) ?? null;
  }

  /** Offer those that perform actions, or those that predict without; the default is chosen. */
  offer(performing: boolean, byDefault: string | null): void {
    const before = this.chooser.value;
    const offered = this.all.filter(({ actions = [] }) => actions.length > 0 === performing);
    this.chooser.replaceChildren(...offered.map(({ name }) => made("option", name, { value: name })));
    const names = offered.map(({ name }) => name);
    const wanted = [before, byDefault ?? ""].find((name) => names.includes(name));
    this.chooser.value = wanted ?? names[0] ?? "";
    this.tell();
  }

  private tell(): void {
    const model = this.current;
    element("model-text").textContent = model ? `${model.description} Weights: ${model.licence}.` : "";
  }

  private async open(): Promise<void> {
    if (!this.current) return;
    try {
      this.show(await api.model(this.current.name));
    } catch (error) {
      this.failed(error);
    }
  }

  private show(detail: ModelDetail): void {
    element("card-title").textContent = `${detail.name} ${detail.version}`;
    const { fps, horizon, num_observed: seen, num_steps: steps } = detail;
    const seconds = (frames?: number | null) => (fps && frames ? `${(frames / fps).toFixed(1)} s` : "");
    const facts: [string, string][] = [
      ["Licence", detail.licence ?? ""],
      ["Sees", seconds(seen)],
      [detail.actions?.length ? "At most, for an action" : "Predicts", seconds(horizon)],
      ["Rate", fps ? `${fps} Hz` : ""],
      ["Denoising steps", steps && steps > 1 ? String(steps) : ""],
      ["Digest", (detail.digest ?? "").slice(0, 12)],
      ["Owed to", (detail.attribution ?? []).join(" ")],
    ];
    element("card-facts").replaceChildren(
      ...facts.flatMap(([name, value]) => (value ? [made("dt", name), made("dd", value)] : [])),
    );
    element("card-text").innerHTML = marked.parse(detail.card ?? "", { async: false });
    this.dialog.showModal();
    this.dialog.scrollTop = 0;
  }
}
