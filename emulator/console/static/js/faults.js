// Controls for all faults and scenarios, and the active faults.

import { make, setText, short } from "./format.js";

export class Faults {
  constructor(store, link) {
    this.store = store;
    this.link = link;
    this.host = document.getElementById("faults");
    this.active = {};
    store.on("hello", (hello) => this.build(hello));
    store.on("status", (message) => this.update(message.status.faults || {}));
  }

  build(hello) {
    this.titles = Object.fromEntries(hello.faults.map((level) => [level.level, level.title]));
    this.cover = make("button", { type: "button", class: "primary large", id: "cover", title: "c", onclick: () => this.toggleCover() });
    const clear = make("button", { type: "button", class: "large", id: "clear-faults", title: "x", text: "clear all faults", onclick: () => this.clear() });
    this.now = document.getElementById("active-faults");
    this.outcome = make("p", { class: "problem", id: "fault-outcome" });
    const scenario = make("select", { "aria-label": "scenario" }, ...hello.scenarios.map((name) => make("option", { value: name, text: name })));
    const run = make("button", { type: "button", text: "run from now", onclick: () => this.request({ do: "scenario", name: scenario.value }) });
    const levels = hello.faults.map((level) => this.level(level));
    this.host.replaceChildren(make(
      "fieldset", { class: "commands" },
      make("div", { class: "bar" }, this.cover, clear),
      this.outcome,
      make("div", { class: "scroll" }, ...levels, make("fieldset", {}, make("legend", { text: "scenario" }), make("div", { class: "bar" }, scenario, run))),
    ));
    this.update(this.active, true);
  }

  level(level) {
    const controls = level.controls.filter((control) => control.name !== "blank").map((control) => this.control(control));
    const form = make("form", { onsubmit: (event) => { event.preventDefault(); this.inject(level.level, controls); } });
    form.append(...controls.map((control) => control.element), make("button", { type: "submit", class: "primary", text: `inject on ${level.title}` }));
    return make("fieldset", { "data-level": level.level }, make("legend", { text: level.title }), form);
  }

  // A control for one value: `read` returns the value, or undefined if it is the default.
  control(control) {
    if (control.kind === "group") return this.group(control);
    const label = make("span", { text: control.name, title: control.name });
    const range = control.min !== undefined && control.min !== null ? `${short(control.min)} … ${short(control.max)}` : "";
    let input;
    let read;
    if (control.kind === "flag") {
      input = make("input", { type: "checkbox" });
      read = () => (input.checked ? true : undefined);
    } else if (control.kind === "choice") {
      input = make("select", {}, make("option", { value: "", text: "–" }), ...(control.values || []).map((item) => make("option", { value: item, text: item })));
      read = () => input.value || undefined;
    } else if (control.kind === "list" || control.kind === "table") {
      input = make("input", { placeholder: EXAMPLES[control.name] || "[{…}], JSON", spellcheck: "false" });
      read = () => (input.value.trim() ? JSON.parse(input.value) : undefined);
    } else if (control.kind === "text") {
      input = make("input", { spellcheck: "false" });
      read = () => input.value || undefined;
    } else {
      input = make("input", { inputmode: "decimal", value: control.default === null || control.default === undefined ? "" : String(control.default) });
      read = () => {
        const text = input.value.trim();
        return text === "" || Number(text) === control.default ? undefined : Number(text);
      };
    }
    input.name = control.name;
    return { name: control.name, read, element: make("label", { class: "field" }, label, input, make("span", { class: "dim num", text: range })) };
  }

  group(control) {
    const inner = control.controls.map((each) => this.control(each));
    const on = make("input", { type: "checkbox", name: control.name });
    const element = make("details", { class: "group" }, make("summary", {}, on, ` ${control.name}`), ...inner.map((each) => each.element));
    on.addEventListener("click", (event) => event.stopPropagation());
    on.addEventListener("change", () => (element.open = on.checked));
    return { name: control.name, read: () => (on.checked ? values(inner) : undefined), element };
  }

  async inject(level, controls) {
    let content;
    try {
      content = values(controls);
    } catch (error) {
      setText(this.outcome, `not JSON: ${error.message}`);
      return;
    }
    if (level === "optical" && this.active.optical && this.active.optical.blank) content.blank = true;
    await this.request({ do: "fault", [level]: content });
  }

  toggleCover() {
    const optical = { ...(this.active.optical || {}) };
    if (optical.blank) delete optical.blank;
    else optical.blank = true;
    return this.request({ do: "fault", optical });
  }

  clear() {
    return this.request({ do: "clear_faults" });
  }

  async request(request) {
    const answer = await this.link.control(request);
    setText(this.outcome, answer.ok ? "" : answer.error);
    if (answer.ok && answer.faults) this.update(answer.faults);
  }

  update(active, force = false) {
    const text = JSON.stringify(active);
    if (!force && text === this.text) return;
    this.text = text;
    this.active = active;
    const covered = Boolean(active.optical && active.optical.blank);
    if (!this.cover) return;
    setText(this.cover, covered ? "uncover the lens" : "cover the lens");
    this.cover.classList.toggle("on", covered);
    const chips = [];
    for (const [level, content] of Object.entries(active)) {
      for (const [name, item] of Object.entries(content)) {
        const idle = level !== "optical" && (item === 0 || item === false || name === "gap_s");
        if (!idle) chips.push(make("li", { text: `${this.titles[level] || level}: ${name} ${shown(item)}` }));
      }
    }
    this.now.replaceChildren(...chips);
    this.store.emit("faults", chips.map((chip) => chip.textContent));
  }
}

// How a list or table is written, by the name of its control.
const EXAMPLES = { false_star_magnitudes: "[1.0, 5.5]", set: '{"q_x": 0.5}', offset: '{"q_x": 0.1}', nan: '["q_x"]', negate: '["q_x"]', turn_deg: "[0, 0.5, 0]" };

// The value of a fault in one line.
function shown(item) {
  if (item === true) return "";
  if (typeof item !== "object" || item === null) return String(item);
  if (Array.isArray(item)) return item.map(shown).join("; ");
  return Object.entries(item).map(([name, each]) => `${name} ${shown(each)}`).join(", ");
}

function values(controls) {
  const content = {};
  for (const control of controls) {
    const item = control.read();
    if (item !== undefined) content[control.name] = item;
  }
  return content;
}
