// Fills the panels. A panel with a stale message is marked and its numbers are struck out.

import { ACTIVE } from "./link.js";
import { drawGel, drawMap } from "./pictures.js";
import { age, array, byId, interval, number, put, show, warn } from "./text.js";

// Names of the UR controller's modes (RTDE guide).
const ROBOT_MODES = { "-1": "no controller", 0: "disconnected", 1: "confirm safety", 2: "booting", 3: "power off", 4: "power on", 5: "idle", 6: "backdrive", 7: "running", 8: "updating" };
const SAFETY_MODES = { 1: "normal", 2: "reduced", 3: "protective stop", 4: "recovery", 5: "safeguard stop", 6: "system emergency stop", 7: "robot emergency stop", 8: "violation", 9: "fault", 10: "validate joint", 11: "undefined", 12: "automatic mode safeguard stop", 13: "three-position enabling stop" };
const MARK_OLD_AFTER_S = 1;
// Topics with a `torque_nm`, and the source of the robot's own torque.
const TORQUES = ["eit.estimate", "load.torque", "skin.shear"];
const WRENCH = "wrench";
const SIGNED = { signed: true };

export const wantedNow = (loop) => (ACTIVE.has(loop.phase) ? loop.ramp_nm : null);

const mode = (names, n) => `${names[n] ?? "unknown"} (${n})`;

export function markAge(panel, link, message) {
  const old = message === undefined || link.isOld(message);
  panel.classList.toggle("old", message !== undefined && old);
  const badge = panel.querySelector(".age");
  if (message === undefined) put(badge, "no message");
  else if (old) put(badge, `OLD, ${age(link.ageOf(message))} ago`);
  else put(badge, link.ageOf(message) > MARK_OLD_AFTER_S ? `${age(link.ageOf(message))} ago` : "");
}

// Shows a figure; one of an old message is struck out, also in a panel whose own message is not old.
function figure(id, text, old = false) {
  put(byId(id), text);
  byId(id).classList.toggle("old", old && text !== "–");
}

const oldNote = (link, message) => `OLD, ${age(link.ageOf(message))}`;

// The sources of estimates: first the one that drives the loop, then the combined one.
export function estimatesFirst(link) {
  const driving = link.get("loop.state")?.content.torque_source;
  const rank = (source) => (source === driving ? 0 : source === "combined" ? 1 : 2);
  return link.sources("eit.estimate").sort((one, other) => rank(one) - rank(other));
}

// Whether an estimate is of one fingertip, with a gel to draw.
export function isFingertip(link, source) {
  return source !== "combined" || link.get("eit.heatmap", source) !== undefined;
}

// The latest message with a torque on the tool, its name on the page, and the torque.
function torqueOf(link, topic, source) {
  const message = link.get(topic, source);
  if (!message) return undefined;
  const said = message.content;
  const name = { "eit.estimate": `estimate of ${said.source}`, "load.torque": "load cell", "skin.shear": "shear skin" }[topic];
  return { message, name, value: said.torque_nm, valid: said.valid, reason: said.reason };
}

// The wrench on the wrist is opposite to the torque on the tool.
function wrenchTorque(link) {
  const message = link.get("robot.state");
  if (!message) return undefined;
  const { wrist_torque_nm: torque, wrist_torque_valid: valid, wrist_torque_reason: reason } = message.content;
  return { message, name: "robot's wrench", value: torque == null ? torque : -torque, valid, reason };
}

// The torque that drives the loop; before the first experiment, an estimate, the skin or the load cell.
function drivingTorque(link) {
  const named = link.get("loop.state")?.content.torque_source;
  if (named === WRENCH) return wrenchTorque(link);
  if (named) return TORQUES.map((topic) => torqueOf(link, topic, named)).find(Boolean);
  const estimates = estimatesFirst(link).map((source) => torqueOf(link, "eit.estimate", source));
  const known = [...estimates, torqueOf(link, "skin.shear"), torqueOf(link, "load.torque")].filter(Boolean);
  // One that gives a torque comes before an estimate without a calibration.
  return known.find((torque) => torque.valid && torque.value != null) ?? known[0];
}

