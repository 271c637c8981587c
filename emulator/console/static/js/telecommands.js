// A form for each telecommand, with a preview of its bytes, and the reply.

import { address } from "./link.js";
import { limits, make, setText, short, wall } from "./format.js";

const KEPT_LINES = 200;

export class Telecommands {
  constructor(store, link) {
    this.store = store;
    this.link = link;
    this.host = document.getElementById("telecommands");
    this.chosen = null;
    store.on("hello", (hello) => this.build(hello));
    store.on("sent", (item) => this.note(item));
    store.on("status", (message) => this.count(message.session_steps));
  }

  build(hello) {
    this.rows = new Map(hello.telecommands.map((row) => [row.name, row]));
    this.parameters = hello.parameters;
    this.select = make("select", { id: "telecommand", size: "7", "aria-label": "telecommand", onchange: () => this.choose(this.select.value) });
    for (const row of hello.telecommands) this.select.append(make("option", { value: row.name, text: `${String(row.id).padStart(3, "\u2007")}  ${row.name}` }));
    this.form = make("form", { id: "telecommand-form", onsubmit: (event) => this.send(event) });
    this.log = this.log || make("ol", { class: "log scroll", id: "sent" });
    this.steps = make("output", { class: "num dim", text: "0 sent" });
    const save = make("a", { class: "button", id: "save-session", href: address("/session.toml"), download: "session.toml", title: "what this console has sent, for `starhil session`", text: "save as session" });
    const clear = make("button", { type: "button", id: "clear-session", text: "clear", onclick: () => this.clear() });
    this.host.replaceChildren(this.select, make("fieldset", { class: "commands" }, this.form), make("div", { class: "bar" }, make("h2", { text: "Sent" }), this.steps, make("span", { class: "spacer" }), save, clear), this.log);
    if (this.rows.has(this.chosen)) this.choose(this.chosen);
    else this.form.replaceChildren(make("p", { class: "dim doc", text: "Choose a telecommand." }));
  }

  choose(name) {
    this.chosen = name;
    this.select.value = name;
    const row = this.rows.get(name);
    const fields = row.fields.map((field) => {
      const control = this.control(field);
      const note = make("span", { class: "dim num", "data-note": field.name, text: field.parameters ? "" : [field.unit, limits(field)].filter(Boolean).join("  ") });
      return make("label", { class: "field", title: field.doc }, make("span", { text: field.name }), control, note);
    });
    this.problem = make("p", { class: "problem" });
    this.bytes = make("pre", { class: "bytes", id: "bytes" });
    const send = make("button", { type: "submit", class: "primary", id: "send", title: "Ctrl+Enter", text: `send ${name}` });
    this.form.replaceChildren(make("p", { class: "dim doc", text: row.doc }), ...fields, this.bytes, this.problem, send);
    this.form.oninput = () => this.preview();
    this.form.onchange = () => this.showParameter();
    this.preview();
    this.showParameter();
  }

  // Beside a value for a parameter: its unit, limits and present value.
  async showParameter() {
    const [select, note] = ["[data-parameters]", "[data-note=value]"].map((selector) => this.form.querySelector(selector));
    if (!select || !note) return;
    const { values } = await this.link.request({ do: "parameters" });
    const { name, unit, min, max } = this.parameters.find((item) => String(item.id) === select.value);
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
    const initial = field.default ?? (field.kind === "bytes" ? "00".repeat(field.bytes) : field.kind === "text" ? "" : Math.max(0, field.min ?? 0));
    return make("input", { name, value: String(initial), autocomplete: "off", spellcheck: "false", inputmode: field.kind === "text" || field.kind === "bytes" ? "text" : "decimal" });
  }

  values() {
    return Object.fromEntries([...this.form.elements].filter((each) => each.name).map((each) => [each.name, each.value]));
  }

  async preview() {
    const name = this.chosen;
    const answer = await this.link.request({ do: "encode", row: name, values: this.values() });
    if (name !== this.chosen) return;
    if (!answer.ok) {
      setText(this.problem, answer.error);
      setText(this.bytes, "–");
      return;
    }
    setText(this.problem, answer.problem ? `violates the definition, but can be sent: ${answer.problem}` : "");
    const lines = [];
    if (answer.serial) lines.push(`serial   ${answer.serial}`);
    for (const frame of answer.cansend || []) lines.push(`cansend ${this.interface()} ${frame}`);
    setText(this.bytes, lines.join("\n"));
  }

  interface() {
    const can = this.store.hello.links.can || "";
    return can.startsWith("socketcan:") ? can.slice(10) : "vcan0";
  }

  async send(event) {
    event.preventDefault();
    const row = this.chosen;
    const values = this.values();
    const answer = await this.link.request({ do: "send", row, values });
    this.store.emit("sent", { row, values, kind: "command", ...answer });
    this.showParameter();
  }

  submit() {
    if (this.chosen) this.form.requestSubmit();
  }

  note(item) {
    const outcome = item.ok ? item.outcome : "not sent";
    const good = item.ok && item.outcome === "ok";
    const pairs = Object.entries(item.values && item.kind === "command" ? item.values : {}).map(([key, one]) => `${key}=${one}`).join(" ");
    const text = good ? `${item.kind === "command" ? "accepted" : "read"} in ${item.latency_ms.toFixed(1)} ms` : item.ok ? (item.refused ? `refused: ${outcome}` : item.detail) : item.error;
    const line = make("li", { class: good ? "good" : "bad" }, make("time", { class: "num dim", text: wall(Date.now() / 1000).slice(0, 8) }), make("b", { text: item.row }), make("span", { class: "num", text: pairs }), make("span", { class: "outcome", text }));
    this.log.prepend(line);
    while (this.log.children.length > KEPT_LINES) this.log.lastChild.remove();
  }

  count(steps) {
    if (this.steps) setText(this.steps, `${steps} sent`);
  }

  async clear() {
    await this.link.request({ do: "clear_session" });
    this.log.replaceChildren();
    this.count(0);
  }
}
