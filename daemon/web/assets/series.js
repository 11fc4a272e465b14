// A minute of samples from several sources on one time axis. `undefined` means no sample at that time, `null` an invalid
// one: lines pass over the first and break at the second.

const KEPT_S = 65;
const MOST_ROWS = 6000;
// A larger step back means another clock: drop all earlier samples.
const LATEST_S = 10;

export class Series {
  constructor() {
    this.version = 0;
    this.clear();
  }

  clear() {
    this.version += 1;
    this.times = [];
    this.columns = new Map();
    this.last = new Map();
  }

  column(name) {
    if (!this.columns.has(name)) this.columns.set(name, new Array(this.times.length).fill(undefined));
    return this.columns.get(name);
  }

  // Add values by column name at a time; lines break after a pause longer than gapS.
  add(t, values, gapS) {
    const names = Object.keys(values);
    const before = this.last.get(names[0]);
    if (before !== undefined && t < before - LATEST_S) this.clear();
    else if (before !== undefined && t <= before) return;
    else if (before !== undefined && t - before > gapS) {
      this.insert(before + gapS / 2, Object.fromEntries(names.map((name) => [name, null])));
    }
    this.last.set(names[0], t);
    this.insert(t, values);
    this.trim(this.times[this.times.length - 1] - KEPT_S);
  }

  insert(t, values) {
    this.version += 1;
    // Frames are stamped in the middle of their acquisition and arrive slightly out of order.
    let at = this.times.length;
    while (at > 0 && this.times[at - 1] > t) at -= 1;
    for (const name of Object.keys(values)) this.column(name);
    this.times.splice(at, 0, t);
    for (const [name, column] of this.columns) column.splice(at, 0, values[name]);
  }

  trim(before) {
    let drop = Math.max(0, this.times.length - MOST_ROWS);
    while (drop < this.times.length && this.times[drop] < before) drop += 1;
    // Drop old samples a second at a time.
    if (drop < 40) return;
    this.version += 1;
    this.times.splice(0, drop);
    for (const column of this.columns.values()) column.splice(0, drop);
  }

  // Rows for uPlot, computed again only after new samples.
  data(names) {
    const key = names.join("\n");
    if (this.drawn?.key !== key || this.drawn.version !== this.version) {
      this.drawn = { key, version: this.version, rows: [this.times, ...names.map((name) => broken(this.column(name)))] };
    }
    return this.drawn.rows;
  }
}

// uPlot leaves out what lies between a null and the neighbouring rows, and those may be of other sources: the null is drawn
// out to this source's own neighbours.
function broken(column) {
  const rows = column.slice();
  for (let i = 0; i < rows.length; i += 1) {
    if (rows[i] !== null) continue;
    for (let before = i - 1; before >= 0 && rows[before] === undefined; before -= 1) rows[before] = null;
    while (i + 1 < rows.length && (rows[i + 1] === undefined || rows[i + 1] === null)) {
      i += 1;
      rows[i] = null;
    }
  }
  return rows;
}
