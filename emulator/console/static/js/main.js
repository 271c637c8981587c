// The console: connects the parts of the page.

import { Charts } from "./charts.js";
import { Faults } from "./faults.js";
import { Features } from "./features.js";
import { age, degrees, duration, fixed, make, press, setText, signed, utc, wall } from "./format.js";
import { Link, address } from "./link.js";
import { SkyMap } from "./map.js";
import { Runs } from "./runs.js";
import { Sky } from "./sky.js";
import { Store } from "./store.js";
import { Telecommands } from "./telecommands.js";
import { Telemetry } from "./telemetry.js";
import { initTheme, toggleTheme } from "./theme.js";
import { Truth } from "./truth.js";
import { Wire } from "./wire.js";

const TABS = ["telemetry", "telecommands", "wire", "faults", "truth"];
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
  for (const each of document.querySelectorAll(".commands")) each.disabled = lost !== null || store.hello.view_only;
  showWhen();
}

const link = new Link({
  message: (message) => store.message(message),
  frame: (head, blob) => store.frame(head, blob),
  history: (numbers) => store.history(numbers),
  state: showLink,
});

const sky = new Sky(store);
new SkyMap(store);
new Features(store);
const charts = new Charts(store);
const panels = {
  telemetry: new Telemetry(store, link),
  telecommands: new Telecommands(store, link),
  wire: new Wire(store, link),
  faults: new Faults(store, link),
  truth: new Truth(store, link),
};
new Runs(store);
link.subscribe({ frames: true });
document.addEventListener("visibilitychange", () => link.send());

// --- console or runs, by the path ---

function openPage() {
  const runs = location.pathname === "/runs";
  $("console").hidden = runs;
  $("runs").hidden = !runs;
  setText($("other-page"), runs ? "console" : "runs");
  $("other-page").href = address(runs ? "/" : "/runs");
}

$("other-page").addEventListener("click", (event) => {
  event.preventDefault();
  history.pushState(null, "", $("other-page").href + location.hash);
  openPage();
});
window.addEventListener("popstate", openPage);
openPage();

// --- tabs ---

const tabs = Object.fromEntries(TABS.map((name, number) => {
  const button = make("button", { type: "button", role: "tab", "data-tab": name, "aria-controls": name, title: number < 4 ? `F${number + 1}` : "", text: name, onclick: () => openTab(name) });
  $("tabs").append(button);
  return [name, button];
}));

function openTab(name) {
  for (const each of TABS) {
    const on = each === name;
    tabs[each].classList.toggle("on", on);
    tabs[each].setAttribute("aria-selected", String(on));
    $(each).classList.toggle("open", on);
    if (panels[each].show) panels[each].show(on);
  }
  history.replaceState(null, "", `${location.pathname}${location.search}#tab=${name}`);
}

// not the ID of the tab itself, to which the browser would scroll
const named = location.hash.replace("#tab=", "");
openTab(TABS.includes(named) ? named : "telemetry");

// --- top line ---

$("head").addEventListener("change", () => location.assign(address(location.pathname, $("head").value) + location.hash));

store.on("hello", (hello) => {
  setText($("unit"), `${hello.profile} · seed ${hello.seed} · clock ${hello.clock}`);
  document.title = `starhil · ${hello.profile}`;
  $("head").replaceChildren(...hello.heads.map((name, number) => make("option", { value: String(number + 1), text: name, selected: number + 1 === hello.head })));
  $("head").hidden = hello.heads.length < 2;
  document.body.classList.toggle("view-only", hello.view_only);
  $("link").title = hello.view_only ? "the token of this page may look, but not command" : "connection to the emulator";
  showLink("connected");
  $("unit").title = [$("unit").textContent, `unit ${hello.unit.name} ${hello.unit.version}`, ...Object.entries(hello.links).map(([name, where]) => `${name} ${where}`)].join("\n");
});

store.on("faults", (names) => {
  const count = names.length;
  setText($("active"), count ? `${count} fault${count === 1 ? "" : "s"}` : "no fault");
  $("active").title = count ? `injected: ${names.join(", ")}` : "injected faults";
  $("active").dataset.state = count ? "bad" : "idle";
});

// Which link the OBC uses, how many requests per second since the last report, and when it sent the last one.
let asked = null;
let lastRequest = null; // time of the last request, ms since the page was opened

store.on("status", ({ heard, wall_s: now }) => {
  const spoken = heard.filter((each) => each.age_s !== null).sort((a, b) => a.age_s - b.age_s);
  const total = heard.reduce((sum, each) => sum + each.requests, 0);
  lastRequest = spoken.length ? performance.now() - 1000 * spoken[0].age_s : null;
  if (asked && now - asked.now < 2) return;
  const rate = asked && total >= asked.total ? (total - asked.total) / (now - asked.now) : 0;
  asked = { total, now };
  setText($("obc"), spoken.length ? `${spoken[0].link} ${fixed(rate, 1)}/s` : "silent");
  $("requests").title = heard.map((each) => `${each.link}: ${each.requests} requests${each.age_s === null ? "" : `, the last ${age(each.age_s)} ago`}`).join("\n");
});

