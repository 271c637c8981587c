// The timeline of the run: a list of its events with a filter, and notes.

import { duration, make, say, wall } from "./format.js";

const KINDS = ["mode", "attitude", "fault", "telecommand", "clock", "note", "page"];
const SHOWN = 500;

export class Events {
  constructor(store, link, charts) {
    this.store = store;
    this.link = link;
    this.charts = charts;
    this.host = document.getElementById("events");
    this.text = "";
    this.active = false;
    this.build();
    store.on("events", () => this.render());
    store.on("hello", () => this.render());
  }

  build() {
    const filter = make("input", { type: "search", placeholder: "filter events", "aria-label": "filter events", oninput: () => { this.text = filter.value.trim().toLowerCase(); this.render(); } });
    const kinds = KINDS.map((kind) => {
      const box = make("input", { type: "checkbox", onchange: () => {
        if (box.checked) this.charts.hidden.delete(kind);
        else this.charts.hidden.add(kind);
        this.render();
        this.charts.schedule();
      } });
      box.checked = !this.charts.hidden.has(kind);
      return make("label", { class: "check" }, box, kind);
    });
    this.note = make("input", { placeholder: "a note at this moment", "aria-label": "note", maxlength: "500" });
    const form = make("form", { class: "bar", onsubmit: (event) => { event.preventDefault(); this.add(); } }, this.note, make("button", { type: "submit", text: "Add note" }));
    this.list = make("ol", { class: "log scroll events", tabindex: "0", "aria-label": "events, newest first" });
    this.host.append(make("div", { class: "bar" }, filter), make("div", { class: "bar wrap" }, ...kinds), make("fieldset", { class: "commands" }, form), this.list);
  }

  show(active) {
    this.active = active;
    if (active) this.render();
  }

  async add() {
    const at = this.store.cursor;
    const answer = await this.link.request({ do: "note", text: this.note.value, ...(at === null ? {} : { at_s: at }) });
    say(answer.ok ? "the note was added" : answer.error);
    if (answer.ok) this.note.value = "";
  }

  render() {
    if (!this.active) return;
    const shown = this.store.events.filter((event) => !this.charts.hidden.has(event.kind) && `${event.kind} ${event.text}`.toLowerCase().includes(this.text)).slice(-SHOWN).reverse();
    const there = new Map([...this.list.children].map((item) => [item.dataset.n, item]));
    this.list.replaceChildren(...shown.map((event) => there.get(String(event.n)) || this.item(event)));
  }

  item(event) {
    return make("li", { class: event.level, "data-n": String(event.n) },
      make("button", { type: "button", class: "small num", text: duration(event.t), title: "show this moment", "aria-label": `show ${duration(event.t)}: ${event.text}`, onclick: () => this.store.scrub(event.t) }),
      make("span", { class: "dim", text: event.kind }), make("span", { class: "text outcome", text: event.text }), make("time", { class: "num dim", text: wall(event.wall_s).slice(0, 8) }));
  }
}
