// The page's end of the wire: what was heard last, when, and whether anybody is still there.

const RETRY_MS = 500;
// The viewer says something every quarter of a second; after this silence the connection is taken for lost.
const LOST_AFTER_S = 1.0;
// What is said of a time further from now is said by a replay; until it speaks of times that much earlier, it goes on.
const REPLAYED_S = 5.0;

const seconds = () => performance.now() / 1000;

export class Link {
  // onMessage(message) is called for each message, and for what was before this page.
  constructor(settings, onMessage) {
    this.settings = settings;
    this.latest = new Map();
    this.refused = {};
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
      // Another viewer, perhaps another daemon: nothing from before may stand beside what comes now.
      this.latest.clear();
      this.daemonAt = null;
      this.said = null;
    }
    this.batchAt = now;
    this.offset = batch.now - now;
    this.refused = batch.refused;
    for (const message of batch.history) this.onMessage(message);
    if (batch.quiet_s !== null) this.daemonAt = now - batch.quiet_s;
    for (const message of batch.messages) {
      message.at = now - message.age_s;
      this.latest.set(`${message.topic}/${message.content.source}`, message);
      this.onMessage(message);
    }
    if (batch.messages.length) this.hear(Math.max(...batch.messages.map((message) => message.content.timestamp - message.at)));
  }

  // The latest time that is spoken of, less this page's: a frame speaks of a while ago, what follows it of now.
  hear(said) {
    if (this.said === null || said > this.said || this.said - said > REPLAYED_S) this.said = said;
  }

  // Unix time by the viewer's clock (the tablet's own may be wrong); of a replay, the recording's.
  unixNow() {
    const replayed = this.said !== null && Math.abs(this.said - this.offset) > REPLAYED_S;
    return seconds() + (replayed ? this.said : this.offset);
  }

  sinceBatch() { return this.batchAt === null ? Infinity : seconds() - this.batchAt; }

  sinceDaemon() { return this.daemonAt === null ? Infinity : seconds() - this.daemonAt; }

  // live; dead: no daemon is heard; lost: the viewer itself is not.
  state() {
    if (this.sinceBatch() > LOST_AFTER_S) {
      // A socket that is open and silent, as after the computer slept, is given up.
      if (this.batchAt !== null && this.sinceBatch() > 3 && this.socket.readyState === WebSocket.OPEN) this.socket.close();
      return this.batchAt === null ? "connecting" : "lost";
    }
    return this.sinceDaemon() > this.settings.dead_after_s ? "dead" : "live";
  }

  ageOf(message) { return seconds() - message.at; }

  // Whether a message says nothing of the present any more.
  isOld(message) {
    return this.state() !== "live" || this.ageOf(message) > this.staleAfter(message);
  }

  // A device that is slower than its topic's usual one is given the time that its task expects of it.
  staleAfter({ topic, content }) {
    const usual = this.settings.stale_after_s[topic] ?? 3;
    const expectedHz = this.get("health")?.content.tasks?.[content.source]?.expected_hz;
    return expectedHz > 0 ? Math.max(usual, this.settings.stale_after_periods / expectedHz) : usual;
  }

  // The latest message of a topic: of one source, or of the first that was heard.
  get(topic, source) {
    if (source !== undefined) return this.latest.get(`${topic}/${source}`);
    for (const message of this.latest.values()) if (message.topic === topic) return message;
    return undefined;
  }

  sources(topic) {
    return [...this.latest.values()].filter((message) => message.topic === topic).map((message) => message.content.source).sort();
  }
}
