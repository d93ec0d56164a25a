/** The keyboard, wherever the focus is, unless what has it wants the key for itself. */

const TYPING = "dialog[open], select, input:not([type=range], [type=checkbox], [type=radio])";
const PRESSING = "button, a, input[type=checkbox], input[type=radio]";

/** @param act does what a key is for; false where it is for nothing. */
export function listenForKeys(act: (key: string, target: HTMLElement) => boolean): void {
  document.addEventListener("keydown", (event) => {
    const target = event.target as HTMLElement;
    if (event.ctrlKey || event.metaKey || event.altKey || target.closest(TYPING)) return;
    if (event.key === " " && target.closest(PRESSING)) return;
    if (act(event.key, target)) event.preventDefault();
  });
}
