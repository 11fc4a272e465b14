// The buttons: stop needs no token, every motion needs it.

import { ACTIVE } from "./panels.js";
import { byId, put, show } from "./text.js";

const KEY = "shearloop-token";
const TOKEN_NEEDED = "needs the token: open the address that `shearloop view` printed";
// A daemon answers within milliseconds; `unlock` takes longer.
const LATE_MS = 65000;
const STOP_LATE_MS = 4000;

export class Controls {
  constructor() {
    this.takeTokenFromAddress();
    this.reasons = {};
    byId("stop").addEventListener("click", () => this.stop());
    byId("stop").disabled = false;
    document.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && !event.repeat) this.stop();
    });
    for (const button of this.buttons()) button.addEventListener("click", () => this.command(button.dataset.command));
    byId("confirm").addEventListener("click", () => this.confirm());
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
    this.reasons = refusals(link);
    this.refresh();
  }

  refresh() {
    const token = sessionStorage.getItem(KEY);
    const names = new Map();
    for (const button of this.buttons()) {
      const { command } = button.dataset;
      const reason = token ? this.reasons[command] ?? "" : TOKEN_NEEDED;
      if (button.disabled !== (reason !== "")) button.disabled = reason !== "";
      if (button.title !== reason) button.title = reason;
      if (reason) names.set(reason, [...(names.get(reason) ?? []), command]);
    }
    const sentences = [...names].map(([reason, commands]) => `${commands.join(", ")}: ${reason}`);
    put(byId("controls-reason"), token ? sentences.join("; ") : "");
    if (byId("token-form").hidden !== Boolean(token)) byId("token-form").hidden = Boolean(token);
  }

  async stop() {
    this.ask_about("");
    this.tell("stopping …");
    const reply = await this.ask("stop", {}, STOP_LATE_MS);
    if (reply.ok) this.tell(reply.stopped ? `stopped: ${reply.stopped}` : "stop: nothing was moving");
    else this.tell(`STOP NOT CONFIRMED: ${reply.reason}. Use the emergency stop of the robot.`, "bad");
  }

  // The daemon's question, which `confirm` answers; an empty one is taken away.
  ask_about(name, question = "") {
    this.asked = name;
    put(byId("question-text"), question);
    put(byId("confirm"), `Yes, ${name}`);
    show(byId("question"), name !== "");
  }

  confirm() {
    const name = this.asked;
    this.ask_about("");
    if (name && !this.reasons[name]) this.command(name, "?confirmed");
  }

  async command(name, query = "") {
    this.ask_about("");
    this.tell(`${name} …`);
    const reply = await this.ask(`commands/${name}${query}`, { Authorization: `Bearer ${sessionStorage.getItem(KEY)}` }, LATE_MS);
    if (reply.ok && reply.question) {
      this.tell("");
      this.ask_about(name, reply.question);
    } else if (reply.ok) this.tell(`${name}: done`);
    else this.tell(`${name} was refused: ${reply.reason}`, "bad");
    // Ask again after a wrong token.
    if (reply.status === 403) this.keep("");
  }

  async ask(path, headers, lateMs) {
    try {
      const response = await fetch(path, { method: "POST", headers, keepalive: true, signal: AbortSignal.timeout(lateMs) });
      return { status: response.status, ...(await response.json()) };
    } catch {
      return { ok: false, reason: "the viewer on the rig's computer does not answer" };
    }
  }

  tell(sentence, kind = "") {
    const answer = byId("answer");
    answer.dataset.kind = kind;
    put(answer, sentence);
  }
}

// Why each command cannot work now. What the page cannot know, the daemon refuses.
function refusals(link) {
  const state = link.state();
  const all = (reason) => ({ tare: reason, start: reason, pause: reason, resume: reason, unlock: reason, release: reason });
  if (state !== "live") return all(state === "ended" ? "the daemon has ended" : "nothing answers");
  const loop = link.get("loop.state")?.content;
  const health = link.get("health")?.content;
  if (!loop) {
    const waiting = "loop" in (health?.tasks ?? {});
    return { ...all(waiting ? "the loop has not begun" : "the configuration has no robot"), tare: "" };
  }
  const { phase, response } = loop;
  const stopped = response.startsWith("stop");
  const busy = ACTIVE.has(phase) ? "an experiment runs" : "";
  const idle = busy ? "" : "no experiment runs";
  const locked = stopped || link.get("robot.state")?.content.blocked || link.get("gripper.state")?.content.fault;
  return {
    tare: busy || (health?.tare_refusal ?? ""),
    start: busy || (stopped ? "unlock first" : ""),
    pause: idle || (phase === "paused" ? "it is paused" : ""),
    resume: idle || (phase === "running" ? "nothing is paused" : ""),
    unlock: locked ? "" : "nothing is locked",
    release: busy || (link.get("gripper.state") ? "" : "no gripper answers"),
  };
}
