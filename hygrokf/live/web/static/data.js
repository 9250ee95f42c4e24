// The data view: sources, store, and rejected deliveries that belong to no turbine.

import { age, make, significant, span, whole } from "./text.js";
import { counted } from "./turbine.js";

export class Data {
  constructor() {
    this.store = make("p");
    this.sources = make("tbody");
    this.none = make("p", { class: "quiet-note" }, "No source.");
    this.refused = make("ul", { class: "aside" });
    this.root = make("section", { "aria-label": "Data" }, make("h1", { tabindex: "-1" }, "Data"), this.store,
      make("h2", {}, "Sources"), this.none,
      make("table", { class: "signals sources" }, make("thead", {}, make("tr", {},
        ["Source", "State", "Last message", "Lag", ""].map((text) => make("th", { scope: "col" }, text)))), this.sources),
      make("h2", {}, "Refused"), this.refused);
  }

  get title() { return "Data"; }
  concerns() { return true; }
  path() { return "health"; }

  update(data) {
    const since = data.committed ? [", the last ", age(data.committed), " ago"] : [];
    const wait = data.wait_99_s === null ? "" : ` 99 % were committed within ${significant(data.wait_99_s)} s.`;
    this.store.replaceChildren(`${whole(data.deliveries)} deliveries since the tracker started`, ...since, ".", wait);
    if (data.store) this.store.append(make("strong", { class: "fault" }, ` The store cannot be reached: ${data.store}`));
    this.none.hidden = data.sources.length > 0;
    this.sources.replaceChildren(...data.sources.map((source) => make("tr", { class: source.not_reached === null ? null : "lost" },
      make("th", { scope: "row" }, source.url), make("td", { class: "word" }, source.state),
      make("td", { class: "word" }, ...(source.heard === null ? ["never"] : [age(source.heard), " ago"])),
      make("td", { class: "word" }, source.lag === null ? "–" : span(source.lag)),
      make("td", {}, source.words === source.url ? "" : source.words))));
    const { "store replaced": replaced, ...refused } = data.refused;
    if (replaced) {
      const times = `${whole(replaced)} time${replaced === 1 ? "" : "s"}`;
      this.store.append(make("strong", { class: "fault" }, ` The store was replaced ${times} while a tracker ran.`));
    }
    const rows = Object.entries(refused).map(([kind, count]) => make("li", {}, counted(kind, count, "payload")));
    this.refused.replaceChildren(...(rows.length ? rows : [make("li", { class: "quiet-note" }, "None.")]));
  }

  tick() {}
  end() {}
}
