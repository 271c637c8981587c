// The WebSocket to the emulator: requests with answers, messages, frames, and reconnection.

const QUERY = new URLSearchParams(location.search);
const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 5000;
const FRAME = 70; // "F"

// The address of a path, for the head of this page or another one.
export function address(path, head = QUERY.get("head")) {
  const query = new URLSearchParams({ token: QUERY.get("token") || "", ...(head && { head }) });
  return `${path}?${query}`;
}

export class Link {
  constructor({ message, frame = () => {}, history = () => {}, state }) {
    this.handlers = { message, frame, history, state };
    this.wanted = { frames: false, wire: false, rows: [] };
    this.waiting = new Map();
    this.next = 1;
    this.retry = FIRST_RETRY_MS;
    this.connect();
  }

  connect() {
    this.handlers.state("connecting");
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${address("/ws")}`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.retry = FIRST_RETRY_MS;
      this.handlers.state("connected");
      this.send();
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
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "answer") {
        const answer = this.waiting.get(message.id);
        this.waiting.delete(message.id);
        if (answer) answer(message);
      } else {
        this.handlers.message(message);
      }
      return;
    }
    const bytes = new DataView(data);
    if (bytes.getUint8(0) === FRAME) {
      const [numbers, overlay] = [bytes.getUint32(1, true), bytes.getUint32(5, true)];
      const parse = (start, length) => JSON.parse(new TextDecoder().decode(new Uint8Array(data, start, length)));
      const head = { ...parse(9, numbers), ...parse(9 + numbers, overlay) };
      const image = new Uint8Array(data, 9 + numbers + overlay);
      this.handlers.frame(head, image.length ? new Blob([image], { type: "image/jpeg" }) : null);
      this.socket.send('{"do": "received"}'); // the next image comes then
    } else {
      this.handlers.history(new Float64Array(data, 8));
    }
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

  // A hidden page has no subscriptions.
  send() {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    const wanted = document.hidden ? { frames: false, wire: false, rows: [] } : this.wanted;
    this.request({ do: "subscribe", ...wanted });
  }
}