// The driving torque, the set point, another torque to compare with, and the diameter.
export function torquePanel(link) {
  const loop = link.get("loop.state");
  const named = loop?.content.torque_source;
  const known = estimatesFirst(link);
  const first = known.find((source) => !link.isOld(link.get("eit.estimate", source))) ?? known[0];
  const estimate = link.get("eit.estimate", known[0]);
  const driving = drivingTorque(link);
  markAge(byId("torque"), link, driving?.message);
  const source = driving?.name || named || "torque";
  put(byId("torque-source"), named ? `${source}, drives the loop` : source);
  const said = driving?.message.content;
  put(byId("torque-now"), driving?.valid ? number(driving.value, 4, link.unit("loop.state", "torque_nm"), SIGNED) : "–");
  put(byId("torque-interval"), driving?.valid && said.torque_low_nm != null ? `${interval(said.torque_low_nm, said.torque_high_nm, 4)} (95 %)` : "");
  const load = torqueOf(link, "load.torque");
  const other = load && driving?.message === load.message ? first && torqueOf(link, "eit.estimate", first) : load;
  const against = (torque) => (torque && !torque.valid && !link.isOld(torque.message) ? `${torque.name}: ${torque.reason}` : "");
  const none = driving && !driving.valid ? `no torque from the ${driving.name}: ${driving.reason}` : "";
  warn(byId("torque-reason"), [none, against(other)].filter(Boolean).join("; "), link.idle());
  wantedFigure(link, loop);
  otherFigure(link, other);
  diameterFigure(link, estimate);
}

function wantedFigure(link, loop) {
  const wanted = loop && ACTIVE.has(loop.content.phase) ? loop : undefined;
  const old = wanted !== undefined && link.isOld(wanted);
  figure("wanted", link.number(wanted, "ramp_nm", 4, SIGNED), old);
  const final = wanted?.content.set_point_nm == null ? "" : `final ${number(wanted.content.set_point_nm, 3, "", SIGNED)}`;
  put(byId("set-point"), old ? oldNote(link, wanted) : final);
}

function otherFigure(link, other) {
  show(byId("other"), other !== undefined);
  if (!other) return;
  const old = link.isOld(other.message);
  put(byId("other-source"), other.name);
  figure("other-torque", other.valid ? link.number(other.message, "torque_nm", 4, SIGNED) : "–", old);
  const note = other.valid ? "" : "not valid";
  put(byId("other-note"), old ? oldNote(link, other.message) : note);
}

function diameterFigure(link, estimate) {
  const gripper = link.get("gripper.state");
  const seen = estimate?.content.valid ? estimate.content.diameter_mm : null;
  const old = seen != null && link.isOld(estimate);
  const held = gripper && !link.isOld(gripper) ? gripper.content.diameter_mm : null;
  figure("diameter", seen == null ? "–" : link.number(estimate, "diameter_mm", 1), old);
  const { diameter_low_mm: low, diameter_high_mm: high } = estimate?.content ?? {};
  const between = seen == null || low == null ? "" : `${number(low, 1)} to ${number(high, 1)}`;
  const spread = old ? oldNote(link, estimate) : between;
  put(byId("diameter-note"), [spread, held == null ? "" : `gripper ${link.number(gripper, "diameter_mm", 1)}`].filter(Boolean).join(", "));
}

const UNMATCHED = "no conductivity, k and σ: this frame was not matched in time";

export class FingertipPanel {
  constructor(source, geometry) {
    this.source = source;
    this.geometry = geometry;
    this.panel = byId("fingertip-template").content.firstElementChild.cloneNode(true);
    this.panel.dataset.source = source;
    put(this.part("name"), source);
    byId("right").prepend(this.panel);
    this.redraw();
    new ResizeObserver(() => this.redraw()).observe(this.panel);
  }

  redraw() { this.drawn = {}; }

  part(name) { return this.panel.querySelector(`.${name}`); }

