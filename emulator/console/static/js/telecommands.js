// A form for each telecommand, with a preview of its bytes, and what was sent.

import { address } from "./link.js";
import { ask, limits, make, number, prose, say, setText, setValue, short, wall } from "./format.js";

const KEPT_LINES = 200;

export class Telecommands {
  constructor(store, link) {
    this.store = store;
    this.link = link;
    this.host = document.getElementById("telecommands");
    this.chosen = null;
    store.on("hello", (hello) => this.build(hello));
    store.on("sent", (message) => this.note(message));
    store.on("status", (message) => {
      this.count(message.session_steps);
      this.followParameter();
    });
  }

  build(hello) {
    this.rows = new Map(hello.telecommands.map((row) => [row.name, row]));
    this.parameters = hello.parameters;
    this.filter = make("input", { type: "search", placeholder: "filter telecommands", "aria-label": "filter telecommands", oninput: () => this.list() });
    this.select = make("select", { id: "telecommand", size: "8", "aria-label": "telecommand", onchange: () => this.choose(this.select.value) });
    this.form = make("form", { id: "telecommand-form", onsubmit: (event) => this.send(event) });
    this.form.addEventListener("keydown", (event) => {
      if (event.ctrlKey && event.key === "Enter") this.form.requestSubmit();
    });
    this.log = make("ol", { class: "log scroll", id: "sent", tabindex: "0", "aria-label": "sent" });
    this.steps = make("span", { class: "num dim", text: "0 sent" });
    const save = make("a", { class: "button", id: "save-session", href: address("/session.toml"), download: "session.toml", title: "what this console has sent, for `starhil session`", text: "save as session" });
    const clear = make("button", { type: "button", id: "clear-session", text: "clear", onclick: () => this.link.request({ do: "clear_session" }) });
    this.host.replaceChildren(
      make("div", { class: "bar" }, this.filter), this.select, make("fieldset", { class: "commands" }, this.form),
      make("div", { class: "bar" }, make("h2", { text: "Sent" }), this.steps, make("span", { class: "spacer" }), save, clear), this.log);
    this.list();
    if (this.rows.has(this.chosen)) this.choose(this.chosen);
    else this.form.replaceChildren(make("p", { class: "dim doc", text: "Choose a telecommand." }));
  }

  list() {
    const wanted = this.filter.value.trim().toLowerCase();
    const rows = [...this.rows.values()].filter((row) => `${row.id} ${row.name} ${row.doc}`.toLowerCase().includes(wanted));
    this.select.replaceChildren(...rows.map((row) => make("option", { value: row.name, text: `${String(row.id).padStart(3, "\u2007")}  ${row.name}`, selected: row.name === this.chosen })));
  }

  // Show the form of a telecommand, with values of it.
  choose(name, values = {}) {
    this.chosen = name;
    if (![...this.select.options].some((option) => option.value === name)) {
      this.filter.value = "";
      this.list();
    }
    this.select.value = name;
    const row = this.rows.get(name);
    const fields = row.fields.map((field) => {
      const control = this.control(field);
      const note = make("span", { class: "dim num", "data-note": field.name, text: field.parameters ? "" : [field.unit, limits(field)].filter(Boolean).join("  ") });
      return make("label", { class: "field", title: field.doc }, make("span", { text: field.name }), control, note);
    });
    this.problem = make("p", { class: "problem" });
    this.bytes = make("pre", { class: "bytes", id: "bytes", tabindex: "0", role: "group", "aria-label": "bytes" });
    const send = make("button", { type: "submit", class: "primary", id: "send", title: `send ${name} (Ctrl+Enter in this form)`, text: `Send ${name}` });
    this.form.replaceChildren(make("p", { class: "dim doc" }, ...prose(row.doc)), ...fields, this.bytes, this.problem, send);
    for (const [key, item] of Object.entries(values)) if (this.form.elements[key]) this.form.elements[key].value = String(item);
    this.form.oninput = (event) => {
      if (event.target.name === "value") event.target.dataset.edited = "yes";
      this.preview();
    };
    this.form.onchange = (event) => {
      if (event.target.dataset.parameters) delete this.form.elements.value.dataset.edited;
      this.showParameter();
    };
    if ("value" in values) this.form.elements.value.dataset.edited = "yes";
    this.showParameter();
  }

  // Beside a value for a parameter: its unit, limits and present value, with which the field begins.
  async showParameter() {
    const select = this.form.querySelector("[data-parameters]");
    this.limits = select && this.parameters.find((item) => String(item.id) === select.value);
    await this.followParameter();
    this.preview();
  }

  // Show the present value again: this page's telecommand, another OBC or a reset may have changed it.
  async followParameter() {
    const parameter = this.limits;
    const note = this.form && this.form.querySelector("[data-note=value]");
    if (!parameter || !note || this.host.offsetParent === null) return;
    const { values } = await this.link.request({ do: "parameters" });
    if (parameter !== this.limits) return; // another was chosen meanwhile
    const { name, unit, min, max } = parameter;
    const field = this.form.elements.value;
    if (values && field && !field.dataset.edited && field.value !== String(values[name])) {
      setValue(field, String(values[name]));
      this.preview();
    }
    const present = values ? [short(values[name]), unit].filter(Boolean).join(" ") : "–";
    setText(note, `now ${present}\n${short(min)} … ${short(max)}`);
  }

