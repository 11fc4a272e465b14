// The connection to the viewer: the latest messages, their ages, and whether daemon and viewer respond.

import { number } from "./text.js";

// Phases with a set point.
export const ACTIVE = new Set(["running", "paused", "held"]);

const RETRY_MS = 500;
// The viewer sends a batch every quarter of a second; after this silence the connection counts as lost.
const LOST_AFTER_S = 1.0;
// Messages that are further from now come from a replay; a step back by more than this starts it again.
const REPLAYED_S = 5.0;

// The viewer sends at most 30 moments a second, and a click names one of before it.
const MOST_MOMENTS = 300;

// Lines of the list of what happened.
const MOST_EVENTS = 200;

const seconds = () => performance.now() / 1000;

export class Link {
  // Calls onMessage(message) for each message, and for the history.
  constructor(settings, onMessage) {
    this.settings = settings;
    this.latest = new Map();
    this.refused = {};
    // What happened, oldest first; another viewer begins another list.
    this.events = [];
    this.eventsOf = 0;
    this.moments = [];
    this.ended = false;
    this.onMessage = onMessage;
    this.batchAt = null;
    this.daemonAt = null;
    this.offset = Date.now() / 1000 - seconds();
    this.said = null;
    this.connect();
  }

  connect() {
    const socket = new WebSocket(`ws://${location.host}/stream`);
    this.socket = socket;
    socket.onmessage = (event) => { if (socket === this.socket) this.take(JSON.parse(event.data)); };
    socket.onclose = () => { if (socket === this.socket) setTimeout(() => this.connect(), RETRY_MS); };
  }

  take(batch) {
    const now = seconds();
    if (batch.first) {
      // Another viewer or daemon: drop all earlier data.
      this.latest.clear();
      this.events = [];
      this.eventsOf += 1;
      this.daemonAt = null;
      this.said = null;
    }
    this.batchAt = now;
    this.moments.push({ at: now, moment: batch.moment });
    if (this.moments.length > MOST_MOMENTS) this.moments.shift();
    this.offset = batch.now - now;
    this.refused = batch.refused;
    this.events.push(...batch.events);
    if (this.events.length > MOST_EVENTS) {
      this.events = this.events.slice(-MOST_EVENTS);
      this.eventsOf += 1;
    }
    this.ended = batch.ended;
    for (const message of batch.history) this.onMessage(message);
    if (batch.quiet_s !== null) this.daemonAt = now - batch.quiet_s;
    for (const message of batch.messages) {
      message.at = now - message.age_s;
      this.latest.set(`${message.topic}/${message.content.source}`, message);
      this.onMessage(message);
    }
    if (batch.messages.length) this.hear(Math.max(...batch.messages.map((message) => message.content.timestamp - message.at)));
  }

  // The latest message time minus this page's time; a frame is older than the messages that follow it.
  hear(said) {
    if (this.said === null || said > this.said || this.said - said > REPLAYED_S) this.said = said;
  }

  // Unix time of the viewer's clock (a tablet's may be wrong); in a replay, the recording's time.
  unixNow() {
    const replayed = this.said !== null && Math.abs(this.said - this.offset) > REPLAYED_S;
    return seconds() + (replayed ? this.said : this.offset);
  }

  // The viewer's latest moment that was here when an event happened; the page may have stood still since.
  momentOf(event) {
    return this.moments.findLast(({ at }) => at <= event.timeStamp / 1000)?.moment ?? "";
  }

  sinceBatch() { return this.batchAt === null ? Infinity : seconds() - this.batchAt; }

  viewerLost() { return this.sinceBatch() > LOST_AFTER_S; }

  sinceDaemon() { return this.daemonAt === null ? Infinity : seconds() - this.daemonAt; }

  // live; ended: the daemon said that it ends; dead: no message from the daemon; lost: no message from the viewer.
  state() {
    if (this.viewerLost()) {
      // Close a socket that is open but silent, as after the computer slept.
      if (this.batchAt !== null && this.sinceBatch() > 3 && this.socket.readyState === WebSocket.OPEN) this.socket.close();
      if (this.batchAt === null) return "connecting";
      // A viewer that ends with its daemon loses nothing.
      return this.end() ? "ended" : "lost";
    }
    if (this.end()) return "ended";
    return this.sinceDaemon() > this.settings.dead_after_s ? "dead" : "live";
  }

  // The daemon's last message, until another one arrives.
  end() { return this.ended ? this.get("daemon.end") : undefined; }

  // Whether the daemon has ended because its work is done, and not because a person or a fault stopped it.
  done() { return Boolean(this.end()?.content.finished) && this.get("loop.state")?.content.phase === "done"; }

  // Whether no experiment runs: a sensor that touches nothing is then no fault.
  idle() {
    const loop = this.get("loop.state")?.content;
    return loop !== undefined && !ACTIVE.has(loop.phase) && !loop.response.startsWith("stop");
  }

  ageOf(message) { return seconds() - message.at; }

  // Whether a message is stale; all are once the daemon has ended.
  isOld(message) {
    return this.state() !== "live" || this.ageOf(message) > this.staleAfter(message);
  }

  // A device that is slower than usual has the period that its task expects.
  staleAfter({ topic, content }) {
    const usual = this.settings.stale_after_s[topic] ?? 3;
    const expectedHz = this.get("health")?.content.tasks?.[content.source]?.expected_hz;
    return expectedHz > 0 ? Math.max(usual, this.settings.stale_after_periods / expectedHz) : usual;
  }

  // The latest message of a topic: of one source, or of the first source.
  get(topic, source) {
    if (source !== undefined) return this.latest.get(`${topic}/${source}`);
    for (const message of this.latest.values()) if (message.topic === topic) return message;
    return undefined;
  }

  // The unit of a message's key; empty without one.
  unit(topic, key) { return this.settings.units[topic]?.[key] ?? ""; }

  // The number of a message's key with its unit; a dash without the message or the number.
  number(message, key, digits, signed) {
    return message ? number(message.content[key], digits, this.unit(message.topic, key), signed) : "–";
  }

  sources(topic) {
    return [...this.latest.values()].filter((message) => message.topic === topic).map((message) => message.content.source).sort();
  }
}
