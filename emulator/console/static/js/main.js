// The console: connects the parts of the page.

import { Charts } from "./charts.js";
import { Faults } from "./faults.js";
import { ago, duration, fixed, make, setText, utc } from "./format.js";
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

let lost = null;
let unresponsive = false;

function showLink(state) {
  if (state === "connected") lost = null;
  else if (lost === null && state === "disconnected") lost = Date.now();
  if (state === "connecting" && lost !== null) return;
  setText($("link"), state === "connected" && store.hello && store.hello.view_only ? "view only" : state);
  $("link").dataset.state = state;
  showAge();
}

function showAge() {
  document.body.classList.toggle("past", lost !== null || unresponsive);
  const restarted = $("link").dataset.state === "restarted";
  $("past").hidden = lost === null && !unresponsive;
  if (lost !== null) {
    const age = Math.round((Date.now() - lost) / 1000);
    setText($("past"), restarted ? "The emulator was restarted: open its new address, on its ready line." : `No connection to the emulator for ${age} s; everything shown is from before.`);
  } else if (unresponsive) {
    setText($("past"), "The device is unresponsive (fault: device stuck); it answers no request.");
  }
}

setInterval(showAge, 1000);

const link = new Link({
  message: (message) => store.message(message),
  frame: (head, blob) => store.frame(head, blob),
  history: (numbers) => store.history(numbers),
  state: showLink,
});

const sky = new Sky(store);
new SkyMap(store);
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
  const button = make("button", { type: "button", role: "tab", "data-tab": name, title: number < 4 ? `F${number + 1}` : "", text: name, onclick: () => openTab(name) });
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
  $("unit").title = Object.entries(hello.links).map(([name, where]) => `${name} ${where}`).join("\n");
});

store.on("faults", (names) => {
  const count = names.length;
  setText($("active"), count ? `${count} fault${count === 1 ? "" : "s"}` : "no fault");
  $("active").title = count ? `injected: ${names.join(", ")}` : "injected faults";
  $("active").dataset.state = count ? "bad" : "idle";
});

// Which link the OBC uses, how many requests per second since the last report, and when it sent the last one.
let asked = null;

store.on("status", ({ heard, wall_s: now }) => {
  const spoken = heard.filter((each) => each.age_s !== null).sort((a, b) => a.age_s - b.age_s);
  const total = heard.reduce((sum, each) => sum + each.requests, 0);
  if (asked && now - asked.now < 2) return;
  const rate = asked && total >= asked.total ? (total - asked.total) / (now - asked.now) : 0;
  asked = { total, now };
  setText($("obc"), spoken.length ? `${spoken[0].link} ${fixed(rate, 1)}/s` : "silent");
  setText($("obc-last"), spoken.length ? ago(spoken[0].age_s) : "–");
  $("obc").parentElement.parentElement.title = heard.map((each) => `${each.link}: ${each.requests} requests${each.age_s === null ? "" : `, the last ${ago(each.age_s)}`}`).join("\n");
});

store.on("status", ({ status }) => {
  unresponsive = Boolean(status.faults && status.faults.device && status.faults.device.stuck);
  showAge();
  if (store.cursor !== null) return;
  setText($("mode"), status.mode.replaceAll("_", " ") + (status.error_cause ? `: ${status.error_cause}` : ""));
  $("mode").dataset.mode = status.mode;
  setText($("utc"), utc(status.unix_s));
  setText($("run"), duration(status.run_time_s));
  const age = status.run_time_s - store.now;
  if (status.mode !== "tracking" && status.mode !== "lost_in_space") showValidity(false, "no images");
  else if (age > 10) showValidity(false, "no new image");
});

function showValidity(valid, reason) {
  setText($("validity"), valid ? "valid" : reason.replaceAll("_", " "));
  $("validity").dataset.state = valid ? "good" : "bad";
  const last = valid ? null : store.lastValid;
  setText($("ra-label"), last === null ? "RA, measured" : `last valid ${ago((store.cursor ?? (store.status ? store.status.run_time_s : store.now)) - last)}`);
}

store.on("shown", () => {
  const position = store.position;
  if (position < 0) return;
  const item = (name) => store.rows.at(position, name);
  const mode = store.hello.modes[item("mode")];
  setText($("mode"), mode.replaceAll("_", " "));
  $("mode").dataset.mode = mode;
  showValidity(item("valid") === 1, store.reasons[item("reason")] || "invalid");
  setText($("ra"), `${fixed(turn(item("ra")), 4, 9)}°`);
  setText($("dec"), `${fixed(item("dec"), 4, 9)}°`);
  setText($("roll"), `${fixed(signed(item("roll")), 4, 9)}°`);
  for (const name of ["qx", "qy", "qz", "qw"]) $("ra").dataset[name] = String(item(name));
  setText($("error"), `${fixed(item("error_cross"), 2, 6)} / ${fixed(item("error_roll"), 1, 6)}`);
  setText($("stars"), `${fixed(item("matched"), 0, 3)} of ${fixed(item("detected"), 0, 3)}`);
  if (store.cursor !== null) {
    setText($("utc"), utc(item("unix_s")));
    setText($("run"), duration(item("run_s")));
  }
  showMoment(item);
});

// An angle that is rounded to a full turn with four digits is shown as zero.
function turn(degrees) {
  return degrees >= 359.99995 ? 0 : degrees;
}

// A roll near zero does not jump between 0° and 360°.
function signed(degrees) {
  return degrees > 180 ? degrees - 360 : degrees;
}

function showMoment(item) {
  const image = store.image;
  const behind = store.cursor === null ? 0 : store.now - store.cursor;
  setText($("when"), store.cursor === null ? "live" : `${duration(item("run_s"))}  (−${fixed(behind, 1)} s)`);
  if (!image) return;
  const head = image.head;
  const apart = image.time - item("run_s");
  const note = Math.abs(apart) > 0.5 ? ` (image ${fixed(apart, 1)} s apart)` : "";
  const late = head.late ? " late" : "";
  setText($("frame-info"), `frame ${fixed(head.row[store.rows.index.frame], 0)}${late}  rejected ${head.rejected}${note}`);
}

store.on("cursor", () => {
  const live = store.cursor === null;
  setText($("live"), live ? "❚❚ pause" : "▶ live");
  $("live").classList.toggle("on", !live);
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
  ["1", "1 … 4", "layers over the sky", () => sky.toggle("detections")],
  ["2", "", "", () => sky.toggle("identified")],
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
$("help").addEventListener("click", () => $("keys").showModal());

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
