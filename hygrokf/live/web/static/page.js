// The page: selects the view, updates it, and shows whether its data are current.

import { Alarms } from "./alarms.js";
import { Data } from "./data.js";
import { prepareDialogs } from "./dialogs.js";
import { Fleet } from "./fleet.js";
import { Events, Fault, ask, post } from "./server.js";
import { FRESH_S, clock, countUp, say, second, span, zone } from "./text.js";
import { Turbine } from "./turbine.js";

const PACE_MS = 1000, RETRY_MS = 4000, HEALTH_S = 15;
const part = (id) => document.getElementById(id);
const fleet = new Fleet();
let view = null, scrolled = 0;
let lostAt = null, updatedAt = null;
let healthAt = 0;
let running = null, again = false;
let openAlarms = null, heard = null;

// -- views ---------------------------------------------------------------------------------------------------------
function viewOf(hash) {
  const [, kind = "", name = ""] = hash.match(/^#\/(\w*)(?:\/(.*))?$/) ?? [];
  if (kind === "alarms") return new Alarms(refresh);
  if (kind === "data") return new Data();
  if (kind === "turbine" && name) {
    try {
      return new Turbine(decodeURIComponent(name), refresh);
    } catch {
      return fleet;
    }
  }
  return fleet;
}

function route() {
  const first = view === null;
  if (view === fleet) scrolled = scrollY;
  view?.end();
  view = viewOf(location.hash);
  updatedAt = null;
  part("main").replaceChildren(view.root);
  document.title = `${view.title} – hygrokf`;
  for (const link of document.querySelectorAll("nav a")) {
    const isCurrent = link.dataset.view === view.constructor.name.toLowerCase();
    if (isCurrent) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  scrollTo(0, view === fleet ? scrolled : 0);
  // focusing the heading makes a screen reader announce the new view
  if (!first) view.root.querySelector("h1")?.focus({ preventScroll: true });
  refresh();
}

/** Request the view's data, one request at a time; repeat if something changed meanwhile. */
async function refresh() {
  if (running === view) {
    again = true;
    return;
  }
  const asked = running = view, path = view.path();
  again = false;
  try {
    const data = await (asked.load ? asked.load() : ask(path));
    if (asked === view && path === view.path()) {
      view.update(data);
      part("main").querySelector(":scope > .page-fault")?.remove();
      updatedAt = clock();
      reached();
      tick();
    }
  } catch (fault) {
    failed(fault);
  }
  if (running !== asked) return;
  running = null;
  if (again) refresh();
}

/** A function that runs once, `PACE_MS` after its first call, however often it is called meanwhile. */
function paced(run) {
  let timer = null;
  return () => {
    timer ??= setTimeout(() => {
      timer = null;
      run();
    }, PACE_MS);
  };
}

function failed(fault) {
  if (!(fault instanceof Fault)) throw fault;
  if (fault.status === 401) askToken();
  else if (fault.status === 0) lost();
  else {
    let place = part("main").querySelector(":scope > .page-fault");
    if (!place) {
      place = document.createElement("p");
      place.className = "page-fault fault";
      place.setAttribute("role", "alert");
      part("main").prepend(place);
    }
    say(place, fault.message);
    if (fault.status >= 500) setTimeout(refresh, RETRY_MS);
  }
}

/** The summary of alarms and sources that every view shows. */
async function health() {
  healthAt = clock();
  try {
    const data = await ask("health");
    count("open-alarms", data.open_alarms, "open");
    count("lost-sources", data.sources.filter((source) => source.not_reached !== null).length, "not reached");
    if (openAlarms !== null && data.open_alarms > openAlarms) say(part("said"), `${data.open_alarms} alarms are open`);
    openAlarms = data.open_alarms;
    heard = data.heard;
    part("label").hidden = !data.label;
    say(part("label"), data.label);
    tick();
    say(part("version"), ` · hygrokf ${data.version}`);
    part("logout").hidden = !data.token;
    if (view.path() === "health") view.update(data);
  } catch (fault) {
    if (fault instanceof Fault && fault.status === 401) askToken();
    else if (!(fault instanceof Fault)) throw fault;
  }
}

function count(id, number, words) {
  part(id).hidden = !number;
  say(part(id), String(number));
  part(id).setAttribute("aria-label", `${number} ${words}`);
}

const refreshSoon = paced(refresh), healthSoon = paced(health);

// -- connection ----------------------------------------------------------------------------------------------------
const events = new Events(
  (names) => {
    if (view.concerns(names)) refreshSoon();
    healthSoon();
  },
  () => { reached(); refresh(); health(); },
  lost,
);

function lost() {
  if (lostAt === null) lostAt = clock();
  document.body.classList.add("lost");
  part("lost").hidden = false;
  tick();
}

function reached() {
  if (lostAt === null || events.source?.readyState !== EventSource.OPEN) return;
  lostAt = null;
  document.body.classList.remove("lost");
  part("lost").hidden = true;
  tick();
}

function tick() {
  countUp();
  view?.tick();
  part("live").classList.toggle("off", lostAt !== null);
  part("live").classList.toggle("waiting", lostAt === null && updatedAt === null);
  if (lostAt !== null) {
    say(part("lost"), `Connection lost since ${second(lostAt)} (${span(clock() - lostAt)}). Reconnecting … `
      + "The values shown are as old as stated.");
    say(part("live-words"), "not connected");
  } else say(part("live-words"), updatedAt === null ? "connecting" : "page connected");
  const old = heard === null || clock() - heard > FRESH_S;
  part("live").classList.toggle("old", lostAt === null && updatedAt !== null && old);
  say(part("live-data"), openAlarms === null ? "" : heard === null ? "no data yet" : `data ${span(clock() - heard)} old`);
  if (lostAt === null && clock() - healthAt > HEALTH_S) health();
}

// -- access --------------------------------------------------------------------------------------------------------
function askToken() {
  events.close();
  if (!part("login").open) part("login").showModal();
}

part("login").addEventListener("cancel", (event) => event.preventDefault());
part("login").querySelector("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await post("login", { token: part("login-token").value });
    part("login-token").value = "";
    say(part("login-fault"), "");
    part("login").close();
    begin();
  } catch (fault) {
    if (!(fault instanceof Fault)) throw fault;
    say(part("login-fault"), fault.message);
  }
});
part("logout").addEventListener("click", async () => {
  await post("logout", {});
  location.reload();
});

// -- start ---------------------------------------------------------------------------------------------------------
async function begin() {
  try {
    await ask("health");
    events.open();
  } catch (fault) {
    if (fault instanceof Fault && fault.status === 401) return askToken();
    events.open();
  }
}

prepareDialogs(() => { refresh(); health(); });
say(part("zone"), `Times in ${zone()}`);
addEventListener("hashchange", route);
addEventListener("keydown", (event) => {
  if (event.key !== "/" || event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|TEXTAREA)$/.test(event.target.tagName)) return;
  if (view !== fleet || document.querySelector("dialog[open]")) return;
  event.preventDefault();
  fleet.search.focus();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => view?.recolour?.());
setInterval(tick, 1000);
route();
begin();
