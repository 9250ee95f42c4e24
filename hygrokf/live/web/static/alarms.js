// The list of alarms: what each one is, since when, what to do, and who acknowledged it.

import { clock, local, make, say, span, timeOf, age } from "./text.js";
import { Fault, post } from "./server.js";

const BY = "hygrokf.by";

/** One alarm; with `linked` also a link to its turbine. */
export function alarmItem(alarm, linked) {
  const open = alarm.ended === null;
  const lasted = open ? ["for ", age(alarm.began)] : [`lasted ${span(alarm.ended - alarm.began)}`];
  const seen = alarm.acknowledged === null ? null
    : make("p", { class: "seen" }, `acknowledged by ${alarm.acknowledged_by}, `, timeOf(alarm.acknowledged));
  const button = open && alarm.acknowledged === null
    ? make("button", { type: "button", class: "acknowledge", onclick: () => confirm(alarm) }, "Acknowledge") : null;
  return make("li", { class: `item ${open ? alarm.severity : "ended"}`, dataset: { alarm: alarm.id } },
    make("div", {},
      make("p", { class: "head" }, make("span", { class: `badge ${open ? alarm.severity : "ended"}` }, open ? alarm.severity : "ended"),
        " ", linked ? make("a", { href: `#/turbine/${encodeURIComponent(alarm.turbine)}` }, alarm.turbine) : null,
        linked ? " " : null, make("strong", {}, alarm.kind),
        make("span", { class: "more" }, " since ", timeOf(alarm.began), ", ", ...lasted)),
      make("p", { class: "statement" }, alarm.statement),
      alarm.remedy ? make("p", { class: "remedy" }, "To do: ", alarm.remedy) : null,
      seen),
    button);
}

/** All alarms that are open or ended recently. */
export class Alarms {
  constructor() {
    this.open = make("ul", { class: "alarms" });
    this.ended = make("ul", { class: "alarms" });
    this.none = make("p", { class: "quiet-note" }, "No alarm is open.");
    this.earlier = make("h2", { hidden: true }, "Ended in the last 14 days");
    this.root = make("section", { "aria-label": "Alarms" }, make("h1", { tabindex: "-1" }, "Alarms"), this.none, this.open, this.earlier, this.ended);
  }

  get title() { return "Alarms"; }
  concerns() { return true; }
  path() { return "alarms"; }

  update(found) {
    const open = found.alarms.filter((alarm) => alarm.ended === null);
    const ended = found.alarms.filter((alarm) => alarm.ended !== null);
    replaceItems(this.open, open, true);
    replaceItems(this.ended, ended, true);
    this.none.hidden = open.length > 0;
    this.earlier.hidden = ended.length === 0;
  }

  tick() {}
  end() {}
}

/** Replace only the items of changed alarms, so that a focused button keeps its focus. */
export function replaceItems(list, alarms, linked) {
  const known = new Map([...list.children].map((item) => [item.dataset.text, item]));
  const items = alarms.map((alarm) => {
    const text = JSON.stringify(alarm);
    const item = known.get(text) ?? alarmItem(alarm, linked);
    item.dataset.text = text;
    return item;
  });
  if (items.length !== list.children.length || items.some((item, i) => item !== list.children[i])) list.replaceChildren(...items);
}

// -- the dialog for acknowledging ------------------------------------------------------------------------------------
const part = (name) => document.getElementById(`acknowledge${name}`);
let asked = null;

function confirm(alarm) {
  asked = alarm;
  say(part("-alarm"), `${alarm.turbine}: ${alarm.kind}, since ${local(alarm.began)}`);
  say(part("-fault"), "");
  part("-by").value = localStorage.getItem(BY) ?? "";
  part("").showModal();
  part("-by").select();
}

/** Activate the dialog; `done` is called with the turbine after an acknowledgement. */
export function prepareAcknowledge(done) {
  part("-not").addEventListener("click", () => part("").close());
  part("").querySelector("form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const by = part("-by").value.trim();
    try {
      const found = await post("alarms/acknowledge", { id: asked.id, by });
      localStorage.setItem(BY, by);
      part("").close();
      done(found.turbine);
    } catch (fault) {
      if (!(fault instanceof Fault)) throw fault;
      say(part("-fault"), fault.message);
      if (fault.status === 409) done(asked.turbine);
    }
  });
}