  control(field) {
    const name = field.name;
    if (field.kind === "enum") return make("select", { name }, ...field.values.map((item) => make("option", { value: item, text: item, selected: item === field.default })));
    if (field.kind === "flag") return make("select", { name }, make("option", { value: "false", text: "no" }), make("option", { value: "true", text: "yes", selected: field.default === true }));
    if (field.parameters) {
      return make("select", { name, "data-parameters": true }, ...this.parameters.map((item) => make("option", { value: String(item.id), text: `${item.id} ${item.name}` })));
    }
    const initial = field.default ?? (field.kind === "bytes" ? "00".repeat(field.bytes) : field.kind === "text" ? "" : Math.max(0, Number(field.min ?? 0)));
    return make("input", { name, value: String(initial), autocomplete: "off", spellcheck: "false", inputmode: field.kind === "text" || field.kind === "bytes" ? "text" : "decimal" });
  }

  values() {
    return Object.fromEntries([...this.form.elements].filter((each) => each.name).map((each) => [each.name, each.value]));
  }

  async preview() {
    const name = this.chosen;
    const values = this.values();
    const answer = await this.link.request({ do: "encode", row: name, values });
    if (name !== this.chosen) return;
    if (!answer.ok) {
      setText(this.problem, answer.error);
      setText(this.bytes, "");
      return;
    }
    const beyond = this.limits && values.value !== undefined ? number(values.value, this.limits.min, this.limits.max).problem : "";
    const problem = answer.problem || (beyond && `${this.limits.name}: ${beyond}`);
    setText(this.problem, problem ? `violates the definition, but can be sent: ${problem}` : "");
    const lines = [];
    if (answer.serial) lines.push(`serial   ${answer.serial}`);
    for (const [who, frames] of [["as this console", answer.cansend], [`as OBC ${answer.obc_address}`, answer.as_obc]]) {
      if (!frames || !frames.length) continue;
      if (answer.as_obc.length) lines.push(`${who}:`);
      for (const frame of frames) lines.push(`cansend ${this.interface()} ${frame}`);
    }
    setText(this.bytes, lines.join("\n"));
  }

  interface() {
    const can = this.store.hello.links.can || "";
    return can.startsWith("socketcan:") ? can.slice(10) : "vcan0";
  }

  async send(event) {
    event.preventDefault();
    await this.transmit(this.chosen, this.values());
    this.showParameter();
  }

  // Send a telecommand, after a question if it interrupts the device or deletes something.
  async transmit(row, values) {
    if (this.rows.get(row).confirm && await ask(`${row} interrupts the unit or deletes something. Send it?`, `Send ${row}`) === "") return;
    const answer = await this.link.request({ do: "send", row, values });
    if (answer.ok) return;
    this.add({ kind: "telecommand", row, values, wall_s: Date.now() / 1000, outcome: "not_sent", detail: answer.error, refused: false });
    say(`${row}: ${answer.error}`);
  }

  // What this console, on any page, has sent.
  note(message) {
    if (!this.log) return;
    if (message.all) this.log.replaceChildren();
    for (const item of message.items) this.add(item);
    const last = message.items.at(-1);
    if (last && !message.all) {
      this.link.noteReply(this.store.time, last);
      say(`${last.row} ${outcome(last)}`);
    }
  }

  add(item) {
    const command = item.kind === "telecommand";
    const pairs = command ? Object.entries(item.values).map(([key, one]) => `${key}=${one}`).join(" ") : "";
    const again = command && this.rows.has(item.row) ? [
      make("button", { type: "button", class: "small", text: "again", "aria-label": `send ${item.row} again`, onclick: () => this.transmit(item.row, item.values) }),
      make("button", { type: "button", class: "small", text: "edit", "aria-label": `edit ${item.row}`, onclick: () => this.choose(item.row, item.values) }),
    ] : [];
    const line = make("li", { class: item.outcome === "ok" ? "good" : "bad" },
      make("time", { class: "num dim", text: wall(item.wall_s).slice(0, 8) }), make("b", { text: item.row }), make("span", { class: "num pairs", text: pairs }),
      make("span", { class: "outcome", text: outcome(item) }), make("fieldset", { class: "commands" }, ...again));
    this.log.prepend(line);
    while (this.log.children.length > KEPT_LINES) this.log.lastChild.remove();
  }

  count(steps) {
    if (this.steps) setText(this.steps, `${steps} sent`);
  }
}

function outcome({ kind, outcome: name, detail, refused, latency_ms: taken }) {
  if (name === "ok") return `${kind === "telecommand" ? "accepted" : "read"} in ${taken.toFixed(1)} ms`;
  return refused ? `refused: ${name}` : detail;
}
