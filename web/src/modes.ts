/** The modes as a list: how likely each is, and a click shows it alone. */

import type { Answer } from "./api";
import { colour, element, made, select } from "./dom";
import type { Solo } from "./view";

export class ModeList {
  private readonly list = element("modes");
  private readonly samples = select("sample");
  private solo: Solo = null;

  constructor(private readonly chosen: (solo: Solo) => void) {
    this.samples.addEventListener("change", () => {
      const value = this.samples.value;
      this.choose(value === "all" ? null : { sample: Number(value) });
    });
  }

  /** Show the modes of an answer; what was alone stays so where it still exists. */
  set(answer: Answer): void {
    const { solo } = this;
    const gone =
      (solo && "mode" in solo && solo.mode >= answer.modes.length) ||
      (solo && "sample" in solo && solo.sample >= answer.futures.length);
    element("who-title").hidden = answer.modes.length === 0;
    this.list.replaceChildren(...answer.modes.map((mode, index) => this.row(mode, index)));
    const options = answer.futures.map((_, i) => made("option", `future ${i + 1}`, { value: String(i) }));
    this.samples.replaceChildren(made("option", "all futures", { value: "all" }), ...options);
    if (gone) this.choose(null);
    else this.mark();
  }

  choose(solo: Solo): void {
    this.solo = solo;
    this.mark();
    this.chosen(solo);
  }

  /** Show one mode alone, or all again where it is alone already. */
  toggle(mode: number): void {
    if (mode >= this.list.children.length) return;
    const alone = this.solo && "mode" in this.solo && this.solo.mode === mode;
    this.choose(alone ? null : { mode });
  }

  private row({ probability, members }: Answer["modes"][number], index: number): HTMLButtonElement {
    const row = made("button", "", { type: "button", className: "mode", title: "Show it alone" });
    row.style.setProperty("--share", `${100 * probability}%`);
    row.style.setProperty("--own", colour(index));
    const futures = `${members.length} future${members.length === 1 ? "" : "s"}`;
    row.append(made("b", `${Math.round(100 * probability)} %`), made("span", futures));
    row.addEventListener("click", () => this.toggle(index));
    return row;
  }

  private mark(): void {
    const { solo } = this;
    for (const [index, row] of [...this.list.children].entries()) {
      row.setAttribute("aria-pressed", String(!!solo && "mode" in solo && solo.mode === index));
    }
    this.samples.value = solo && "sample" in solo ? String(solo.sample) : "all";
  }
}
