// Dialogs for statements of people: acknowledgements, shelves and events.

import { Fault, post } from "./server.js";
import { say } from "./text.js";

const BY = "hygrokf.by";

/** A dialog of index.html, whose form gives the fields of a statement; `open` adds further fields to what is posted. */
class Statement {
  /** content: function that turns the form's fields into the posted content; done: called with the answer after success. */
  constructor(id, path, content, done) {
    Object.assign(this, { id, path, content, done });
    this.form = this.part("").querySelector("form");
    this.part("-not").addEventListener("click", () => this.part("").close());
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.send();
    });
  }

  part(name) { return document.getElementById(`${this.id}${name}`); }

  open(about, fields) {
    this.fixedFields = fields;
    this.form.reset();
    say(this.part("-about"), about);
    say(this.part("-fault"), "");
    this.part("-by").value = localStorage.getItem(BY) ?? "";
    this.part("").showModal();
    this.part("-by").select();
  }

  async send() {
    const fields = Object.fromEntries(new FormData(this.form));
    const by = fields.by.trim();
    try {
      const answer = await post(this.path, { ...this.fixedFields, by, note: fields.note.trim(), ...this.content(fields) });
      localStorage.setItem(BY, by);
      this.part("").close();
      this.done(answer);
    } catch (fault) {
      if (!(fault instanceof Fault)) throw fault;
      say(this.part("-fault"), fault.message);
      if (fault.status === 409) this.done(null);
    }
  }
}

const LATER = "look again";
let acknowledgement, shelf, change;

/** Activate the dialogs; `done` is called after each statement. */
export function prepareDialogs(done) {
  acknowledgement = new Statement("acknowledge", "alarms/acknowledge",
    ({ cause, days }) => cause === LATER ? { cause, days: Number(days) } : { cause }, done);
  const cause = acknowledgement.form.elements.cause, days = acknowledgement.part("-days");
  const showDays = () => { days.hidden = cause.value !== LATER; };
  cause.addEventListener("change", showDays);
  acknowledgement.form.addEventListener("reset", () => setTimeout(showDays));
  shelf = new Statement("shelve", "shelves", (fields) => ({ days: Number(fields.days) }), done);
  change = new Statement("change", "events", ({ kind, time }) =>
    time ? { kind, time: new Date(time).getTime() / 1000 } : { kind }, done);
}

export const askAcknowledgement = (about, alarm) => acknowledgement.open(about, { id: alarm });
export const askShelf = (turbine, kind) =>
  shelf.open(`${turbine || "sources"}: ${kind}. It stays on this page and in the store, and nobody is notified.`, { turbine, kind });
export const askChange = (turbine) => change.open(turbine, { turbine });
