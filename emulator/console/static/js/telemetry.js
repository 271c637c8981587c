// All telemetry rows, decoded live; only rows that are visible or plotted are read.

import { limits, make, name as named, setText, value, wall } from "./format.js";

const STALE_MS = 5000;

export class Telemetry {
  constructor(store, link, charts) {
    this.store = store;
    this.link = link;
    this.charts = charts;
    this.host = document.getElementById("telemetry");
    this.blocks = new Map();
    this.seen = new Set();
    this.active = false;
    this.text = "";
    store.on("hello", (hello) => this.build(hello));
    store.on("telemetry", (message) => this.update(message));
    store.on("plotted", () => this.subscribe());
    store.on("cursor", () => this.subscribe());
    setInterval(() => this.age(), 1000);
  }

  build(hello) {
    if (this.observer) this.observer.disconnect();
    this.blocks.clear();
    this.seen.clear();
    const filter = make("input", { type: "search", placeholder: "filter rows and fields", "aria-label": "filter rows and fields", value: this.text, oninput: () => this.filter(filter.value) });
    const scroll = make("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "telemetry rows" });
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
    this.filter(this.text);
  }

  block(row) {
    const when = make("span", { class: "num dim when" });
    const fields = new Map();
    const table = make("table", { id: `row-${row.name}` });
    for (const field of row.fields) {
      const cell = make("td", { class: "num val", text: "–" });
      fields.set(field.name, { cell, field });
      table.append(make("tr", { title: field.doc }, make("th", { scope: "row" }, ...named(field.name)), cell, make("td", { class: "unit dim", text: field.unit }), make("td", { class: "num dim lim", text: limits(field) })));
    }
    const fold = make("button", { type: "button", class: "fold", "aria-expanded": "true", "aria-controls": table.id, title: row.doc }, make("span", { class: "num dim", text: String(row.id) }), make("b", {}, ...named(row.name)));
    const read = make("button", { type: "button", class: "read", text: "read", "aria-label": `read ${row.name}`, title: "read once, as a step of the session", onclick: () => this.link.request({ do: "read", row: row.name }).then((answer) => answer.ok && this.update({ row: row.name, ...answer })) });
    const element = make("section", { class: "row", "data-row": row.name, "aria-label": row.name }, make("div", { class: "row-head" }, fold, make("span", { class: "spacer" }), when, read), table);
    fold.addEventListener("click", () => {
      table.hidden = !table.hidden;
      fold.setAttribute("aria-expanded", String(!table.hidden));
      this.subscribe();
    });
    return { element, when, fields, at: 0, row, table };
  }

  show(active) {
    this.active = active;
    this.subscribe();
  }

  // While the page is paused, nothing is read.
  subscribe() {
    const visible = this.active && this.store.cursor === null ? [...this.seen].filter((name) => !this.blocks.get(name).table.hidden) : [];
    const rows = [...new Set([...visible, ...this.charts.rows])];
    if (rows.join() !== this.link.wanted.rows.join()) this.link.subscribe({ rows });
  }

  update(message) {
    const block = this.blocks.get(message.row);
    this.link.noteReply(this.store.time, message);
    if (!block || this.store.cursor !== null) return;
    block.at = performance.now();
    const failed = message.outcome !== "ok";
    block.element.classList.toggle("bad", failed);
    block.element.classList.remove("stale");
    setText(block.when, failed ? message.outcome.replaceAll("_", " ") : `${message.latency_ms.toFixed(1).padStart(5)} ms ${wall(Date.now() / 1000).slice(0, 8)}`);
    for (const [name, item] of Object.entries(message.values || {})) {
      const { cell, field } = block.fields.get(name);
      setText(cell, value(item, field));
      const outside = typeof item === "number" && field.min !== undefined && (item < Number(field.min) || item > Number(field.max));
      cell.classList.toggle("outside", outside);
    }
  }

  age() {
    const now = performance.now();
    for (const block of this.blocks.values()) block.element.classList.toggle("stale", block.at > 0 && now - block.at > STALE_MS);
  }

  filter(text) {
    this.text = text;
    const wanted = text.trim().toLowerCase();
    for (const { element, row } of this.blocks.values()) {
      const found = !wanted || row.name.includes(wanted) || row.fields.some((field) => field.name.includes(wanted));
      element.hidden = !found;
    }
  }
}
