// The console: connects the parts of the page.

import { Charts } from "./charts.js";
import { Events } from "./events.js";
import { Faults } from "./faults.js";
import { Features } from "./features.js";
import { age, ask, degrees, duration, fixed, make, press, setText, signed, utc, wall } from "./format.js";
import { Link, address } from "./link.js";
import { SkyMap } from "./map.js";
import { Runs } from "./runs.js";
import { Sky } from "./sky.js";
import { Store } from "./store.js";
import { Telecommands } from "./telecommands.js";
import { Telemetry } from "./telemetry.js";
import { initTheme } from "./theme.js";
import { Truth } from "./truth.js";
import { Wire } from "./wire.js";

// The panels, and the page of the documentation about each.
const TABS = {
  telemetry: ["Telemetry", "icd"], telecommands: ["Telecommands", "icd"], wire: ["Bus", "bus"], events: ["Events", "console"], faults: ["Faults", "control"], truth: ["Attitude", "profile"],
};
const LIVE_S = 1; // what is older is not live
const $ = (id) => document.getElementById(id);

initTheme($("theme"));

const store = new Store();

// --- what is shown is of the past while the emulator is not connected, or the device is unresponsive ---

let lost = null; // time at which the connection was lost, ms
let unresponsiveSince = null; // simulation time, s

function showLink(state) {
  if (state === "connected") lost = null;
  else if (lost === null && state === "disconnected") lost = Date.now();
  if (state === "connecting" && lost !== null) return;
  setText($("link"), state === "connected" && store.hello && store.hello.view_only ? "view only" : state);
  $("link").dataset.state = state;
  showPast();
}

function showPast() {
  let text = "";
  if (lost !== null) {
    const since = wall(lost / 1000).slice(0, 8);
    text = $("link").dataset.state === "restarted"
      ? `The emulator was restarted: open its new address, on its ready line. Everything shown is from before ${since}.`
      : `No connection to the emulator since ${since}; everything shown is from before.`;
  } else if (unresponsiveSince !== null) {
    text = `The device has been unresponsive since ${duration(unresponsiveSince)} of simulation time (fault: device stuck); it answers no request.`;
  }
  setText($("past"), text);
  $("past").hidden = !text;
  document.body.classList.toggle("past", Boolean(text));
  document.body.classList.toggle("disconnected", lost !== null);
  for (const each of document.querySelectorAll(".commands")) each.disabled = lost !== null || !store.hello || store.hello.view_only;
  showWhen();
}

const link = new Link({
  message: (message) => store.message(message),
  image: (head, blob) => store.addImage(head, blob),
  rows: (buffer, offset, first, count) => store.read(buffer, offset, first, count),
  known: () => store.known(),
  state: showLink,
});

const sky = new Sky(store);
new SkyMap(store);
new Features(store);
const charts = new Charts(store, link);
const runs = new Runs(store);
const panels = {
  telemetry: new Telemetry(store, link, charts),
  telecommands: new Telecommands(store, link),
  wire: new Wire(store, link),
  events: new Events(store, link, charts),
  faults: new Faults(store, link, runs),
  truth: new Truth(store, link),
};
link.subscribe({ frames: true });
document.addEventListener("visibilitychange", () => link.send());

// --- console or runs, by the path ---

function openPage() {
  const shown = location.pathname === "/runs";
  $("console").hidden = shown;
  $("runs").hidden = !shown;
  setText($("other-page"), shown ? "console" : "runs");
  $("other-page").href = address(shown ? "/" : "/runs");
}

$("other-page").addEventListener("click", (event) => {
  event.preventDefault();
  history.pushState(null, "", $("other-page").href + location.hash);
  openPage();
});
window.addEventListener("popstate", openPage);
openPage();

// --- panels ---

const names = Object.keys(TABS);
const tabs = Object.fromEntries(names.map((name, number) => {
  const button = make("button", { type: "button", role: "tab", id: `tab-${name}`, "data-tab": name, "aria-controls": name, title: `F${number + 1}`, text: TABS[name][0], onclick: () => { openTab(name); if (matchMedia("(max-width: 47.99em)").matches) $("side").scrollIntoView(); } });
  $("tabs").append(button);
  return [name, button];
}));
const docs = (page) => make("a", { class: "doc", target: "_blank", rel: "noopener", href: address(`/docs/${page}`), text: "docs" });
const panelDocs = docs("console");
$("active-faults").before(make("div", { class: "bar doc-bar" }, panelDocs));
for (const id of ["sky", "charts"]) $(id).querySelector("h2").after(docs("console"));

