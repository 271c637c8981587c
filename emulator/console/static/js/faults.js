// Controls for all faults and scenarios, and the active faults. The form of a level shows what is active on it, and what is
// injected is added to it.

import { ask, make, number, say, setText, setValue, short } from "./format.js";

export class Faults {
  constructor(store, link, runs) {
    this.store = store;
    this.link = link;
    this.runs = runs;
    this.host = document.getElementById("faults");
    this.now = document.getElementById("active-faults");
    this.active = {};
    this.forms = {}; // by level: controls
    store.on("hello", (hello) => this.build(hello));
    store.on("status", (message) => this.update(message.status.faults || {}));
  }

  build(hello) {
    this.titles = Object.fromEntries(hello.faults.map((level) => [level.level, level.title]));
    this.cover = make("button", { type: "button", class: "primary large", id: "cover", onclick: () => this.toggleCover() });
    const clear = make("button", { type: "button", class: "large", id: "clear-faults", text: "Clear all faults", onclick: () => this.clear() });
    this.outcome = make("p", { class: "problem", id: "fault-outcome" });
    const scenario = make("select", { "aria-label": "scenario" }, ...hello.scenarios.map((name) => make("option", { value: name, text: name })));
    const run = make("button", { type: "button", text: "Run from now", onclick: () => this.request({ do: "scenario", name: scenario.value }, `scenario ${scenario.value} begun`) });
    this.forms = {};
    const levels = hello.faults.map((level) => this.level(level));
    this.host.replaceChildren(make(
      "fieldset", { class: "commands" },
      make("div", { class: "bar" }, this.cover, clear),
      this.outcome,
      make("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "faults by level" }, ...levels, make("fieldset", {}, make("legend", { text: "Scenario" }), make("div", { class: "bar" }, scenario, run))),
    ));
    this.update({}, true);
  }

  level(level) {
    const controls = level.controls.filter((control) => control.name !== "blank").map((control) => this.control(control));
    this.forms[level.level] = controls;
    const form = make("form", { onsubmit: (event) => { event.preventDefault(); this.inject(level.level); } });
    form.append(...controls.map((control) => control.element), make("button", { type: "submit", class: "primary", text: "Inject" }));
    form.addEventListener("input", (event) => event.target.closest(".field, .group").classList.add("edited"));
    return make("fieldset", { "data-level": level.level }, make("legend", { text: level.title }), form);
  }

  // A control for one value: `read` returns the value, or undefined if it is the default; `show` shows what is active, unless the
  // control was edited.
  control(control) {
    if (control.kind === "group") return this.group(control);
    const label = make("span", { text: control.name.replaceAll("_", " ") });
    const range = control.min !== undefined && control.min !== null ? `${short(control.min)} … ${short(control.max)}` : "";
    const initial = control.default === null || control.default === undefined ? "" : String(control.default);
    let input;
    let read;
    let write = (item) => setValue(input, item === undefined ? initial : typeof item === "object" ? JSON.stringify(item) : String(item));
    if (control.kind === "flag") {
      input = make("input", { type: "checkbox" });
      read = () => (input.checked ? true : undefined);
      write = (item) => (input.checked = item === true);
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
      input = make("input", { inputmode: "decimal", value: initial });
      read = () => {
        const text = input.value.trim();
        if (text === "" || Number(text) === control.default) return undefined;
        const { item, problem } = number(text, control.min, control.max);
        if (problem) throw new Error(`${control.name}: ${problem}`);
        return item;
      };
    }
    input.name = control.name;
    const element = make("label", { class: "field" }, label, input, make("span", { class: "dim num", text: range }));
    return { name: control.name, read, element, show: (item) => element.classList.contains("edited") || write(item) };
  }

  group(control) {
    const inner = control.controls.map((each) => this.control(each));
    const on = make("input", { type: "checkbox", name: control.name });
    const fields = make("div", { class: "inner" }, ...inner.map((each) => each.element));
    const element = make("div", { class: "group" }, make("label", { class: "check" }, on, control.name.replaceAll("_", " ")), fields);
    const open = () => (fields.hidden = !on.checked);
    on.addEventListener("change", open);
    open();
    const show = (item) => {
      if (!element.classList.contains("edited")) {
        on.checked = item !== undefined && item !== null;
        open();
      }
      for (const each of inner) each.show(item ? item[each.name] : undefined);
    };
    return { name: control.name, read: () => (on.checked ? values(inner) : undefined), element, show };
  }

  // Inject what the form of a level shows: the active faults of the level, and what was edited.
  async inject(level) {
    let content;
    try {
      content = values(this.forms[level]);
    } catch (error) {
      const reason = error instanceof SyntaxError ? `not JSON: ${error.message}` : error.message;
      setText(this.outcome, reason);
      say(reason);
      return;
    }
    if (level === "optical" && this.active.optical && this.active.optical.blank) content.blank = true;
    if (Array.isArray(this.active[level])) content = [...this.active[level], content];
    if (await this.request({ do: "fault", [level]: content }, `injected: ${this.titles[level]}`)) this.forget(level);
  }

  // Let the form of a level, or all forms, show what is active.
  forget(level) {
    for (const each of this.host.querySelectorAll(`[data-level${level ? `=${level}` : ""}] .edited`)) each.classList.remove("edited");
    this.update(this.active, true);
  }

  // End one fault and leave the others of its level.
  end(level, name) {
    const active = this.active[level];
    if (Array.isArray(active)) return this.request({ do: "fault", [level]: active.filter((_, number_) => String(number_) !== name) }, `ended: ${level}`);
    const content = { ...active };
    delete content[name];
    if (level === "device") content[name] = false;
    return this.request({ do: "fault", [level]: content }, `ended: ${name}`);
  }

  toggleCover() {
    const optical = { ...(this.active.optical || {}) };
    if (optical.blank) delete optical.blank;
    else optical.blank = true;
    return this.request({ do: "fault", optical }, optical.blank ? "the lens is covered" : "the lens is uncovered");
  }

  async clear() {
    if (this.runs.running && await ask(`The run “${this.runs.running}” is in progress. End all its faults?`, "Clear all faults") === "") return;
    if (await this.request({ do: "clear_faults" }, "all faults have ended")) this.forget();
  }

  async request(request, done) {
    const answer = await this.link.control(request);
    setText(this.outcome, answer.ok ? "" : answer.error);
    say(answer.ok ? done : answer.error);
    if (answer.ok && answer.faults) this.update(answer.faults);
    return answer.ok;
  }

  update(active, force = false) {
    const text = JSON.stringify(active);
    if (!force && text === this.text) return;
    this.text = text;
    this.active = active;
    const covered = Boolean(active.optical && active.optical.blank);
    if (!this.cover) return;
    setText(this.cover, covered ? "Uncover the lens" : "Cover the lens");
    this.cover.classList.toggle("on", covered);
    for (const [level, controls] of Object.entries(this.forms)) for (const each of controls) each.show((active[level] || {})[each.name]);
    const chips = [];
    for (const [level, content] of Object.entries(active)) {
      const idle = Object.fromEntries((this.store.hello.faults.find((each) => each.level === level)?.controls || []).map((each) => [each.name, each.default]));
      for (const [name, item] of Object.entries(content)) {
        if (level !== "optical" && (item === idle[name] || item === false)) continue;
        const listed = Array.isArray(content);
        const label = `${this.titles[level] || level}: ${listed ? "" : name} ${shown(item)}`.trim();
        const end = make("button", { type: "button", class: "small", text: "×", "aria-label": `end ${label}`, onclick: () => this.end(level, name) });
        const known = (this.forms[level] || []).some((each) => each.name === name) || name === "blank" || listed;
        chips.push(make("li", {}, make("span", { text: label }), make("fieldset", { class: "commands" }, ...(known ? [end] : []))));
      }
    }
    this.now.replaceChildren(...chips);
    this.store.emit("faults", chips.map((chip) => chip.firstChild.textContent));
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