  update(link) {
    const estimate = link.get("eit.estimate", this.source);
    const heatmap = link.get("eit.heatmap", this.source);
    markAge(this.panel, link, estimate ?? heatmap);
    const said = estimate?.content ?? {};
    put(this.part("score"), number(said.score, 4));
    put(this.part("runner-up"), number(said.runner_up, 4));
    // The bank's model, which the heatmap names, decides between the units of k.
    put(this.part("k"), number(said.k, 3, heatmap?.k_unit ?? ""));
    put(this.part("sigma"), link.number(estimate, "sigma", 3));
    put(this.part("frame"), said.frame === undefined ? "–" : String(said.frame));
    put(this.part("latency"), said.latency_s === undefined ? "–" : number(1000 * said.latency_s, 0, "ms"));
    if (estimate && !said.valid) warn(this.part("invalid"), `not valid: ${said.reason}`, link.idle());
    // Only a fingertip with a bank has a heatmap, and only a frame that came late has no match in it.
    else if (estimate && said.k == null && heatmap) warn(this.part("invalid"), UNMATCHED, true);
    else warn(this.part("invalid"), "");
    if (this.drawn.gel !== estimate || !estimate) this.drawGel(estimate);
    // An empty picture would push all below it off a phone's screen.
    this.part("map").closest("figure").hidden = !heatmap;
    if (this.drawn.map !== heatmap) this.drawMap(heatmap, link.unit("eit.heatmap", "sigma_high"));
    if (heatmap) this.mapText(heatmap, said);
  }

  drawGel(estimate) {
    if (this.drawn.gel === (estimate ?? null)) return;
    this.drawn.gel = estimate ?? null;
    const conductivity = estimate?.conductivity ?? null;
    const canvas = this.part("gel");
    drawGel(canvas, this.geometry, conductivity, estimate?.marks ?? []);
    const [wide, high] = [0, 1].map((axis) => Math.max(...this.geometry.contour.map((point) => point[axis])));
    const size = `${wide} × ${high} cm, ${this.geometry.electrodes.length} electrodes`;
    put(this.part("gel-text"), [size, "conductivity, untouched gel = 1", estimate?.meaning].filter(Boolean).join("; "));
    canvas.setAttribute("aria-label", conductivity
      ? `conductivity over the height, from ${Math.min(...conductivity).toFixed(2)} to ${Math.max(...conductivity).toFixed(2)} of the untouched gel's`
      : "no conductivity is known");
  }

  drawMap(heatmap, sigmaUnit) {
    this.drawn.map = heatmap;
    if (!heatmap) return;
    const { scores, k_low: kLow, k_high: kHigh, sigma_low: sigmaLow, sigma_high: sigmaHigh } = heatmap.content;
    const map = { scores: array(scores), k: [kLow, kHigh], kUnit: heatmap.k_unit, sigma: [sigmaLow, sigmaHigh], sigmaUnit };
    drawMap(this.part("map"), map, heatmap.peaks);
  }

  mapText(heatmap, said) {
    const [rows, columns] = heatmap.content.scores.shape;
    const late = said.frame !== undefined && said.frame !== heatmap.content.frame ? ` of the earlier frame ${heatmap.content.frame}` : "";
    put(this.part("map-text"), `scores of ${rows} k × ${columns} σ${late}; blank cells have no valid signal`);
    const cell = (peak) => (peak ? `row ${peak[0]}, column ${peak[1]}` : "none");
    this.part("map").setAttribute("aria-label", `heatmap of ${rows} by ${columns} cells; maximum at ${cell(heatmap.peaks?.best)}, runner-up at ${cell(heatmap.peaks?.runner_up)}`);
  }

  remove() { this.panel.remove(); }
}