function openTab(name) {
  for (const each of names) {
    const on = each === name;
    tabs[each].classList.toggle("on", on);
    tabs[each].setAttribute("aria-selected", String(on));
    tabs[each].tabIndex = on ? 0 : -1;
    $(each).classList.toggle("open", on);
    if (panels[each].show) panels[each].show(on);
  }
  panelDocs.href = address(`/docs/${TABS[name][1]}`);
  panelDocs.textContent = `docs: ${TABS[name][1]}`;
  history.replaceState(null, "", `${location.pathname}${location.search}#tab=${name}`);
}

$("tabs").addEventListener("keydown", (event) => {
  const at = names.indexOf(document.activeElement.dataset.tab);
  const to = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: names.length - 1 }[event.key];
  if (to === undefined || at < 0) return;
  const name = names[(to + names.length) % names.length];
  openTab(name);
  tabs[name].focus();
  event.preventDefault();
  event.stopPropagation();
});

// not the ID of the tab itself, to which the browser would scroll
const named = location.hash.replace("#tab=", "");
openTab(named in TABS ? named : "telemetry");

// --- top line ---

$("head").addEventListener("change", () => location.assign(address(location.pathname, $("head").value) + location.hash));

store.on("connected", (hello) => {
  const own = hello.heads[hello.head - 1];
  setText($("unit"), [own.unit, own.profile, `seed ${hello.seed}`, `${hello.clock} clock`].join(" · "));
  document.title = `${own.unit} ${own.profile} · starhil`;
  $("head").replaceChildren(...hello.heads.map(({ head, unit, profile }) => make("option", { value: String(head), text: `${head}: ${unit} ${profile}`, selected: head === hello.head })));
  $("head").hidden = hello.heads.length < 2;
  document.body.classList.toggle("view-only", hello.view_only);
  $("link").title = hello.view_only ? "the token of this page may look, but not command" : "connection to the emulator";
  showLink("connected");
  $("unit").title = [$("unit").textContent, `unit ${hello.unit.name} ${hello.unit.version}`, ...Object.entries(hello.links).map(([name, where]) => `${name} ${where}`)].join("\n");
});

store.on("faults", (active) => {
  const count = active.length;
  setText($("active"), count ? `${count} fault${count === 1 ? "" : "s"}` : "no fault");
  $("active").title = count ? `injected: ${active.join(", ")}` : "injected faults";
  $("active").dataset.state = count ? "bad" : "idle";
});

// All heads at one glance, with the faults of the others.
store.on("status", ({ heads }) => {
  $("heads").hidden = heads.length < 2;
  if (heads.length < 2) return;
  const texts = heads.map(({ head, mode, valid, faults }) => [`head ${head}: ${mode.replaceAll("_", " ")}`, valid === null ? "" : valid ? "valid" : "not valid", ...faults].filter(Boolean).join(" · "));
  if ($("heads").dataset.texts === texts.join("\n")) return;
  $("heads").dataset.texts = texts.join("\n");
  $("heads").replaceChildren(...heads.map((each, number) => make("li", { class: each.faults.length || each.valid === false ? "bad" : "idle" }, make("a", { href: address(location.pathname, String(each.head)), text: texts[number] }))));
});

$("reset").addEventListener("click", async () => {
  const causes = store.hello.faults.find((level) => level.level === "device").controls.find((control) => control.name === "reset").values;
  const labels = Object.fromEntries(causes.map((cause) => [cause === "power_on" ? "Power cycle" : `Reset: ${cause.replaceAll("_", " ")}`, cause]));
  const answer = await ask("Restart the device now?", ...Object.keys(labels).sort());
  if (answer in labels) panels.faults.request({ do: "fault", device: { reset: labels[answer] } }, `restarted: ${answer}`);
});

// Which link the OBC uses, how many requests per second since the last report, and when it sent the last one.
let asked = null;

store.on("status", ({ heard, wall_s: now }) => {
  const spoken = heard.filter((each) => each.age_s !== null).sort((a, b) => a.age_s - b.age_s);
  const total = heard.reduce((sum, each) => sum + each.requests, 0);
  setText($("obc-last"), spoken.length ? `${age(spoken[0].age_s)} ago` : "–");
  if (asked && now - asked.now < 2) return;
  const rate = asked && total >= asked.total ? (total - asked.total) / (now - asked.now) : 0;
  asked = { total, now };
  setText($("obc"), spoken.length ? `${spoken[0].link} ${fixed(rate, 1)}/s` : "silent");
  $("requests").title = heard.map((each) => `${each.link}: ${each.requests} requests${each.age_s === null ? "" : `, the last ${age(each.age_s)} ago`}`).join("\n");
});

