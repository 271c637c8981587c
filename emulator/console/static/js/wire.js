// The traffic of all links, decoded, with filters; a message opens on a click.

import { address } from "./link.js";
import { fixed, make, press, say, setText, value, wall } from "./format.js";

const KEPT_LINES = 1000;
const SHOWN_LINES = 400;
const PAUSE_MS = 100;
const FLOOD_PAUSE_MS = 1000; // between two renderings of more lines than anyone can read
const FLOOD_LINES = 50;
const FLOOD_SHOWN_LINES = 100; // of those, the newest; a filter shows the others that are kept
const HUES = 6;
const KINDS = [["requests", ["telecommand", "telemetry"]], ["replies", ["ack", "reply"]], ["refusals, faults", ["nack", "fault"]], ["parts", ["part"]], ["CANopen", ["canopen"]]];

export class Wire {
  constructor(store, link) {
    this.store = store;
    this.link = link;
    this.host = document.getElementById("wire");
    this.lines = [];
    this.hidden = new Set(["part"]);
    this.titles = {};
    this.hiddenBuses = new Set();
    this.own = false;
    this.text = "";
    this.held = false;
    this.pending = null;
    this.fresh = 0;
    this.build();
    store.on("hello", (hello) => this.begin(hello));
    store.on("wire", (message) => this.add(message));
    store.on("cursor", () => this.render());
  }

  check(label, on, change) {
    const box = make("input", { type: "checkbox", onchange: () => { change(box.checked); this.render(true); } });
    box.checked = on;
    return make("label", { class: "check" }, box, label);
  }

  begin(hello) {
    this.lines = [];
    this.titles = hello.buses;
    this.buses.replaceChildren(...Object.entries(this.titles).filter(([bus]) => bus !== "console").map(([bus, title]) => this.check(title, !this.hiddenBuses.has(bus), (on) => (on ? this.hiddenBuses.delete(bus) : this.hiddenBuses.add(bus)))));
    this.candump.hidden = !("can" in hello.links);
    this.render(true);
  }

  build() {
    const filter = make("input", { type: "search", placeholder: "filter: name, hex, address", "aria-label": "filter messages", oninput: () => { this.text = filter.value.trim().toLowerCase(); this.render(true); } });
    this.hold = make("button", { type: "button", "aria-pressed": "false", text: "hold", onclick: () => this.setHeld(!this.held) });
    this.buses = make("span", { class: "bar wrap" });
    const kinds = KINDS.map(([label, names]) => this.check(label, !this.hidden.has(names[0]), (on) => { for (const name of names) on ? this.hidden.delete(name) : this.hidden.add(name); }));
    kinds.push(this.check("console", this.own, (on) => (this.own = on)));
    this.left = make("span", { class: "num dim" });
    const file = (path, name, text) => make("a", { class: "button", href: address(path), download: name, text });
    this.candump = file("/wire.log", "wire.log", "candump log");
    const files = [file("/wire.txt", "wire.txt", "text"), this.candump, file("/wire.pcapng", "wire.pcapng", "pcapng"), file("/record.mcap", "record.mcap", "MCAP")];
    this.detail = make("div", { class: "message", hidden: true });
    this.list = make("ol", { class: "trace scroll", tabindex: "0", "aria-label": "messages, newest first" });
    this.list.addEventListener("click", (event) => {
      const line = event.target.closest("li");
      if (line && event.target.closest("button")) this.open(Number(line.dataset.n));
    });
    this.host.append(make("div", { class: "bar" }, filter, this.hold, this.left), make("div", { class: "bar wrap" }, make("span", { class: "dim", text: "save:" }), ...files), make("div", { class: "bar wrap" }, this.buses, ...kinds), this.detail, this.list);
  }

  show(active) {
    this.link.subscribe({ wire: active });
    if (active) this.render();
  }

  setHeld(held) {
    this.held = held;
    press(this.hold, held);
    this.render();
  }

