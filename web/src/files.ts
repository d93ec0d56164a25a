/** Files that people choose or drop on the page. */

import { button, input } from "./dom";

export function listenForFiles(bring: (files: File[]) => void): void {
  const chooser = input("file");
  const open = (files: FileList | null | undefined): void => {
    const some = [...(files ?? [])];
    if (some.length > 0) bring(some);
  };
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
