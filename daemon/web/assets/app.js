// The page: receives messages and redraws thirty times a second.

import { TimeChart } from "./chart.js";
import { colours, onColours } from "./colours.js";
import { Controls } from "./controls.js";
import { Link } from "./link.js";
import { estimatesFirst, eventsPanel, FingertipPanel, gripperPanel, headPanel, healthPanel, isFingertip, loopPanel, robotPanel, shearPanel, torquePanel, wantedNow } from "./panels.js";
import { Series } from "./series.js";
import { age, byId, number, put, putLines, show } from "./text.js";

const REDRAWS_PER_S = 30;
// Estimates differ in shape, and in lightness of blue and brown.
const TIPS = [{ colour: "first" }, { colour: "second", hollow: true }, { colour: "third", dash: [2, 4] }];
// Alpha of the band between the ends of an interval.
const BAND = "33";

// Stop works before any message arrives.
const controls = new Controls();
const settings = await (await fetch("settings.json")).json();

const torques = new Series();
const forces = new Series();
const tips = new Map();
const drawn = {};
const torqueChart = new TimeChart(byId("torque-chart"), byId("torque-legend"), settings.units["loop.state"].torque_nm, 0.05);
const shearChart = new TimeChart(byId("shear-chart"), byId("shear-legend"), settings.units["skin.shear"].shear_n, 0.2);

const gap = (topic) => settings.stale_after_s[topic];
const unlessInvalid = (said, value) => (said.valid ? value : null);

const takers = {
  "eit.estimate": (said) => {
    torques.add(said.timestamp, {
      [said.source]: unlessInvalid(said, said.torque_nm),
      [`${said.source} low`]: unlessInvalid(said, said.torque_low_nm),
      [`${said.source} high`]: unlessInvalid(said, said.torque_high_nm),
    }, gap("eit.estimate"));
  },
  "load.torque": (said) => torques.add(said.timestamp, { load: unlessInvalid(said, said.torque_nm) }, gap("load.torque")),
  "loop.state": (said) => torques.add(said.timestamp, { wanted: wantedNow(said) }, gap("loop.state")),
  "skin.shear": (said) => {
    forces.add(said.timestamp, {
      shear: unlessInvalid(said, said.shear_n),
      "shear low": unlessInvalid(said, said.shear_low_n),
      "shear high": unlessInvalid(said, said.shear_high_n),
    }, gap("skin.shear"));
    torques.add(said.timestamp, { skin: unlessInvalid(said, said.torque_nm) }, gap("skin.shear"));
  },
};

const link = new Link(settings, (message) => takers[message.topic]?.(message.content));

function chartLines() {
  // Only the estimate that drives the loop is drawn with its interval.
  const sources = estimatesFirst(link).filter((source) => torques.columns.get(source)?.some((value) => value != null));
  const lines = sources.slice(0, TIPS.length).map((source, i) => ({
    ...TIPS[i],
    stroke: colours[TIPS[i].colour],
    name: source,
    points: true,
    label: i === 0 ? `estimate of ${source}, with its 95 % interval` : `estimate of ${source}`,
    ...(i === 0 ? { low: `${source} low`, high: `${source} high`, fill: colours.first + BAND } : { width: 1 }),
  }));
  if (link.get("load.torque")) lines.push({ name: "load", label: "load cell", stroke: colours.ink, width: 1.5 });
  if (link.get("skin.shear")?.content.torque_nm != null || torques.columns.get("skin")?.some((value) => value != null)) {
    lines.push({ name: "skin", label: "shear skin", stroke: colours.skin, width: 2, dash: [2, 3] });
  }
  if (link.get("loop.state")) lines.push({ name: "wanted", label: "set point", stroke: colours.wanted, width: 2.5, dash: [9, 5] });
  return lines;
}

function fingertips() {
  const sources = link.sources("eit.estimate").filter((source) => isFingertip(link, source));
  for (const [source, panel] of tips) {
    if (!sources.includes(source)) {
      panel.remove();
      tips.delete(source);
    }
  }
  for (const source of sources) {
    if (!tips.has(source)) tips.set(source, new FingertipPanel(source, settings.fingertip));
    tips.get(source).update(link);
  }
}