export function shearPanel(link) {
  const message = link.get("skin.shear");
  show(byId("shear"), message !== undefined);
  markAge(byId("shear"), link, message);
  if (!message) return;
  const said = message.content;
  put(byId("shear-now"), said.valid ? link.number(message, "shear_n", 3, SIGNED) : "–");
  put(byId("shear-interval"), said.valid ? interval(said.shear_low_n, said.shear_high_n, 3) : "");
  put(byId("shear-response"), number(said.response, 5, "", SIGNED));
  put(byId("shear-gauges"), `${number(said.r1_ohm, 3)} · ${link.number(message, "r2_ohm", 3)}`);
  put(byId("shear-state"), said.deadband ? "within the deadband" : said.direction);
  warn(byId("shear-reason"), said.valid ? "" : `no force: ${said.reason}`, link.idle());
}

export function robotPanel(link) {
  const message = link.get("robot.state");
  const known = "robot" in (link.get("health")?.content.tasks ?? {});
  show(byId("robot"), message !== undefined || known);
  markAge(byId("robot"), link, message);
  if (!message) return;
  const said = message.content;
  const stops = [said.emergency_stop ? "EMERGENCY STOP" : "", said.protective_stop ? "PROTECTIVE STOP" : "", said.blocked];
  // Before the first start, motion is not enabled, and the start enables it.
  const startable = link.get("health")?.content.start_refusal === "" && !said.emergency_stop && !said.protective_stop;
  warn(byId("robot-blocked"), stops.filter(Boolean).join(": "), link.idle() && startable);
  put(byId("wrist"), link.number(message, "wrist_rad", 3, SIGNED));
  put(byId("wrist-speed"), link.number(message, "wrist_speed_rad_per_s", 3, SIGNED));
  const torque = wrenchTorque(link);
  const measured = number(torque.value, 3, link.unit(message.topic, "wrist_torque_nm"), SIGNED);
  put(byId("wrist-torque"), torque.valid ? measured : `not valid: ${torque.reason}`);
  put(byId("robot-mode"), mode(ROBOT_MODES, said.robot_mode));
  put(byId("safety-mode"), mode(SAFETY_MODES, said.safety_mode));
  put(byId("speed-scaling"), `${number(100 * said.speed_scaling, 0)} %`);
  const tcp = array(said.tcp_pose).values;
  put(byId("tcp"), `${[...tcp.slice(0, 3)].map((m) => number(1000 * m, 0)).join(" · ")} mm`);
  const loop = link.get("loop.state");
  const old = loop !== undefined && link.isOld(loop);
  const sent = old ? {} : loop?.content ?? {};
  figure("speed-sent", link.number(loop, "speed_sent_rad_per_s", 3, SIGNED), old);
  const clipped = sent.speed_command_rad_per_s !== undefined && Math.abs(sent.speed_command_rad_per_s - sent.speed_sent_rad_per_s) > 0.0005;
  put(byId("speed-command"), clipped ? `requested ${number(sent.speed_command_rad_per_s, 3, "", SIGNED)}` : "");
}

// What the gripper holds while its state, `object`, gives no diameter.
const WITHOUT_DIAMETER = { unknown: "not known", moving: "–" };

// The gripper's code while it opens and closes after a start; it ends by itself.
const ACTIVATING = 5;

export function gripperPanel(link) {
  const message = link.get("gripper.state");
  const known = "gripper" in (link.get("health")?.content.tasks ?? {});
  show(byId("gripper"), message !== undefined || known);
  markAge(byId("gripper"), link, message);
  if (!message) return;
  const said = message.content;
  warn(byId("gripper-fault"), said.fault ? `fault ${said.fault}: ${said.fault_text}` : "", said.fault === ACTIVATING);
  put(byId("gripper-width"), link.number(message, "width_mm", 1));
  put(byId("gripper-object"), said.object);
  const spread = said.diameter_std_mm == null ? "" : ` ± ${number(said.diameter_std_mm, 1)}`;
  const without = WITHOUT_DIAMETER[said.object] ?? "nothing held";
  put(byId("gripper-diameter"), said.diameter_mm == null ? without : `${number(said.diameter_mm, 1)}${spread} ${link.unit("gripper.state", "diameter_mm")}`);
  put(byId("gripper-current"), link.number(message, "current_ma", 0));
}

