// The colours of canvases, from the style sheet's variables; read again when the screen turns dark or light.

const dark = matchMedia("(prefers-color-scheme: dark)");
const NAMES = ["ink", "panel", "grid", "wanted", "first", "second", "third", "skin", "limit"];

export const colours = {};

function read() {
  const style = getComputedStyle(document.documentElement);
  for (const name of NAMES) colours[name] = style.getPropertyValue(`--${name}`).trim();
}

export function onColours(redraw) { dark.addEventListener("change", redraw); }

read();
onColours(read);
