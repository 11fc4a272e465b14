// A scrolling minute of torques or forces. Lines differ in shape: points, solid, dashed.

import { colours, onColours } from "./colours.js";

const SPAN_S = 60;

const clock = (t) => new Date(t * 1000).toLocaleTimeString([], { hour12: false });

// A line of the chart: label, stroke and style (dash, width, points, hollow). `low` and `high` are the columns of its
// interval.
export class TimeChart {
  constructor(element, legend, unit, least) {
    this.element = element;
    this.legend = legend;
    this.unit = unit;
    this.least = least;
    this.lines = [];
    this.limit = null;
    new ResizeObserver(() => this.resize()).observe(element);
    onColours(() => { this.lines = []; });
  }

  // `limit` is drawn as lines above and below zero; null for none.
  setLines(lines, limit = null) {
    if (JSON.stringify(lines) === JSON.stringify(this.lines) && limit === this.limit) return;
    this.lines = lines;
    this.limit = limit;
    this.names = lines.flatMap((line) => (line.low ? [line.low, line.high, line.name] : [line.name]));
    this.chart?.destroy();
    this.chart = new uPlot(this.options(lines), [[], ...this.names.map(() => [])], this.element);
    const all = limit === null ? lines : [...lines, { ...this.limitStyle(), label: `limit ±${limit} ${this.unit}` }];
    this.legend.replaceChildren(...all.map((line) => this.sample(line)));
    this.limitLabel = limit === null ? null : this.legend.lastElementChild.lastChild;
  }

  // The legend says where the limit is beyond the picture.
  tellLimit(chart) {
    if (this.limit === null) return;
    const { min, max } = chart.scales.y;
    const beyond = this.limit > max && -this.limit < min ? ", beyond the picture" : "";
    const text = `limit ±${this.limit} ${this.unit}${beyond}`;
    if (this.limitLabel.textContent !== text) this.limitLabel.textContent = text;
  }

  limitStyle() { return { stroke: colours.limit, width: 2, dash: [1, 4] }; }

  drawLimit(chart) {
    if (this.limit === null) return;
    const { ctx: pen, bbox } = chart;
    const { stroke, width, dash } = this.limitStyle();
    pen.save();
    pen.strokeStyle = stroke;
    pen.lineWidth = width * devicePixelRatio;
    pen.setLineDash(dash.map((length) => length * devicePixelRatio));
    for (const value of [this.limit, -this.limit]) {
      const y = chart.valToPos(value, "y", true);
      if (y < bbox.top || y > bbox.top + bbox.height) continue;
      pen.beginPath();
      pen.moveTo(bbox.left, y);
      pen.lineTo(bbox.left + bbox.width, y);
      pen.stroke();
    }
    pen.restore();
  }

  options(lines) {
    const series = [{}];
    const bands = [];
    for (const line of lines) {
      if (line.low) {
        const edge = { stroke: line.stroke, width: 0.5, points: { show: false } };
        bands.push({ series: [series.length + 1, series.length], fill: line.fill });
        series.push(edge, { ...edge });
      }
      series.push({
        stroke: line.stroke,
        width: line.width ?? 1.5,
        dash: line.dash,
        points: line.points ? { show: true, size: 8, stroke: line.stroke, fill: line.hollow ? colours.panel : line.stroke, width: 2 } : { show: false },
      });
    }
    const axis = { stroke: colours.ink, grid: { stroke: colours.grid, width: 1 }, ticks: { stroke: colours.ink, width: 1 }, font: "13px system-ui, DejaVu Sans, sans-serif" };
    return {
      ...this.size(),
      // Above, right, below, left: half of the last time reaches beyond the axis.
      padding: [null, 30, null, null],
      series,
      bands,
      legend: { show: false },
      cursor: { show: false },
      hooks: { draw: [(chart) => this.drawLimit(chart)] },
      scales: {
        x: { time: false, auto: false, range: () => [this.now - SPAN_S, this.now] },
        y: { range: (_, low, high) => this.range(low, high) },
      },
      axes: [
        { ...axis, incrs: [10, 20, 30], space: 90, values: (_, splits) => splits.map(clock), size: 32 },
        { ...axis, size: 62, label: this.unit, labelSize: 18, labelFont: axis.font },
      ],
    };
  }

  range(low, high) {
    if (low === null || high === null || !(high >= low)) return [-this.least, this.least];
    [low, high] = this.withLimit(low, high);
    const room = 0.1 * Math.max(high - low, this.least);
    return [Math.min(low - room, -this.least / 5), Math.max(high + room, this.least)];
  }

  // The limits of both sides belong to the picture, unless they would flatten the values.
  withLimit(low, high) {
    const reach = Math.max(-low, high, this.least);
    if (this.limit === null || this.limit > 5 * reach) return [low, high];
    return [Math.min(low, -this.limit), Math.max(high, this.limit)];
  }

  size() { return { width: Math.max(200, this.element.clientWidth), height: Math.max(120, this.element.clientHeight) }; }

  resize() {
    if (this.chart) this.chart.setSize(this.size());
  }

  draw(series, now) {
    if (!this.chart) return;
    this.now = now;
    this.chart.setData(series.data(this.names), true);
    this.tellLimit(this.chart);
  }

  // The legend shows each line's style.
  sample(line) {
    const label = document.createElement("span");
    const canvas = document.createElement("canvas");
    canvas.width = 88;
    canvas.height = 28;
    const pen = canvas.getContext("2d");
    pen.scale(2, 2);
    if (line.low) {
      pen.fillStyle = line.fill;
      pen.fillRect(0, 1, 44, 12);
    }
    pen.strokeStyle = line.stroke;
    pen.lineWidth = line.width ?? 1.5;
    pen.setLineDash(line.dash ?? []);
    pen.beginPath();
    pen.moveTo(0, 7);
    pen.lineTo(44, 7);
    pen.stroke();
    if (line.points) {
      pen.setLineDash([]);
      pen.lineWidth = 2;
      pen.beginPath();
      pen.arc(22, 7, 4, 0, 7);
      pen.fillStyle = line.hollow ? colours.panel : line.stroke;
      pen.fill();
      pen.stroke();
    }
    label.append(canvas, line.label);
    return label;
  }
}