// The rig, the computer that it runs on, and the page's title with the state.
export function headPanel(link) {
  const health = link.get("health")?.content;
  show(byId("emulated"), Boolean(health?.emulated));
  const cap = health?.cap ?? "";
  put(byId("cap"), cap && `${cap[0].toUpperCase()}${cap.slice(1)}. It guards against mistakes and is no safety function.`);
  show(byId("cap"), cap !== "");
  const name = [health?.rig, health?.host && `on ${health.host}`].filter(Boolean).join(" ");
  put(byId("rig"), name);
  const title = [stateWord(link), health?.emulated ? "EMULATED" : "", name].filter(Boolean).join(" · ");
  if (document.title !== title) document.title = title;
  const ended = link.done() ? "done" : "ended";
  const alarm = { ended, dead: "silent", lost: "silent" }[link.state()] ?? (isStopped(link) ? "stopped" : "");
  if (document.body.dataset.alarm !== alarm) document.body.dataset.alarm = alarm;
}

// Also a stop while no experiment ran waits for `unlock`.
const waitsForUnlock = (loop) => loop.phase === "stopped" || (!ACTIVE.has(loop.phase) && loop.response.startsWith("stop"));

function isStopped(link) {
  const loop = link.get("loop.state")?.content;
  return loop !== undefined && waitsForUnlock(loop);
}

function stateWord(link) {
  const state = link.get("loop.state");
  const loop = state?.content;
  const lost = { ended: link.done() ? "DONE" : "ENDED", dead: "NO DAEMON", lost: "NO VIEWER", connecting: "connecting" }[link.state()];
  if (lost) return lost;
  if (!loop) return "no robot";
  const word = waitsForUnlock(loop) ? "STOPPED" : loop.phase === "held" ? "HOLD" : loop.phase;
  const holds = loop.phase === "running" && loop.set_point_nm != null;
  return holds ? `holding ${link.number(state, loop.ramp_nm == null ? "set_point_nm" : "ramp_nm", 2, SIGNED)}` : word;
}

export function healthPanel(link, drawn) {
  const message = link.get("health");
  markAge(byId("health"), link, message);
  const said = message?.content;
  const old = oldSources(link);
  const key = `${message?.content.seq} ${message?.at} ${link.state()} ${old}`;
  if (key === drawn.health) return;
  drawn.health = key;
  const tasks = Object.entries(said?.tasks ?? {}).map(([name, facts]) => taskOf(name, facts));
  const chips = byId("tasks");
  while (chips.children.length > tasks.length) chips.lastElementChild.remove();
  tasks.forEach((task, i) => fillChip(chips.children[i] ?? newChip(), task));
  const named = (state) => tasks.filter((task) => task.state === state).map((task) => task.name).join(", ");
  const [dead, warned] = [named("dead"), named("warned")];
  const trouble = [dead && `✗ DEAD: ${dead}`, warned && `! errors: ${warned}`].filter(Boolean).join("; ");
  let state = "alive";
  if (dead) state = "dead";
  else if (warned || old) state = "warned";
  byId("health").dataset.state = state;
  const lateOnes = old && `! old data: ${old}`;
  put(byId("tasks-line"), !said || link.isOld(message) ? "not known" : trouble || lateOnes || `✓ all ${tasks.length} are well`);
  put(byId("trouble"), trouble);
  show(byId("trouble"), trouble !== "");
  put(byId("process"), said ? `${link.number(message, "memory_mb", 0)}, ${link.number(message, "cpu_percent", 1)} of a core, event loop ${number(1000 * said.loop_lag_s, 1, "ms")} late` : "");
}

// The sources whose latest message is old.
function oldSources(link) {
  const regular = [...link.latest.values()].filter(({ topic }) => topic in link.settings.stale_after_s);
  return [...new Set(regular.filter((message) => link.isOld(message)).map((message) => message.content.source))].sort().join(", ");
}

function newChip() {
  const chip = byId("chip-template").content.firstElementChild.cloneNode(true);
  byId("tasks").append(chip);
  return chip;
}

