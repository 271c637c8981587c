// The WebSocket to the emulator: requests with answers, turns, and reconnection.
//
// A turn is all that the server has for the page: messages, rows of the history, an image. The next one comes when this one is
// acknowledged, so that nothing queues on the way. The acknowledgement has the page's time, which the server returns with its
// own: so the page knows how old a turn is.

const QUERY = new URLSearchParams(location.search);
const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 5000;
const KEPT_REPLIES = 20_000;

// The address of a path, for the head of this page or another one.
export function address(path, head = QUERY.get("head"), more = {}) {
  const query = new URLSearchParams({ token: QUERY.get("token") || "", ...(head && { head }), ...more });
  return `${path}?${query}`;
}

export class Link {
  // `known` returns the numbers of the next row and the next event that the page lacks.
  constructor({ message, image, rows, state, known }) {
    this.handlers = { message, image, rows, state, known };
    this.wanted = { frames: false, wire: false, rows: [] };
    this.waiting = new Map();
    this.next = 1;
    this.retry = FIRST_RETRY_MS;
    this.replies = []; // simulation time, and how long a reply to this console took, ms; null if none came
    this.offset = Infinity;
    this.newest = null;
    this.described = false;
    this.socket = { readyState: WebSocket.CLOSED };
  }

  connect() {
    this.handlers.state("connecting");
    this.offset = Infinity; // of the server's clock, ms; too large by what an acknowledgement takes
    this.newest = null; // when the newest turn was made, by the page's clock
    this.described = false;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${address("/ws")}`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.retry = FIRST_RETRY_MS;
      this.handlers.state("connected");
    };
    socket.onmessage = (event) => this.receive(event.data);
    socket.onclose = () => {
      this.handlers.state("disconnected");
      this.explain();
      for (const answer of this.waiting.values()) answer({ ok: false, error: "the connection was lost" });
      this.waiting.clear();
      setTimeout(() => this.connect(), this.retry);
      this.retry = Math.min(2 * this.retry, LAST_RETRY_MS);
    };
    this.socket = socket;
  }

  // A socket does not say why it was closed; the page of another run does: it rejects the token of this one.
  async explain() {
    try {
      const answer = await fetch(address("/"), { cache: "no-store" });
      if (answer.status === 403) this.handlers.state("restarted");
    } catch {
      // nobody listens at the address
    }
  }

  receive(data) {
    const now = performance.now();
    this.socket.send(JSON.stringify({ do: "received", at: now }));
    const length = new DataView(data).getUint32(0, true);
    const turn = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    if (turn.echo) this.offset = Math.min(this.offset, turn.echo[1] - turn.echo[0]);
    this.newest = turn.at;
    for (const message of turn.messages) this.dispatch(message);
    const end = this.handlers.rows(data, 4 + length, ...turn.rows);
    if (turn.image) this.handlers.image(turn.image, new Blob([new Uint8Array(data, end)], { type: "image/jpeg" }));
  }

  dispatch(message) {
    if (message.type === "answer") {
      const answer = this.waiting.get(message.id);
      this.waiting.delete(message.id);
      if (answer) answer(message);
      return;
    }
    this.handlers.message(message);
    if (message.type === "hello") {
      this.described = true;
      this.send();
    }
  }

  // Age of the newest turn, s: what the page shows is as old.
  get age() {
    return this.newest === null || !Number.isFinite(this.offset) ? 0 : Math.max(0, performance.now() + this.offset - this.newest) / 1000;
  }

  // Note how long a reply to this console took.
  noteReply(time, { latency_ms: taken }) {
    this.replies.push([time, taken ?? null]);
    if (this.replies.length > KEPT_REPLIES) this.replies.shift();
  }

  // Resolve with the answer; its `ok` reports whether the request was executed.
  request(content) {
    if (this.socket.readyState !== WebSocket.OPEN) {
      return Promise.resolve({ ok: false, error: "not connected to the emulator" });
    }
    const id = this.next++;
    return new Promise((resolve) => {
      this.waiting.set(id, resolve);
      this.socket.send(JSON.stringify({ id, ...content }));
    });
  }

  control(request) {
    return this.request({ do: "control", request });
  }

  subscribe(change) {
    Object.assign(this.wanted, change);
    this.send();
  }

  // A hidden page has no subscriptions; when it is shown again, it gets what it lacks.
  send() {
    if (!this.described || this.socket.readyState !== WebSocket.OPEN) return;
    const wanted = document.hidden ? { frames: false, wire: false, rows: [] } : this.wanted;
    this.request({ do: "subscribe", ...wanted, ...this.handlers.known() });
  }
}
