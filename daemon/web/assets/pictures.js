// Draws the fingertip with its conductivity, and the heatmap. Shades go from dark to light and work in grey.

import { colours } from "./colours.js";

// Anchors of a colour scale with even lightness (after cividis).
const ANCHORS = [[0, 32, 76], [40, 66, 108], [92, 97, 112], [124, 123, 120], [166, 157, 117], [209, 193, 99], [253, 233, 69]];
const FONT = "system-ui, DejaVu Sans, sans-serif";

export function shade(share) {
  const place = Math.min(1, Math.max(0, share)) * (ANCHORS.length - 1);
  const below = Math.min(ANCHORS.length - 2, Math.floor(place));
  return ANCHORS[below].map((part, i) => Math.round(part + (place - below) * (ANCHORS[below + 1][i] - part)));
}

const css = (rgb) => `rgb(${rgb.join(" ")})`;

// A drawing context in CSS pixels at the screen's resolution.
function fitted(canvas) {
  const scale = window.devicePixelRatio || 1;
  const width = canvas.clientWidth || 240;
  const height = canvas.clientHeight || 226;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const pen = canvas.getContext("2d");
  pen.scale(scale, scale);
  pen.font = `12px ${FONT}`;
  return { pen, width, height };
}

// Text with an edge of the panel's colour, readable on every shade.
function label(pen, text, x, y, align = "left") {
  pen.textAlign = align;
  pen.textBaseline = "middle";
  pen.lineWidth = 3;
  pen.strokeStyle = colours.panel;
  pen.strokeText(text, x, y);
  pen.fillStyle = colours.ink;
  pen.fillText(text, x, y);
}

function scaleBar(pen, x, y, height, low, high, digits) {
  for (let i = 0; i < height; i += 1) {
    pen.fillStyle = css(shade(1 - i / height));
    pen.fillRect(x, y + i, 10, 1.5);
  }
  pen.strokeStyle = colours.ink;
  pen.lineWidth = 1;
  pen.strokeRect(x, y, 10, height);
  label(pen, high.toFixed(digits), x + 14, y + 6);
  label(pen, low.toFixed(digits), x + 14, y + height - 6);
}

const GEL_LOW = 0.4;
const GEL_HIGH = 1.6;

// Draw the gel: shades and level lines of its conductivity over the height, electrodes, and marks [cm, text] at heights.
export function drawGel(canvas, tip, conductivity, marks) {
  const { pen, width, height } = fitted(canvas);
  const room = { left: 8, right: 52, top: 22, bottom: 22 };
  const [wide, high] = [0, 1].map((axis) => Math.max(...tip.contour.map((point) => point[axis])));
  const scale = Math.min((width - room.left - room.right) / wide, (height - room.top - room.bottom) / high);
  const [w, h] = [wide * scale, high * scale];
  const [x0, y0] = [room.left, room.top];
  const [xOf, yOf] = [(cm) => x0 + cm * scale, (cm) => y0 + h - cm * scale];
  const edge = new Path2D();
  for (const [x, y] of tip.contour) edge.lineTo(xOf(x), yOf(y));
  edge.closePath();
  if (conductivity) {
    const last = conductivity.length - 1;
    pen.save();
    pen.clip(edge);
    for (let row = 0; row < h; row += 1) {
      const value = conductivity[Math.round((1 - row / h) * last)];
      pen.fillStyle = css(shade((value - GEL_LOW) / (GEL_HIGH - GEL_LOW)));
      pen.fillRect(x0, y0 + row, w, 1.5);
    }
    levels(pen, conductivity, high, x0, w, yOf);
    pen.restore();
    drawMarks(pen, marks, high, x0 + w, yOf);
  } else {
    label(pen, "no conductivity", x0 + w / 2, y0 + h / 2, "center");
  }
  pen.strokeStyle = colours.ink;
  pen.lineWidth = 1.5;
  pen.stroke(edge);
  pen.lineWidth = 6;
  for (const [[x1, y1], [x2, y2]] of tip.electrodes) {
    pen.beginPath();
    pen.moveTo(xOf(x1), yOf(y1));
    pen.lineTo(xOf(x2), yOf(y2));
    pen.stroke();
  }
}

