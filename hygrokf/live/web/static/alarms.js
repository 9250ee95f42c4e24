// The list of alarms: kind, time, remedy and acknowledgement of each alarm, and the shelves.

import { askAcknowledgement, askShelf } from "./dialogs.js";
import { ask, post } from "./server.js";
import { age, local, make, span, timeOf, whole, withTimes } from "./text.js";

/** The item of an alarm; `linked`: with a link to its turbine; `shelf`: the shelf of its turbine and kind, if any. */
export function alarmItem(alarm, linked, shelf) {
  const open = alarm.ended === null;
  const lasted = open ? ["for ", age(alarm.began)] : [`lasted ${span(alarm.ended - alarm.began)}`];
  const where = alarm.turbine || "sources";
  const buttons = [];
  if (open && alarm.acknowledged === null) {
    buttons.push(make("button", { type: "button", class: "acknowledge",
      onclick: () => askAcknowledgement(`${where}: ${alarm.kind}, since ${local(alarm.began)}`, alarm.id) }, "Acknowledge"));
  }
  if (open && !shelf) {
    buttons.push(make("button", { type: "button", class: "quiet shelve", onclick: () => askShelf(alarm.turbine, alarm.kind) }, "Shelve"));
  }
  return make("li", { class: `item ${open ? alarm.severity : "ended"}`, dataset: { alarm: alarm.id } },
    make("div", {},
      make("p", { class: "head" }, make("span", { class: `badge ${open ? alarm.severity : "ended"}` }, open ? alarm.severity : "ended"),
        " ", !linked ? null : alarm.turbine
          ? make("a", { href: `#/turbine/${encodeURIComponent(alarm.turbine)}` }, alarm.turbine) : make("a", { href: "#/data" }, where),
        linked ? " " : null, make("strong", {}, alarm.kind),
        make("span", { class: "more" }, " since ", timeOf(alarm.began), ", ", ...lasted)),
      make("p", { class: "statement" }, withTimes(alarm.pieces)),
      alarm.remedy ? make("p", { class: "remedy" }, "To do: ", alarm.remedy) : null,
      alarm.acknowledged === null ? null : acknowledgedBy(alarm),
      open && shelf ? make("p", { class: "seen" }, "shelved until ", timeOf(shelf.until)) : null),
    buttons.length ? make("div", { class: "buttons" }, buttons) : null);
}

function acknowledgedBy(alarm) {
  return make("p", { class: "seen" }, `acknowledged by ${alarm.acknowledged_by}, `, timeOf(alarm.acknowledged),
    alarm.cause ? `: ${alarm.cause}` : "", alarm.look_again ? [" ", timeOf(alarm.look_again)] : "", alarm.note ? ` – ${alarm.note}` : "");
}

/** Replace only the items of changed alarms, so that a focused button keeps its focus. */
export function replaceItems(list, alarms, linked, shelves = []) {
  const present = new Map([...list.children].map((item) => [item.dataset.text, item]));
  const items = alarms.map((alarm) => {
    const shelf = shelves.find(({ turbine, kind }) => turbine === alarm.turbine && kind === alarm.kind);
    const text = JSON.stringify([alarm, shelf?.until]);
    const item = present.get(text) ?? alarmItem(alarm, linked, shelf);
    item.dataset.text = text;
    return item;
  });
  if (items.length !== list.children.length || items.some((item, i) => item !== list.children[i])) list.replaceChildren(...items);
}

/** The item of a shelf, with a button that ends the shelf and then calls `ended`. */
export function shelfItem(shelf, linked, ended) {
  const { turbine, kind } = shelf;
  const end = async () => {
    await post("shelves", { turbine, kind }, "DELETE").catch(() => null); // the shelf may have ended by itself, which the new list shows
    ended();
  };
  return make("li", { class: "item shelf" },
    make("p", {}, linked ? `${turbine || "sources"}: ` : "", make("strong", {}, kind), " until ", timeOf(shelf.until),
      make("span", { class: "more" }, `, shelved by ${shelf.made_by}, `, timeOf(shelf.made), shelf.note ? ` – ${shelf.note}` : "")),
    make("button", { type: "button", class: "quiet", onclick: end }, "End"));
}

/** All alarms that are open or ended recently, the shelves, and how often each kind was right. */
export class Alarms {
  constructor(refresh) {
    this.refresh = refresh;
    this.open = make("ul", { class: "alarms" });
    this.ended = make("ul", { class: "alarms" });
    this.none = make("p", { class: "quiet-note" }, "No alarm is open.");
    this.shelves = make("ul", { class: "alarms shelves" });
    this.labels = make("tbody");
    this.earlier = make("section", { hidden: true }, make("h2", {}, "Ended in the last 14 days"), this.ended);
    this.shelved = make("section", { hidden: true }, make("h2", {}, "Shelved"),
      make("p", { class: "quiet-note" }, "Of these alarms nobody is notified."), this.shelves);
    this.right = make("section", { hidden: true }, make("h2", {}, "How often each kind was right"),
      make("p", { class: "quiet-note" }, "Alarms that the store keeps, by the cause with which they were acknowledged."),
      make("table", { class: "signals labels" }, make("thead", {}, make("tr", {},
        ["Alarm", "Raised", "Right", "False", "Causes"].map((text) => make("th", { scope: "col" }, text)))), this.labels));
    this.root = make("section", { "aria-label": "Alarms" },
      make("div", { class: "tools" }, make("h1", { tabindex: "-1" }, "Alarms"),
        make("a", { href: "api/alarms.csv", download: "alarms.csv" }, "All alarms as CSV")),
      this.none, this.open, this.shelved, this.right, this.earlier);
  }

  get title() { return "Alarms"; }
  concerns() { return true; }
  path() { return "alarms"; }

  async load() {
    const [alarms, shelves, labels] = await Promise.all([ask(this.path()), ask("shelves"), ask("alarms/labels")]);
    return { ...alarms, shelves: shelves.shelves, labels: labels.kinds };
  }

  update(data) {
    const open = data.alarms.filter((alarm) => alarm.ended === null);
    const ended = data.alarms.filter((alarm) => alarm.ended !== null);
    replaceItems(this.open, open, true, data.shelves);
    replaceItems(this.ended, ended, true);
    this.none.hidden = open.length > 0;
    this.earlier.hidden = ended.length === 0;
    this.shelved.hidden = data.shelves.length === 0;
    this.shelves.replaceChildren(...data.shelves.map((shelf) => shelfItem(shelf, true, this.refresh)));
    this.right.hidden = data.labels.length === 0;
    this.labels.replaceChildren(...data.labels.map(labelRow));
  }

  tick() {}
  end() {}
}

/** The row of a kind of alarm; the share of right alarms counts only judged ones. */
function labelRow(label) {
  const judged = label.right + label.wrong;
  const share = judged ? `${whole(label.right)} of ${whole(judged)}` : "–";
  const causes = Object.entries(label.causes).filter(([, count]) => count).map(([cause, count]) => `${whole(count)} ${cause}`);
  return make("tr", { dataset: { kind: label.kind } }, make("th", { scope: "row" }, label.kind), make("td", {}, whole(label.alarms)),
    make("td", {}, share), make("td", {}, judged ? whole(label.wrong) : "–"), make("td", {}, causes.join(", ") || "not acknowledged yet"));
}
