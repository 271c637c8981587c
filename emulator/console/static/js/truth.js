// The true attitude: held, a rate, a slew to a direction or a star, a file or a feed; and the stepped clock.

import { degrees, duration, fixed, make, number, say, setText, signed } from "./format.js";

export class Truth {
  constructor(store, link) {
    this.store = store;
    this.link = link;
    this.host = document.getElementById("truth");
    store.on("hello", (hello) => this.build(hello));
    store.on("status", (message) => this.update(message));
  }

  build(hello) {
    this.now = make("table", { class: "facts" });
    this.outcome = make("p", { class: "problem" });
    const stars = make("datalist", { id: "star-names" }, ...Object.values(hello.star_names).sort().map((name) => make("option", { value: name })));
    const directions = [["ra_deg", "", "°"], ["dec_deg", "", "°"], ["roll_deg", "", "° (as now if empty)"]];
    const slew = this.form("slew", "Slew to", "Slew", [["star", "", "or a direction:", "star-names"], ...directions, ["max_rate_deg_s", String(hello.slew_rate_deg_s), "°/s"]], (values) => {
      const { max_rate_deg_s: rate, ...to } = values;
      return this.link.request({ do: "point", kind: "slew", to, max_rate_deg_s: rate });
    });
    const rate = this.form("rate", "Turn at a rate", "Turn", [["x", "0", "°/s"], ["y", "0", "°/s"], ["z", "0", "°/s"]], (values) => (
      this.link.request({ do: "point", kind: "rate", rate_deg_s: ["x", "y", "z"].map((axis) => values[axis] || 0) })));
    const still = this.form("fixed", "Hold attitude (the present one if empty)", "Hold", directions, (to) => this.link.request({ do: "point", kind: "fixed", to }));
    const json = make("textarea", { rows: "3", spellcheck: "false", "aria-label": "truth as JSON" });
    json.value = '{"kind": "live", "protocol": "udp", "port": 0}';
    const other = make("fieldset", {}, make("legend", { text: "File, feed or sequence: the keys of [truth], as JSON" }), json, make("button", {
      type: "button", text: "Use", onclick: () => {
        try {
          this.answer(this.set(JSON.parse(json.value)));
        } catch (error) {
          this.tell(`not JSON: ${error.message}`);
        }
      },
    }));
    this.host.replaceChildren(stars, this.now, this.outcome, make("fieldset", { class: "commands" }, make("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "attitude and clock" }, ...this.clock(hello), slew, rate, still, other)));
  }

  // Controls for the stepped clock.
  clock(hello) {
    this.seconds = this.speed = null;
    if (hello.clock !== "stepped") return [];
    this.seconds = make("input", { value: "0.2", inputmode: "decimal", name: "step", "aria-label": "seconds of a step" });
    this.speed = make("input", { value: "1", inputmode: "decimal", name: "speed", "aria-label": "speed, times real time" });
    this.running = make("button", { type: "button", id: "run-clock", text: "Run", title: "r", onclick: () => this.toggleClock() });
    return [
      make("fieldset", {}, make("legend", { text: "Stepped clock" }), make("div", { class: "bar wrap" },
        make("button", { type: "button", id: "step", text: "Step", title: "s", onclick: () => this.step() }), this.seconds, make("span", { class: "dim", text: "s" }),
        make("span", { class: "spacer" }), this.running, this.speed, make("span", { class: "dim", text: "× real time" }))),
    ];
  }

  step() {
    const { item, problem } = number(this.seconds ? this.seconds.value : "", 0);
    if (this.seconds) return problem ? this.tell(problem) : this.answer(this.link.control({ do: "step", seconds: item }));
    return null;
  }

  toggleClock() {
    if (!this.speed) return null;
    const { item, problem } = number(this.speed.value, 0);
    if (problem && !this.stepping) return this.tell(problem);
    return this.answer(this.link.request({ do: "clock", speed: this.stepping ? 0 : item }));
  }

  set(truth) {
    return this.link.control({ do: "set_truth", truth });
  }

  tell(problem) {
    setText(this.outcome, problem);
    say(problem);
  }

  async answer(answer) {
    const outcome = await answer;
    setText(this.outcome, outcome.ok ? "" : outcome.error);
    say(outcome.ok ? "done" : outcome.error);
  }

  form(kind, title, verb, fields, send) {
    const form = make("form", {
      "data-truth": kind,
      onsubmit: (event) => {
        event.preventDefault();
        const values = {};
        for (const [name, text] of new FormData(form)) {
          if (text.trim() === "") continue;
          const { item, problem } = name === "star" ? { item: text.trim() } : number(text);
          if (problem) {
            this.tell(`${label(name)}: ${problem}`);
            form.elements[name].focus();
            return;
          }
          values[name] = item;
        }
        this.answer(send(values));
      },
    });
    for (const [name, initial, unit, list] of fields) {
      form.append(make("label", { class: "field" }, make("span", { text: label(name) }), make("input", { name, value: initial, list, autocomplete: "off", inputmode: list ? "text" : "decimal" }), make("span", { class: "dim", text: unit })));
    }
    form.append(make("button", { type: "submit", class: "primary", text: verb }));
    return make("fieldset", {}, make("legend", { text: title }), form);
  }

  // The truth now, also while the page is paused: it is what the forms change.
  update({ status, truth, stepping }) {
    if (!this.now || !truth.ok) return;
    this.stepping = stepping > 0;
    if (this.speed) setText(this.running, this.stepping ? "Pause" : "Run");
    if (this.store.cursor !== null) return;
    const feed = status.feed;
    const facts = [
      ["source", `${status.truth_kind}, ${truth.status}`],
      ["true right ascension", degrees(truth.ra_deg, 5)],
      ["true declination", degrees(truth.dec_deg, 5)],
      ["true roll", degrees(signed(truth.roll_deg), 5)],
      ["true rate x, y, z", truth.rate_deg_s.map((item) => fixed(item, 4, 8)).join(" ") + " °/s"],
      ["simulation time", duration(truth.run_time_s)],
      ["feed", feed ? `${feed.address}: ${feed.accepted} accepted, ${feed.refused} refused ${feed.last_fault || ""}` : "none"],
    ];
    if (this.now.rows.length !== facts.length) this.now.replaceChildren(...facts.map(([name]) => make("tr", {}, make("th", { scope: "row", text: name }), make("td", { class: "num" }))));
    facts.forEach(([, text], number_) => setText(this.now.rows[number_].cells[1], text));
  }
}

function label(name) {
  return name.replace("_deg_s", "").replace("_deg", "").replaceAll("_", " ");
}