store.on("status", ({ status, unresponsive_since_s: since }) => {
  unresponsiveSince = since;
  showPast();
  showValidity();
  if (store.cursor !== null) return;
  setText($("mode"), status.mode.replaceAll("_", " ") + (status.error_cause ? `: ${status.error_cause}` : ""));
  $("mode").dataset.mode = status.mode;
  setText($("utc"), utc(status.unix_s));
  setText($("run"), duration(status.run_time_s));
});

// A number of the row that is shown; NaN if there is none.
function shown(name) {
  return store.position < 0 ? NaN : store.rows.at(store.position, name);
}

// The validity of the attitude, and its error or the age of the last valid one.
function showValidity() {
  const imageless = store.cursor === null && store.imageless;
  const overdue = imageless && !Number.isNaN(shown("frame"));
  const valid = !overdue && shown("valid") === 1;
  const reason = overdue ? "no new image" : store.reasons[shown("reason")] || "–";
  setText($("validity"), valid ? "valid" : reason.replaceAll("_", " "));
  $("validity").dataset.state = valid ? "good" : "bad";
  const last = valid ? null : store.lastValid;
  setText($("error-label"), last === null ? "Error across / about ″" : "Last valid");
  setText($("error"), last === null ? `${fixed(shown("error_cross"), 2, 6)} / ${fixed(shown("error_roll"), 1, 6)}` : `${age((store.cursor ?? store.time) - last)} ago`);
  document.body.classList.toggle("imageless", imageless);
  showWhen();
}

store.on("shown", () => {
  const mode = store.hello.modes[shown("mode")];
  if (mode && !(store.cursor === null && store.status && store.status.error_cause && mode === "error")) {
    setText($("mode"), mode.replaceAll("_", " "));
    $("mode").dataset.mode = mode;
  }
  showValidity();
  setText($("ra"), degrees(shown("ra"), 4));
  setText($("dec"), degrees(shown("dec"), 4));
  setText($("roll"), degrees(signed(shown("roll")), 4));
  for (const name of ["qx", "qy", "qz", "qw"]) $("ra").dataset[name] = String(shown(name));
  setText($("stars"), `${fixed(shown("matched"), 0, 3)} of ${fixed(shown("detected"), 0, 3)}`);
  if (store.cursor !== null) {
    setText($("utc"), utc(shown("unix_s")));
    setText($("run"), duration(shown("run_s")));
  }
  showImageInfo();
});

// The moment that is shown; `live` is what is younger than a second.
function showWhen() {
  const behind = lost === null ? link.age : 0;
  const imageAge = store.image && store.cursor === null ? store.now - store.image.time + behind : 0;
  let text = "live";
  if (store.cursor !== null) text = `${duration(store.cursor)}  (−${fixed(store.now - store.cursor, 1)} s)`;
  else if (lost !== null) text = "not live";
  else if (store.imageless) text = store.image ? `image of ${age(store.time - store.image.time + behind)} ago` : "";
  else if (behind >= LIVE_S) text = `${fixed(behind, 1)} s behind`;
  else if (imageAge >= LIVE_S) text = `image of ${fixed(imageAge, 1)} s ago`;
  setText($("when"), text);
  if (lost === null && store.hello) {
    const state = behind >= LIVE_S ? "slow" : "connected";
    if ($("link").dataset.state !== state) {
      $("link").dataset.state = state;
      setText($("link"), state === "slow" ? "slow link" : store.hello.view_only ? "view only" : "connected");
    }
  }
}

setInterval(showWhen, 250);

function showImageInfo() {
  const image = store.image;
  if (!image) {
    setText($("frame-info"), "–");
    return;
  }
  const head = image.head;
  const apart = image.time - shown("run_s");
  const note = store.cursor !== null && Math.abs(apart) > 0.5 ? ` (image ${fixed(apart, 1)} s apart)` : "";
  setText($("frame-info"), `frame ${fixed(head.row[store.rows.index.frame], 0)}${head.late ? " late" : ""}  rejected ${head.rejected}${note}`);
  $("frame-info").title = head.late
    ? "late: the machine took longer for this image than the device would have"
    : "number of the image; detections that were rejected as no stars";
}

store.on("cursor", () => {
  const live = store.cursor === null;
  setText($("live"), live ? "❚❚ pause" : "▶ live");
  press($("live"), !live);
  document.body.classList.toggle("paused", !live);
});

function toggleLive() {
  store.scrub(store.cursor === null ? store.now : null);
}

$("live").addEventListener("click", toggleLive);

// --- keys: letters, digits and signs act in the part that has the focus; space and arrows everywhere but in controls ---