function drawMarks(pen, marks, high, x, yOf) {
  pen.strokeStyle = colours.ink;
  pen.lineWidth = 1.5;
  for (const [cm, text] of marks) {
    if (cm < 0 || cm > high) continue;
    pen.beginPath();
    pen.moveTo(x, yOf(cm));
    pen.lineTo(x + 8, yOf(cm));
    pen.stroke();
    label(pen, text, x + 11, yOf(cm));
  }
  const outside = (beyond) => marks.filter(([cm]) => beyond(cm)).map(([, text]) => text).join(", ");
  const [above, below] = [outside((cm) => cm > high), outside((cm) => cm < 0)];
  if (above) label(pen, `${above} ↑`, x, yOf(high) - 10, "right");
  if (below) label(pen, `${below} ↓`, x, yOf(0) + 11, "right");
}

function levels(pen, conductivity, high, x0, w, yOf) {
  const step = high / (conductivity.length - 1);
  let labelledAt = -Infinity;
  for (let i = 0; i + 1 < conductivity.length; i += 1) {
    for (const level of [0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6]) {
      const [a, b] = [conductivity[i] - level, conductivity[i + 1] - level];
      if (a === b || a * b > 0 || b === 0) continue;
      const y = yOf((i + a / (a - b)) * step);
      pen.strokeStyle = colours.panel;
      pen.lineWidth = level === 1 ? 2 : 1;
      pen.setLineDash(level < 1 ? [6, 4] : []);
      pen.beginPath();
      pen.moveTo(x0, y);
      pen.lineTo(x0 + w, y);
      pen.stroke();
      pen.setLineDash([]);
      if (Math.abs(y - labelledAt) > 16 && Math.min(y - yOf(high), yOf(0) - y) > 9) {
        label(pen, level.toFixed(1), x0 + w / 2, y, "center");
        labelledAt = y;
      }
    }
  }
}

// Draw scores of (k, σ) cells with maximum and runner-up; k upwards, σ to the right.
export function drawMap(canvas, map, peaks) {
  const { pen, width, height } = fitted(canvas);
  const [x0, y0, w, h] = [44, 8, width - 44 - 52, height - 8 - 38];
  const { scores, k, kUnit, sigma, sigmaUnit } = map;
  const [rows, columns] = scores.shape;
  let [low, high] = [Infinity, -Infinity];
  for (const value of scores.values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  pen.imageSmoothingEnabled = false;
  pen.drawImage(pixels(scores, low, high), x0, y0, w, h);
  pen.strokeStyle = colours.ink;
  pen.lineWidth = 1;
  pen.strokeRect(x0, y0, w, h);
  label(pen, k[1].toFixed(1), x0 - 5, y0 + 6, "right");
  label(pen, k[0].toFixed(1), x0 - 5, y0 + h - 6, "right");
  // The bank's model gives the unit of k.
  label(pen, "k", x0 - 5, y0 + h / 2, "right");
  if (kUnit) label(pen, kUnit, x0 - 5, y0 + h / 2 + 14, "right");
  label(pen, sigma[0].toFixed(1), x0, y0 + h + 10);
  label(pen, sigma[1].toFixed(1), x0 + w, y0 + h + 10, "right");
  label(pen, `σ, ${sigmaUnit}`, x0 + w / 2, y0 + h + 27, "center");
  if (high >= low) scaleBar(pen, x0 + w + 8, y0, h, low, high, 2);
  if (!peaks) return;
  const at = ([row, column]) => [x0 + ((column + 0.5) / columns) * w, y0 + h - ((row + 0.5) / rows) * h];
  if (peaks.runner_up) ring(pen, ...at(peaks.runner_up));
  cross(pen, ...at(peaks.best));
}

function pixels(scores, low, high) {
  const [rows, columns] = scores.shape;
  const canvas = new OffscreenCanvas(columns, rows);
  const image = new ImageData(columns, rows);
  const span = Math.max(high - low, 1e-9);
  for (let row = 0; row < rows; row += 1) {
    for (let column = 0; column < columns; column += 1) {
      const value = scores.values[row * columns + column];
      if (!Number.isFinite(value)) continue;
      image.data.set([...shade((value - low) / span), 255], 4 * ((rows - 1 - row) * columns + column));
    }
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}

function twice(pen, path) {
  for (const [colour, lineWidth] of [[colours.panel, 6], [colours.ink, 2.5]]) {
    pen.strokeStyle = colour;
    pen.lineWidth = lineWidth;
    pen.beginPath();
    path();
    pen.stroke();
  }
}

function cross(pen, x, y) {
  twice(pen, () => {
    pen.moveTo(x - 7, y - 7);
    pen.lineTo(x + 7, y + 7);
    pen.moveTo(x + 7, y - 7);
    pen.lineTo(x - 7, y + 7);
  });
}

function ring(pen, x, y) { twice(pen, () => pen.arc(x, y, 7, 0, 7)); }
