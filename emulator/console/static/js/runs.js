// Session and conformance runs: the list, the selected run, and its results as they arrive.

import { duration, make, setText, wall } from "./format.js";

const MARKS = { passed: "✓", failed: "✗", skipped: "–", "not run": "·" };
const $ = (id) => document.getElementById(id);

const runs = new Map();
let chosen = null;
let follow = true;

export class Runs {
  constructor(store) {
    store.on("hello", () => runs.clear());
    store.on("run", begin);
    store.on("result", add);
    $("only-failed").addEventListener("change", show);
  }

  // Title of a run that is in progress; empty if there is none.
  get running() {
    const [run] = [...runs.values()].filter((each) => each.end_s === null);
    return run ? run.title : "";
  }
}

function begin(message) {
  const known = runs.get(message.run);
  runs.set(message.run, { ...message, results: message.results || (known ? known.results : []) });
  if (!known && (follow || chosen === null)) chosen = message.run;
  list();
  if (chosen === message.run) show();
}

function add(message) {
  const run = runs.get(message.run);
  if (!run) return;
  run.counts = message.counts;
  run.results.push(message.result);
  list();
  if (chosen !== message.run) return;
  head(run);
  if (wanted(message.result)) {
    const row = line(message.result);
    $("results").append(row);
    row.scrollIntoView({ block: "nearest" });
  }
}

function done(run) {
  return Object.values(run.counts).reduce((sum, count) => sum + count, 0);
}

function state(run) {
  if (run.counts.failed) return "bad";
  return run.end_s === null ? "busy" : "good";
}

function list() {
  $("list").replaceChildren(...[...runs.values()].reverse().map((run) => make(
    "li", {}, make(
      "button", { type: "button", class: run.run === chosen ? "on" : "", "data-state": state(run), onclick: () => { chosen = run.run; follow = run === [...runs.values()].at(-1); list(); show(); } },
      make("b", { text: run.title }),
      make("span", { class: "dim", text: `${run.kind}, ${wall(run.begin_s).slice(0, 8)}` }),
      make("span", { class: "num", text: `${done(run)} of ${run.planned}, ${run.counts.failed ? `${run.counts.failed} failed` : run.end_s === null ? "running" : "passed"}` }),
    ),
  )));
}

function head(run) {
  setText($("title"), run.title);
  setText($("run-unit"), `${run.kind} · ${run.unit}${run.end_s === null ? "" : ` · ${duration(run.end_s - run.begin_s)}`}`);
  setText($("counts"), Object.entries(run.counts).filter(([, count]) => count).map(([name, count]) => `${count} ${name}`).join("  "));
  $("progress").dataset.state = state(run);
  $("progress").firstElementChild.style.width = `${run.planned ? Math.min(100, (100 * done(run)) / run.planned) : 0}%`;
}

function wanted(result) {
  return !$("only-failed").checked || result.status === "failed";
}

function line(result) {
  const row = make("tr", { class: result.status.replace(" ", "-") },
    make("td", { text: MARKS[result.status] }), make("td", { class: "num dim", text: String(result.id ?? "") }), make("td", { text: result.name }),
    make("td", { class: "num dim", text: result.link || "" }), make("td", { class: "num dim", text: `${Number(result.seconds || 0).toFixed(2)} s` }), make("td", { class: "detail", text: result.detail || "" }));
  if (result.log && result.log.length) row.lastChild.append(make("details", {}, make("summary", { text: "traffic" }), make("pre", { text: result.log.join("\n") })));
  return row;
}

function show() {
  const run = runs.get(chosen);
  if (!run) return;
  head(run);
  $("results").replaceChildren(...run.results.filter(wanted).map(line));
}
