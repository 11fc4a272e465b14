// The buttons: stop needs no token, every motion needs it.

import { ACTIVE } from "./link.js";
import { byId, put, putLines, show } from "./text.js";

const KEY = "shearloop-token";
const TOKEN_NEEDED = "needs the token: open the address that `shearloop view` printed";
const NOTHING_RECEIVED = "nothing was received from the daemon yet";
// A daemon answers within milliseconds; `start`, `unlock` and `release` may take 150 s.
const LATE_MS = 155000;
const LIST_LATE_MS = 10000;
const LIST_AGAIN_MS = 2000;
const STOP_LATE_MS = 4000;
// Their first press fetches the daemon's question, and moves nothing.
const ASKED_FIRST = new Set(["start", "release"]);
const NO_VIEWER = "the viewer on the rig's computer does not answer";
// An answer disappears after this time; an unconfirmed stop stays.
const SHOWN_MS = 8000;

// What an accepted command does, in words; a tare ends some seconds later.
function outcome(name, { taring, not_connected: lost = [] }) {
  if (name !== "tare") return `${name}: done`;
  const are = lost.length > 1 ? "are" : "is";
  const without = lost.length ? `; NOT of ${lost.join(", ")}, which ${are} not connected` : "";
  return `tare: the zero of ${taring.join(", ")} is being taken${without}`;
}

