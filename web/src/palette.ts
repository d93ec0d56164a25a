/** The colours of the page in the scene: one place, style.css, says them, for light and dark. */

import { Color } from "three";

export interface Palette {
  body: Color;
  truth: Color;
  grid: Color;
  region: Color;
  colours: Color[];
  dark: boolean;
}

export const NUM_COLOURS = 10;

export function readPalette(): Palette {
  const style = getComputedStyle(document.documentElement);
  const color = (name: string) => new Color(style.getPropertyValue(name).trim());
  return {
    body: color("--body"),
    truth: color("--truth"),
    grid: color("--grid"),
    region: color("--region"),
    colours: Array.from({ length: NUM_COLOURS }, (_, i) => color(`--colour-${i}`)),
    dark: matchMedia("(prefers-color-scheme: dark)").matches,
  };
}

export function onPaletteChange(changed: () => void): void {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
}
