// All telemetry rows, decoded live; only visible rows are read.

import { limits, make, setText, value, wall } from "./format.js";

const STALE_MS = 5000;

export class Telemetry {
  constructor(store, link) {
    this.store = store;
    this.link = link;
    this.host = document.getElementById("telemetry");
    this.blocks = new Map();
    this.seen = new Set();
    this.active = false;
    store.on("hello", (hello) => this.build(hello));
    store.on("telemetry", (message) => this.update(message));
    setInterval(() => this.age(), 1000);
  }

  build(hello) {
    if (this.observer) this.observer.disconnect();
    this.blocks.clear();
    this.seen.clear();
    const filter = make("input", { type: "search", placeholder: "filter rows and fields", "aria-label": "filter", oninput: () => this.filter(filter.value) });
    const scroll = make("div", { class: "scroll" });
    this.observer = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        if (entry.isIntersecting) this.seen.add(entry.target.dataset.row);
        else this.seen.delete(entry.target.dataset.row);
      }
      this.subscribe();
    }, { root: scroll });
    for (const row of hello.telemetry) {
      const block = this.block(row);
      this.blocks.set(row.name, block);
      scroll.append(block.element);
      this.observer.observe(block.element);
    }
    this.host.replaceChildren(make("div", { class: "bar" }, filter), scroll);
  }

  block(row) {
    const when = make("output", { class: "num dim" });
    const fields = new Map();
    const table = make("table");
    for (const field of row.fields) {
      const cell = make("td", { class: "num val", text: "–" });
      fields.set(field.name, { cell, field });
      table.append(make("tr", { title: field.doc }, make("th", { text: field.name }), cell, make("td", { class: "unit dim", text: field.unit }), make("td", { class: "num dim lim", text: limits(field) })));
    }
    const read = make("button", { type: "button", text: "read", title: "read once, as a step of the session", onclick: () => this.read(row.name) });
    const head = make("summary", { title: row.doc }, make("span", { class: "num dim", text: String(row.id) }), make("b", { text: row.name }), make("span", { class: "spacer" }), when, read);
    const element = make("details", { class: "row", "data-row": row.name, open: true }, head, table);
    element.addEventListener("toggle", () => this.subscribe());
    return { element, when, fields, at: 0, row };
  }

  show(active) {
    this.active = active;
    this.subscribe();
  }

  subscribe() {
    const rows = this.active ? [...this.seen].filter((name) => this.blocks.get(name).element.open) : [];
    if (rows.join() === this.link.wanted.rows.join()) return;
    this.link.subscribe({ rows });
  }

  async read(name) {
    const answer = await this.link.request({ do: "read", row: name });
    this.store.emit("sent", { row: name, kind: "read", ...answer });
    if (answer.ok) this.update({ row: name, ...answer });
  }

  update(message) {
    const block = this.blocks.get(message.row);
    if (!block) return;
    block.at = performance.now();
    const failed = message.outcome !== "ok";
    block.element.classList.toggle("bad", failed);
    block.element.classList.remove("stale");
    setText(block.when, failed ? message.outcome.replaceAll("_", " ") : `${message.latency_ms.toFixed(1).padStart(5)} ms ${wall(Date.now() / 1000).slice(0, 8)}`);
    for (const [name, item] of Object.entries(message.values || {})) {
      const { cell, field } = block.fields.get(name);
      setText(cell, value(item, field));
      const outside = typeof item === "number" && field.min !== undefined && (item < field.min || item > field.max);
      cell.classList.toggle("outside", outside);
    }
  }

  age() {
    const now = performance.now();
    for (const block of this.blocks.values()) block.element.classList.toggle("stale", block.at > 0 && now - block.at > STALE_MS);
  }

  filter(text) {
    const wanted = text.trim().toLowerCase();
    for (const { element, row } of this.blocks.values()) {
      const found = !wanted || row.name.includes(wanted) || row.fields.some((field) => field.name.includes(wanted));
      element.hidden = !found;
    }
  }
}