  add(message) {
    const last = this.lines.length ? this.lines.at(-1).n : -1;
    this.lines.push(...message.items.filter((line) => line.n > last));
    if (this.lines.length > KEPT_LINES) this.lines.splice(0, this.lines.length - KEPT_LINES);
    setText(this.left, message.left_out ? `${message.left_out} left out` : "");
    this.pending ??= setTimeout(() => { this.pending = null; this.render(); }, this.fresh > FLOOD_LINES ? FLOOD_PAUSE_MS : PAUSE_MS);
  }

  wanted(line) {
    if ((line.own && !this.own) || this.hidden.has(line.kind) || this.hiddenBuses.has(line.bus)) return false;
    return !this.text || `${line.raw} ${line.text}`.toLowerCase().includes(this.text);
  }

  // Newest first; only what is new is put on the screen, unless the filter has changed.
  render(again = false) {
    if (!again && (this.held || this.store.cursor !== null)) return;
    if (again) this.list.replaceChildren();
    const newest = this.list.firstElementChild ? Number(this.list.firstElementChild.dataset.n) : -1;
    const fresh = this.lines.filter((line) => line.n > newest && this.wanted(line)).slice(-(this.fresh > FLOOD_LINES && !again ? FLOOD_SHOWN_LINES : SHOWN_LINES));
    let before = this.list.firstElementChild ? Number(this.list.firstElementChild.dataset.t) : null;
    const items = fresh.map((line) => {
      const item = this.item(line, before);
      before = line.t;
      return item;
    });
    this.fresh = items.length;
    this.list.prepend(...items.reverse());
    while (this.list.children.length > SHOWN_LINES) this.list.lastElementChild.remove();
  }

  item(line, before) {
    return make(
      "li",
      { class: line.kind, "data-n": String(line.n), "data-t": String(line.t) },
      make("time", { class: "num dim", text: wall(line.t) }),
      make("span", { class: "num dim since", title: "seconds since the line below", text: before === null ? "" : `+${fixed(line.t - before, 3)}` }),
      make("span", { class: "way", text: `${line.own ? "own" : this.titles[line.bus].slice(0, 3)} ${line.out ? "◀" : "▶"}`, title: line.out ? "from the device" : "to the device, or between others" }),
      make("button", { type: "button", class: "text", text: line.text }),
      make("code", { text: line.raw }),
    );
  }

  // A message with all its bytes, coloured by field.
  async open(n) {
    const answer = await this.link.request({ do: "message", n });
    const close = make("button", { type: "button", class: "small", text: "close", onclick: () => (this.detail.hidden = true) });
    this.detail.hidden = false;
    if (!answer.ok) {
      this.detail.replaceChildren(make("p", { class: "problem", text: answer.error }), close);
      return;
    }
    const copies = [["hex", (answer.data || answer.raw.join(" ")).replaceAll(" ", "")], ["cansend", answer.cansend.map((frame) => `cansend vcan0 ${frame}`).join("\n")], ["Python", answer.python]];
    const buttons = copies.filter(([, text]) => text).map(([label, text]) => make("button", { type: "button", class: "small", text: `copy ${label}`, onclick: () => copy(text, label) }));
    const bytes = (answer.data || "").split(" ").filter(Boolean);
    const hue = new Map(answer.fields.map((field, number) => [field, number % HUES]));
    const coloured = bytes.map((text, at) => {
      const field = answer.fields.find((each) => each.start <= at && at < each.end);
      return make("span", { class: field ? `hue-${hue.get(field)}` : "", title: field ? field.name : "", text: `${text} ` });
    });
    const fields = make("table", { class: "facts" }, ...answer.fields.map((field) => make("tr", {},
      make("th", { scope: "row", class: `hue-${hue.get(field)}`, text: field.name }), make("td", { class: "num", text: `${value(field.value)} ${field.unit}` }), make("td", { class: "num dim", text: `bytes ${field.start} … ${field.end - 1}` }))));
    this.detail.replaceChildren(
      make("div", { class: "bar wrap" }, make("b", { text: answer.row || "message" }), make("span", { class: "spacer" }), ...buttons, close),
      make("pre", { class: "bytes" }, ...(coloured.length ? coloured : [answer.raw.join("\n")])), fields);
  }
}

async function copy(text, label) {
  try {
    await navigator.clipboard.writeText(text);
    say(`${label} copied`);
  } catch {
    say("the browser does not let this page copy");
  }
}
