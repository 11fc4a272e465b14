// The buttons: stop needs no token, every motion needs it.

import { byId, put } from "./text.js";

const KEY = "shearloop-token";
// A daemon answers within milliseconds; `unlock` takes longer.
const LATE_MS = 65000;
const STOP_LATE_MS = 4000;

export class Controls {
  constructor() {
    this.takeTokenFromAddress();
    byId("stop").addEventListener("click", () => this.stop());
    document.addEventListener("keydown", (event) => {
      if (event.key === "Escape" && !event.repeat) this.stop();
    });
    for (const button of this.buttons()) button.addEventListener("click", () => this.command(button.dataset.command));
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

  refresh() {
    const token = sessionStorage.getItem(KEY);
    for (const button of this.buttons()) {
      button.disabled = !token;
      button.title = token ? "" : "needs the token: open the address that `shearloop view` printed";
    }
    byId("token-form").hidden = Boolean(token);
  }

  async stop() {
    this.tell("stopping …");
    const reply = await this.ask("stop", {}, STOP_LATE_MS);
    if (reply.ok) this.tell(reply.stopped ? `stopped: ${reply.stopped}` : "stop: nothing was moving");
    else this.tell(`STOP NOT CONFIRMED: ${reply.reason}. Use the emergency stop of the robot.`, "bad");
  }

  async command(name) {
    this.tell(`${name} …`);
    const reply = await this.ask(`commands/${name}`, { Authorization: `Bearer ${sessionStorage.getItem(KEY)}` }, LATE_MS);
    if (reply.ok) this.tell(`${name}: done`);
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
