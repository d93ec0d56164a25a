/** What went wrong, in a sentence; and the field for a key where the server wants one. */

import { button, element, input } from "./dom";

/** What a notice is about: it goes when that goes well. */
export type Subject = "motion" | "answer" | "page";

export class Notice {
  private about: Subject = "page";
  private readonly box = element("notice");

  constructor(useKey: (key: string) => void) {
    button("notice-close").addEventListener("click", () => this.hide(this.about));
    element("key-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.hide(this.about);
      useKey(input("key").value);
    });
  }

  show(text: string, { about, wantsKey }: { about: Subject; wantsKey: boolean }): void {
    this.about = about;
    element("notice-text").textContent = text;
    element("key-form").hidden = !wantsKey;
    this.box.hidden = false;
  }

  hide(about: Subject): void {
    if (about === this.about) this.box.hidden = true;
  }
}