// A phone shows the chart before the buttons that a token permits, and before the cap.
const phone = matchMedia("(max-width: 640px)");

function arrangeControls() {
  if (phone.matches) {
    byId("torque").after(byId("controls"));
    byId("controls").after(byId("cap"));
  } else {
    byId("lead").after(byId("controls"));
    byId("trouble").after(byId("cap"));
  }
}
phone.addEventListener("change", arrangeControls);
arrangeControls();

// Panels move to the column that has room: fingertips stand on the right, two to a column.
function arrange() {
  const shear = link.get("skin.shear") !== undefined;
  const right = tips.size + (shear ? 1 : 0);
  into(shear && tips.size > 1 ? "left" : "right", "shear");
  into(right < 2 ? "right" : "machine", "gripper");
}

function into(place, name) {
  if (byId(name).parentElement !== byId(place)) byId(place).append(byId(name));
}

function linkLine() {
  const state = link.state();
  byId("link").dataset.state = link.done() ? "done" : state;
  const received = Number.isFinite(link.sinceDaemon());
  const end = link.end()?.content;
  show(byId("summary"), state === "ended" && Boolean(end?.summary));
  putLines(byId("summary-text"), (end?.summary ?? "").split("\n"));
  const [name, reason] = {
    ended: [link.done() ? "✓ DONE" : "ended", `the daemon ${link.viewerLost() ? "and the viewer have" : "has"} ended; its last values are struck out`],
    live: ["● live", ""],
    connecting: ["connecting", "to the viewer on the rig's computer"],
    lost: ["✗ VIEWER LOST", `nothing from the viewer for ${age(link.sinceBatch())}; all values are old, and the page reconnects by itself`],
    dead: received
      ? ["✗ DAEMON SILENT", `nothing from it for ${age(link.sinceDaemon())}; all values are old`]
      : ["✗ NO DAEMON", `no message arrives from ${settings.publish}; start one on the rig's computer with \`shearloop run CONFIG\``],
  }[state];
  put(byId("link-state"), name);
  put(byId("link-reason"), reason);
}

function draw() {
  linkLine();
  headPanel(link);
  loopPanel(link);
  torquePanel(link);
  fingertips();
  arrange();
  controls.update(link);
  shearPanel(link);
  robotPanel(link);
  gripperPanel(link);
  healthPanel(link, drawn);
  eventsPanel(link, drawn);
  const loop = link.get("loop.state");
  torqueChart.setLines(chartLines(), loop && !link.isOld(loop) ? loop.content.torque_limit_nm ?? null : null);
  torqueChart.draw(torques, link.unixNow());
  if (link.get("skin.shear")) {
    shearChart.setLines([{ name: "shear", low: "shear low", high: "shear high", label: "shear force, with its interval", stroke: colours.first, fill: colours.first + BAND, width: 2 }]);
    shearChart.draw(forces, link.unixNow());
  }
  const refused = Object.entries(link.refused).map(([kind, count]) => `${count} ${kind}`).join(", ");
  put(byId("bridge"), refused ? `the viewer refused: ${refused}` : "");
}

// Shows the redraws in the last second, and the time that one takes.
const rate = { count: 0, spent: 0, since: performance.now() };

function tellRate(now) {
  const passed = (now - rate.since) / 1000;
  if (passed < 1) return;
  put(byId("rate"), `${number(rate.count / passed, 1)} redraws/s, ${number(rate.spent / rate.count, 1, "ms")} each`);
  Object.assign(rate, { count: 0, spent: 0, since: now });
}

onColours(() => tips.forEach((panel) => panel.redraw()));

let due = performance.now();
function onFrame() {
  requestAnimationFrame(onFrame);
  const now = performance.now();
  // Half a screen refresh early is on time.
  if (now < due - 8) return;
  due = Math.max(due + 1000 / REDRAWS_PER_S, now);
  draw();
  rate.count += 1;
  rate.spent += performance.now() - now;
  tellRate(now);
}
requestAnimationFrame(onFrame);