const KEYS = [
  ["", " ", "space", "pause, or back to live", toggleLive],
  ["", "ArrowLeft", "←", "one frame back; with Shift ten", () => store.step(-1)],
  ["", "ArrowRight", "→", "one frame on; with Shift ten", () => store.step(1)],
  ["sky", "1", "1 … 4", "layers over the sky", () => sky.toggle("matched")],
  ["sky", "2", "", "", () => sky.toggle("unmatched")],
  ["sky", "3", "", "", () => sky.toggle("missing")],
  ["sky", "4", "", "", () => sky.toggle("bodies")],
  ["sky", "+", "+ − 0", "enlarge, whole image", () => sky.zoomCentre(1.4)],
  ["sky", "=", "", "", () => sky.zoomCentre(1.4)],
  ["sky", "-", "", "", () => sky.zoomCentre(1 / 1.4)],
  ["sky", "0", "", "", () => sky.reset()],
  ["sky", "n", "n p", "next star to the right, to the left", () => sky.go(1)],
  ["sky", "p", "", "", () => sky.go(-1)],
  ["sky", "Shift+ArrowLeft", "Shift with arrows", "move the enlarged image", () => sky.pan(-1, 0)],
  ["sky", "Shift+ArrowRight", "", "", () => sky.pan(1, 0)],
  ["sky", "Shift+ArrowUp", "", "", () => sky.pan(0, -1)],
  ["sky", "Shift+ArrowDown", "", "", () => sky.pan(0, 1)],
  ["charts", "w", "w", "another time span", () => charts.nextWindow()],
  ["charts", "PageUp", "Page Up, Page Down, Home, End", "move in time", () => charts.move(-0.5)],
  ["charts", "PageDown", "", "", () => charts.move(0.5)],
  ["charts", "Home", "", "", () => store.scrub(-Infinity)],
  ["charts", "End", "", "", () => store.scrub(null)],
  ["charts", "m", "m", "a note at this moment; also in Sky", () => note()],
  ["sky", "m", "", "", () => note()],
  ["faults", "c", "c", "cover or uncover the lens", () => panels.faults.toggleCover()],
  ["truth", "s", "s", "step the stepped clock", () => panels.truth.step()],
  ["truth", "r", "r", "run or pause the stepped clock", () => panels.truth.toggleClock()],
  ["", "Shift+ArrowLeft", "", "", () => store.step(-10)], // elsewhere than in Sky, which comes first
  ["", "Shift+ArrowRight", "", "", () => store.step(10)],
];
function note() {
  openTab("events");
  panels.events.note.focus();
}

const PARTS = { sky: "Sky", charts: "Error and health", faults: "Faults", truth: "Attitude" };
const list = $("keys").querySelector("dl");
for (const [part, , label, what] of KEYS) if (label) list.append(make("dt", { text: label }), make("dd", { text: part ? `${PARTS[part]}: ${what}` : what }));
list.append(make("dt", { text: "F1 … F6" }), make("dd", { text: "panels" }));
list.append(make("dt", { text: "Ctrl+Enter" }), make("dd", { text: "in the form of a telecommand: send it" }));
list.append(make("dt", { text: "plots" }), make("dd", { text: "click: that moment; drag: enlarge; double click: back to live" }));
$("help").addEventListener("click", () => $("keys").showModal());

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented) return;
  const tab = /^F([1-6])$/.exec(event.key);
  if (tab) {
    event.preventDefault();
    openTab(names[Number(tab[1]) - 1]);
    return;
  }
  const { target } = event;
  if (target.closest("input, select, textarea, dialog, [role=tab]") || (event.key === " " && target.closest("button, a, summary"))) return;
  if (event.key.startsWith("Arrow") && target.closest(".scroll")) return;
  const pressed = event.shiftKey && event.key.startsWith("Arrow") ? `Shift+${event.key}` : event.key;
  const found = KEYS.find(([part, key]) => key === pressed && (!part || target.closest(`#${part}`)));
  if (!found) return;
  event.preventDefault();
  found[4]();
});

// The part that is clicked has the keys.
for (const part of ["sky", "charts", "faults", "truth"]) {
  $(part).tabIndex = -1;
  $(part).addEventListener("click", (event) => {
    if (!event.target.closest("button, a, input, select, textarea, label, summary, [tabindex='0']")) $(part).focus();
  });
}

// After a click with the pointer, space pauses instead of pressing the button again.
document.addEventListener("click", (event) => {
  const button = event.detail > 0 && event.target.closest("button, a");
  if (!button || button.closest("dialog")) return;
  const part = button.closest("#sky, #charts, #faults, #truth");
  if (part) part.focus({ preventScroll: true });
  else button.blur();
});

link.connect();

window.starhil = { store, sky, charts, link };