// A task's state, and what it reports.
function taskOf(name, facts) {
  const dead = facts.alive === false && !facts.done;
  const error = facts.error || facts.last_error || "";
  let [state, text] = ["alive", `✓ ${name}`];
  if (dead) [state, text] = ["dead", `✗ ${name}: DEAD`];
  else if (facts.done) [state, text] = ["done", `✓ ${name}: done`];
  else if (facts.error) [state, text] = ["warned", `! ${name}: error`];
  const expected = facts.expected_hz == null ? "" : ` of ${number(facts.expected_hz, 2)}`;
  const rate = facts.rate_hz == null ? "" : `${number(facts.rate_hz, 2)}${expected} Hz`;
  const errors = Object.entries(facts.errors ?? {}).map(([kind, count]) => `${count} ${kind}`).join(", ");
  const restarts = facts.restarts ? `restarted ${facts.restarts === 1 ? "once" : `${facts.restarts} times`}` : "";
  const report = [rate, errors && `errors: ${errors}`, restarts, error].filter(Boolean).join("; ") || "no errors";
  return { name, state, text, report };
}

function fillChip(chip, { state, text, report }) {
  chip.dataset.state = state;
  put(chip.querySelector("b"), text);
  put(chip.querySelector("p"), report);
}

// What happened, the latest first.
export function eventsPanel(link, drawn) {
  if (drawn.events === link.events.length && drawn.eventsOf === link.eventsOf) return;
  drawn.events = link.events.length;
  drawn.eventsOf = link.eventsOf;
  byId("events").replaceChildren(...[...link.events].reverse().map((event) => {
    const item = document.createElement("li");
    item.dataset.kind = event.kind;
    const time = document.createElement("time");
    put(time, new Date(1000 * event.timestamp).toLocaleTimeString([], { hour12: false }));
    item.append(time, ` ${event.text}`);
    return item;
  }));
}

// The loop's phase, the cause of a hold or a stop, and the codes of further faults, whose sentences open by a click.
export function loopPanel(link) {
  const message = link.get("loop.state");
  // The last state of an ended daemon is struck out.
  const current = message && (!link.isOld(message) || link.end()) ? message.content : undefined;
  const step = current?.steps ? `, step ${current.step} of ${current.steps}` : "";
  const phase = current && waitsForUnlock(current) ? "stopped" : current?.phase;
  put(byId("phase-name"), current ? `${phase}${current.experiment ? `: ${current.experiment}` : ""}${step}` : "–");
  const reasons = current?.reasons ?? "";
  // The reason for the stop is listed below, with its cure.
  const stopped = current?.phase === "stopped";
  put(byId("phase-activity"), stopped && reasons ? "" : current?.activity ?? "");
  const underWay = Boolean(current?.steps) && (ACTIVE.has(current.phase) || current.phase === "done");
  const share = underWay ? current.progress : 0;
  if (byId("progress").value !== share) byId("progress").value = share;
  const left = current?.phase === "done" ? "" : `, about ${link.number(message, "remaining_s", 0)} left`;
  put(byId("progress-text"), underWay ? `${Math.round(100 * share)} %${left}` : "");
  show(byId("holding"), reasons !== "");
  if (reasons === "") return;
  const stop = current.response.startsWith("stop");
  const codes = current.faults.split(", ");
  // A person's own stop is no error.
  const asked = stop && codes[0] === link.settings.operator_stop;
  byId("holding").dataset.kind = stop && !asked ? "stop" : "hold";
  let title = { note: "Note", "refuse start": "No start" }[current.response] ?? "Holding, because";
  if (asked) title = "Stopped as asked";
  else if (stop) title = `Stopped: ${current.response}`;
  put(byId("holding-title"), title);
  put(byId("cause"), current.cause || reasons);
  const times = stopped ? message.stop_times : "";
  put(byId("stop-times"), times && `${times[0].toUpperCase()}${times.slice(1)}.`);
  // `reasons` begins with the cause.
  const others = current.cause ? reasons.slice(current.cause.length).trim() : "";
  show(byId("others"), others !== "");
  put(byId("other-codes"), [...new Set(codes.slice(1))].join(", ") || "more");
  put(byId("other-reasons"), others);
}
