/** What went wrong, in a sentence; and the field for a key where the server wants one. */

import { button, element, input } from "./dom";

export class Notice {
  private readonly box = element("notice");

  constructor(useKey: (key: string) => void) {
    button("notice-close").addEventListener("click", () => this.hide());
    element("key-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.hide();
      useKey(input("key").value);
    });
  }

  show(text: string, { wantsKey }: { wantsKey: boolean }): void {
    element("notice-text").textContent = text;
    element("key-form").hidden = !wantsKey;
    this.box.hidden = false;
  }

  hide(): void {
    this.box.hidden = true;
  }
}
