// The trace of serial line and CAN bus, decoded, with filters.

import { address } from "./link.js";
import { fixed, make, press, setText, wall } from "./format.js";

const KEPT_LINES = 1000;
const SHOWN_LINES = 400;
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
    this.build();
    store.on("hello", (hello) => this.begin(hello));
    store.on("wire", (message) => this.add(message));
  }

  check(label, on, change) {
    const box = make("input", { type: "checkbox", onchange: () => { change(box.checked); this.render(); } });
    box.checked = on;
    return make("label", { class: "check" }, box, label);
  }

  begin(hello) {
    this.lines = [];
    this.titles = hello.buses;
    this.buses.replaceChildren(...Object.entries(this.titles).map(([bus, title]) => this.check(title, !this.hiddenBuses.has(bus), (on) => (on ? this.hiddenBuses.delete(bus) : this.hiddenBuses.add(bus)))));
  }

  build() {
    const filter = make("input", { type: "search", placeholder: "filter: name, hex, address", "aria-label": "filter", oninput: () => { this.text = filter.value.trim().toLowerCase(); this.render(); } });
    this.hold = make("button", { type: "button", text: "hold", onclick: () => this.setHeld(!this.held) });
    this.buses = make("span", { class: "bar wrap" });
    const kinds = KINDS.map(([label, names]) => this.check(label, !this.hidden.has(names[0]), (on) => { for (const name of names) on ? this.hidden.delete(name) : this.hidden.add(name); }));
    kinds.push(this.check("console", this.own, (on) => (this.own = on)));
    this.left = make("output", { class: "num dim" });
    const save = make("a", { class: "button", href: address("/wire.log"), download: "wire.log", text: "candump log" });
    this.list = make("ol", { class: "trace scroll" });
    this.host.append(make("div", { class: "bar wrap" }, filter, this.hold, save, this.left), make("div", { class: "bar wrap" }, this.buses, ...kinds), this.list);
  }

  show(active) {
    this.link.subscribe({ wire: active });
    if (active) this.render();
  }

  setHeld(held) {
    this.held = held;
    press(this.hold, held);
    if (!held) this.render();
  }

  add(message) {
    const last = this.lines.length ? this.lines[this.lines.length - 1].n : -1;
    this.lines.push(...message.lines.filter((line) => line.n > last));
    if (this.lines.length > KEPT_LINES) this.lines.splice(0, this.lines.length - KEPT_LINES);
    if (message.left_out) this.left.textContent = `${message.left_out} left out`;
    else this.left.textContent = "";
    if (!this.held) this.render();
  }

  wanted(line) {
    if ((line.own && !this.own) || this.hidden.has(line.kind) || this.hiddenBuses.has(line.bus)) return false;
    return !this.text || `${line.raw} ${line.text}`.toLowerCase().includes(this.text);
  }

  // Newest first; lines that are already on the screen are kept.
  render() {
    const shown = this.lines.filter((line) => this.wanted(line)).slice(-SHOWN_LINES).reverse();
    const there = new Map([...this.list.children].map((item) => [item.dataset.n, item]));
    this.list.replaceChildren(...shown.map((line, number) => {
      const item = there.get(String(line.n)) || this.item(line);
      const before = shown[number + 1];
      setText(item.querySelector(".since"), before ? `+${fixed(line.t - before.t, 3)}` : "");
      return item;
    }));
  }

  item(line) {
    return make(
      "li",
      { class: line.kind, "data-n": String(line.n) },
      make("time", { class: "num dim", text: wall(line.t) }),
      make("span", { class: "num dim since", title: "seconds since the line below" }),
      make("span", { class: "way", text: `${this.titles[line.bus].slice(0, 3)} ${line.out ? "◀" : "▶"}`, title: line.out ? "from the device" : "to the device, or between others" }),
      make("span", { class: "text", text: line.text, title: line.text }),
      make("code", { text: line.raw }),
    );
  }
}