setInterval(() => setText($("obc-last"), lastRequest === null ? "–" : `${age((performance.now() - lastRequest) / 1000)} ago`), 500);

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
  setText($("error-label"), last === null ? "cross / roll error ″" : "last valid");
  setText($("error"), last === null ? `${fixed(shown("error_cross"), 2, 6)} / ${fixed(shown("error_roll"), 1, 6)}` : `${age((store.cursor ?? store.time) - last)} ago`);
  document.body.classList.toggle("imageless", imageless);
  showWhen();
}

store.on("shown", () => {
  const mode = store.hello.modes[shown("mode")];
  if (mode) {
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

// The moment that is shown.
function showWhen() {
  if (store.cursor !== null) setText($("when"), `${duration(store.cursor)}  (−${fixed(store.now - store.cursor, 1)} s)`);
  else if (lost !== null) setText($("when"), "not live");
  else if (!store.imageless) setText($("when"), "live");
  else setText($("when"), store.image ? `image of ${age(store.time - store.image.time)} ago` : "");
}

function showImageInfo() {
  const image = store.image;
  if (!image) {
    setText($("frame-info"), "–");
    return;
  }
  const head = image.head;
  const apart = image.time - shown("run_s");
  const note = store.cursor !== null && Math.abs(apart) > 0.5 ? ` (image ${fixed(apart, 1)} s apart)` : "";
  const late = head.late ? " late" : "";
  setText($("frame-info"), `frame ${fixed(head.row[store.rows.index.frame], 0)}${late}  rejected ${head.rejected}${note}`);
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

// --- keys ---

const KEYS = [
  [" ", "space", "pause, or back to live", toggleLive],
  ["ArrowLeft", "←", "one frame back; with Shift ten", (event) => store.step(event.shiftKey ? -10 : -1)],
  ["ArrowRight", "→", "one frame on; with Shift ten", (event) => store.step(event.shiftKey ? 10 : 1)],
  ["1", "1 … 4", "layers over the sky", () => sky.toggle("matched")],
  ["2", "", "", () => sky.toggle("unmatched")],
  ["3", "", "", () => sky.toggle("missing")],
  ["4", "", "", () => sky.toggle("bodies")],
  ["+", "+ −", "zoom the sky", () => sky.zoomCentre(1.4)],
  ["=", "", "", () => sky.zoomCentre(1.4)],
  ["-", "", "", () => sky.zoomCentre(1 / 1.4)],
  ["0", "0", "whole image", () => sky.reset()],
  ["w", "w", "longer or shorter time", () => charts.setWindow({ 60: 300, 300: 900, 900: 3600, 3600: 60 }[charts.window])],
  ["c", "c", "cover or uncover the lens", () => panels.faults.toggleCover()],
  ["x", "x", "clear all faults", () => panels.faults.clear()],
  ["s", "s", "step the stepped clock", () => panels.truth.step()],
  ["r", "r", "run or pause the stepped clock", () => panels.truth.toggleClock()],
  ["t", "t", "dark or light", toggleTheme],
  ["?", "?", "these keys", () => $("keys").showModal()],
];
for (const [, label, what] of KEYS) if (label) $("keys").querySelector("dl").append(make("dt", { text: label }), make("dd", { text: what }));
$("keys").querySelector("dl").append(make("dt", { text: "F1 … F4" }), make("dd", { text: "telemetry, telecommands, wire, faults" }));
$("keys").querySelector("dl").append(make("dt", { text: "Ctrl+Enter" }), make("dd", { text: "send the telecommand" }));
$("help").addEventListener("click", (event) => {
  if (event.detail > 0) $("help").blur(); // otherwise the focus returns when the dialog is closed, and space opens it again
  $("keys").showModal();
});

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey && event.key === "Enter") {
    panels.telecommands.submit();
    return;
  }
  const function_ = /^F([1-4])$/.exec(event.key);
  if (function_) {
    event.preventDefault();
    openTab(TABS[Number(function_[1]) - 1]);
    return;
  }
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.target.closest("input, select, textarea, dialog, summary") || (event.key === " " && event.target.closest("button, a"))) return;
  const found = KEYS.find(([key]) => key === event.key);
  if (!found) return;
  event.preventDefault();
  found[3](event);
});

// Remove the focus after a click, so that space pauses instead of pressing the button again.
document.addEventListener("click", (event) => {
  if (event.detail > 0 && event.target.closest("button, a")) document.activeElement.blur();
});

window.starhil = { store, sky, charts, link };