export class Controls {
  constructor() {
    this.takeTokenFromAddress();
    this.reasons = {};
    // Why the daemon has no list of experiments to pick from.
    this.unlisted = "";
    // When the list was last asked for.
    this.offered = -Infinity;
    // Counts what was clicked: an answer to an earlier click does not replace what is said of a later one.
    this.clicks = 0;
    byId("stop").addEventListener("click", () => this.stop());
    byId("stop").disabled = false;
    document.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && !event.repeat) this.stop();
    });
    for (const button of this.buttons()) button.addEventListener("click", (event) => this.command(button.dataset.command, event));
    byId("confirm").addEventListener("click", (event) => this.confirm(event));
    byId("cancel").addEventListener("click", () => this.ask_about(""));
    byId("token-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.keep(byId("token").value.trim());
      byId("token").value = "";
    });
    this.refresh();
  }

  buttons() { return document.querySelectorAll("#controls [data-command]"); }

  // Browsers do not send the part after the #; the token is removed from the address bar.
  takeTokenFromAddress() {
    const given = new URLSearchParams(location.hash.slice(1)).get("token");
    if (!given) return;
    sessionStorage.setItem(KEY, given);
    history.replaceState(null, "", location.pathname);
  }

  keep(token) {
    if (token) sessionStorage.setItem(KEY, token);
    else sessionStorage.removeItem(KEY);
    this.refresh();
  }

  // Disable what the rig would refuse now, with the reason.
  update(link) {
    this.link = link;
    this.reasons = refusals(link);
    this.refresh();
    const loop = link.get("loop.state")?.content;
    const received = link.state() === "live" && loop !== undefined;
    const busy = received && ACTIVE.has(loop.phase);
    // While an experiment runs, the daemon may have no list yet. A daemon that was busy or stood still is asked again.
    const unlisted = !busy && !this.listed && performance.now() > this.offered + LIST_AGAIN_MS;
    if (received && (!this.received || unlisted)) this.offer();
    this.received = received;
    // An unlock acknowledges the stop that is shown, and no other.
    this.stopShown = loop?.stop;
    this.followRun();
    this.watch();
  }

  // A command without an answer, once nothing answers: the page says so until the daemon tells how it ended.
  watch() {
    const { sent, link } = this;
    if (!sent) return;
    if (link.state() !== "live") {
      if (!sent.inDoubt) this.doubt(link.viewerLost() ? NO_VIEWER : "the daemon does not answer");
      return;
    }
    if (!sent.inDoubt) return;
    // Another person's start, or his stop, says nothing of this request.
    const told = link.events.findLast((event) => event.request_id === sent.id);
    if (!told) return;
    this.sent = null;
    if (told.kind === "command") this.tell(`${sent.name}: done`);
    else this.tell(`${sent.name} was refused: ${told.reason}`, "bad");
  }

  doubt(reason) {
    const { name, onlyAsks } = this.sent;
    if (onlyAsks) {
      this.sent = null;
      this.tell(`${name}: its question did not come, because ${reason}. This click moves nothing. Click again.`, "bad", true);
      return;
    }
    this.sent.inDoubt = true;
    this.tell(`${name.toUpperCase()} NOT CONFIRMED: ${reason}. Look at the rig: it may still move.`, "bad", true);
  }

  // Fill the picker with the experiments that the daemon offers.
  async offer() {
    this.offered = performance.now();
    const picker = byId("experiment");
    let reply;
    try {
      reply = await (await fetch("experiments.json", { signal: AbortSignal.timeout(LIST_LATE_MS) })).json();
    } catch {
      reply = {};
    }
    this.unlisted = reply.ok ? reply.unread ?? "" : reply.reason ?? NO_VIEWER;
    this.listed = this.unlisted === "";
    const before = picker.value;
    const offered = reply.experiments ?? [];
    picker.replaceChildren(...offered.map(({ path, name }) => new Option(name, path)));
    const paths = offered.map(({ path }) => path);
    picker.value = paths.includes(before) ? before : reply.configured || (paths[0] ?? "");
    show(picker, offered.length > 0);
    this.followRun();
  }

  // Pick the experiment of each new run once, whoever started it: after a stop it is the one to start again.
  followRun() {
    const { run, experiment } = this.link?.get("loop.state")?.content ?? {};
    const picker = byId("experiment");
    const named = [...picker.options].filter((option) => option.text === experiment);
    // A daemon that was started again counts its runs anew.
    const seen = `${run} ${experiment}`;
    if (named.length === 0 || seen === this.followed) return;
    this.followed = seen;
    // Two files may have the same name: which of them runs, is not known here.
    if (named.length === 1) picker.value = named[0].value;
  }

  refresh() {
    const token = sessionStorage.getItem(KEY);
    const names = new Map();
    for (const button of this.buttons()) {
      const { command } = button.dataset;
      let reason = this.reasons[command] ?? "";
      if (!token) reason = TOKEN_NEEDED;
      else if (!this.link) reason = NOTHING_RECEIVED;
      if (button.disabled !== (reason !== "")) button.disabled = reason !== "";
      if (button.title !== reason) button.title = reason;
      if (reason) names.set(reason, [...(names.get(reason) ?? []), command]);
    }
    const sentences = [...names].map(([reason, commands]) => `${commands.join(", ")}: ${reason}`);
    if (this.received && this.unlisted) sentences.push(`no list of experiments: ${this.unlisted}`);
    put(byId("controls-reason"), token ? sentences.join("; ") : "");
    if (byId("token-form").hidden !== Boolean(token)) byId("token-form").hidden = Boolean(token);
  }

  async stop() {
    const click = this.begin();
    this.tell("stopping …");
    const reply = await this.ask("stop", {}, STOP_LATE_MS);
    if (click !== this.clicks) return;
    if (reply.ok) this.tell(reply.stopped ? `stopped: ${reply.stopped}` : `stop: ${reply.moved ?? "nothing was moving"}`);
    else this.tell(`STOP NOT CONFIRMED: ${reply.reason}. Use the emergency stop of the robot.`, "bad", true);
  }

  // A new click ends the question and what was said before; returns its number.
  begin() {
    this.ask_about("");
    this.sent = null;
    this.clicks += 1;
    return this.clicks;
  }

  // The daemon's question, which `confirm` answers with its digest; an empty one is taken away.
  ask_about(name, question = "", plan = [], digest = "") {
    this.asked = name;
    this.digest = digest;
    put(byId("question-text"), question);
    putLines(byId("plan"), plan);
    show(byId("plan"), plan.length > 0);
    put(byId("confirm"), `Yes, ${name}`);
    show(byId("question"), name !== "");
  }

  confirm(event) {
    const { asked: name, digest } = this;
    this.ask_about("");
    if (!name) return;
    // Meanwhile something was stopped, started or lost.
    const reason = this.reasons[name];
    if (reason) this.tell(`${name} was not sent: ${reason}`, "bad");
    else this.command(name, event, digest, this.picked);
  }

  // The confirmation starts the experiment of the question, even if another one is picked meanwhile. The digest says
  // which content was shown: the daemon refuses another one, with its own question.
  async command(name, event, digest = "", picked = byId("experiment").value) {
    const click = this.begin();
    this.picked = picked;
    const words = new URLSearchParams({ moment: this.link.momentOf(event), request_id: newId() });
    if (digest) words.set("digest", digest);
    if (name === "start" && picked) words.set("experiment", picked);
    if (name === "unlock" && Number.isInteger(this.stopShown)) words.set("stop", this.stopShown);
    const onlyAsks = !digest && ASKED_FIRST.has(name);
    this.sent = { name, id: words.get("request_id"), onlyAsks, inDoubt: false };
    this.tell(`${name} …`, "", true);
    const reply = await this.ask(`commands/${name}?${words}`, { Authorization: `Bearer ${sessionStorage.getItem(KEY)}` }, LATE_MS);
    if (click !== this.clicks) return;
    if (reply.unconfirmed) {
      // The state may already have told it.
      if (this.sent) this.doubt(reply.reason);
      return;
    }
    const inDoubt = this.sent?.inDoubt ?? false;
    this.sent = null;
    // A refusal of the first press with a question is no more than the question.
    const asks_only = reply.question && !digest;
    // Who was told that nothing confirms it also has to see how it ended.
    if (!reply.ok) this.tell(asks_only ? "" : `${name} was refused: ${reply.reason}`, "bad", inDoubt);
    else this.tell(reply.question ? "" : outcome(name, reply));
    if (reply.question) this.ask_about(name, reply.question, reply.plan, reply.digest);
    // Ask again after a wrong token.
    if (reply.status === 403) this.keep("");
  }

  async ask(path, headers, lateMs) {
    try {
      const response = await fetch(path, { method: "POST", headers, keepalive: true, signal: AbortSignal.timeout(lateMs) });
      return { status: response.status, ...(await response.json()) };
    } catch {
      return { ok: false, unconfirmed: true, reason: NO_VIEWER };
    }
  }

  tell(sentence, kind = "", stays = false) {
    const answer = byId("answer");
    answer.dataset.kind = kind;
    put(answer, sentence);
    clearTimeout(this.going);
    if (!stays) this.going = setTimeout(() => put(answer, ""), SHOWN_MS);
  }
}

