// Writes numbers and sentences into the page; changes an element only if its text changes.

const MINUS = "\u2212";

export const byId = (id) => document.getElementById(id);

export function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// Puts lines one below the other; the rest of a long one begins below its text, not below its number or its name.
export function putLines(element, lines) {
  const text = lines.join("\n");
  if (element.textContent === text) return;
  element.replaceChildren(...lines.map((line, i) => {
    const part = document.createElement("span");
    part.className = "hanging";
    part.style.setProperty("--hang", `${/^ *(\d+ +\S+ +)?/.exec(line)[0].length}ch`);
    part.textContent = i < lines.length - 1 ? `${line}\n` : line;
    return part;
  }));
}

export function show(element, shown) {
  if (element.hidden === shown) element.hidden = !shown;
}

// Reasons that are normal between a tare and the first torque of a grip, not faults.
const WAITING =
  /^(no [^:]+: |not valid: )?(no grip|gripped too recently|the fingers moved|taking the idle frame|there is no earlier frame)/;

// `calm`: it is no fault at present.
export function warn(element, sentence, calm = false) {
  put(element, sentence);
  element.classList.toggle("waiting", calm || WAITING.test(sentence));
  show(element, sentence !== "");
}

// A number with its unit; a dash if there is no number.
export function number(value, digits, unit = "", { signed = false } = {}) {
  if (value === null || value === undefined) return "–";
  const text = Math.abs(value).toFixed(digits);
  const zero = Number(text) === 0;
  const sign = value < 0 && !zero ? MINUS : signed && !zero ? "+" : "";
  return `${sign}${text}${unit ? ` ${unit}` : ""}`;
}

export function interval(low, high, digits) {
  if (low === null || low === undefined || high === null || high === undefined) return "";
  return `${number(low, digits, "", { signed: true })} to ${number(high, digits, "", { signed: true })}`;
}

export const age = (seconds) => (seconds < 10 ? `${seconds.toFixed(1)} s` : `${Math.round(seconds)} s`);

// A message's array: shape and numbers.
export function array(packed) {
  const bytes = Uint8Array.from(atob(packed.float32), (letter) => letter.charCodeAt(0));
  return { shape: packed.shape, values: new Float32Array(bytes.buffer) };
}