// A name for a request that no other request has.
function newId() { return [...crypto.getRandomValues(new Uint32Array(2))].map((part) => part.toString(36)).join("-"); }

// Why each command cannot work now. What the page cannot know, the daemon refuses.
function refusals(link) {
  const state = link.state();
  const all = (reason) => ({ tare: reason, start: reason, pause: reason, resume: reason, unlock: reason, release: reason });
  if (state !== "live") return all(state === "ended" ? "the daemon has ended" : "nothing answers");
  const loop = link.get("loop.state")?.content;
  const health = link.get("health")?.content;
  if (!loop) {
    const waiting = "loop" in (health?.tasks ?? {});
    return { ...all(waiting ? "the loop has not begun" : "the configuration has no robot"), tare: health?.tare_refusal ?? "" };
  }
  const { phase, response } = loop;
  const stopped = response.startsWith("stop");
  const busy = ACTIVE.has(phase) ? "an experiment runs" : "";
  const idle = busy ? "" : "no experiment runs";
  const locked = stopped || link.get("robot.state")?.content.blocked || link.get("gripper.state")?.content.fault;
  return {
    tare: busy || (health?.tare_refusal ?? ""),
    start: busy || (stopped ? "unlock first" : health?.start_refusal ?? ""),
    pause: idle || (phase === "paused" ? "it is paused" : ""),
    // A hold may hide a pause.
    resume: idle || { running: "nothing is paused", held: "a fault holds it; a pause can be ended after that" }[phase] || "",
    unlock: busy || (locked ? "" : "nothing is locked"),
    release: busy || (health?.release_refusal ?? ""),
  };
}
