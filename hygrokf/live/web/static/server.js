// Requests to the server, and its events.

import { setClock } from "./text.js";

const SILENT_MS = 25000;
const RETRY_MS = 3000;

export class Fault extends Error {
  constructor(status, text) {
    super(text);
    this.status = status;
  }
}

/** Request data at an address below /api; throws Fault, with status 0 if the server does not answer. */
export async function ask(path, signal) {
  return contentOf(fetch(`api/${path}`, { signal, headers: { Accept: "application/json" } }));
}

export async function post(path, content, method = "POST") {
  const headers = { "Content-Type": "application/json" };
  return contentOf(fetch(`api/${path}`, { method, headers, body: JSON.stringify(content) }));
}

async function contentOf(request) {
  let response, content;
  try {
    response = await request;
  } catch (fault) {
    if (fault.name === "AbortError") throw fault;
    throw new Fault(0, "the page's server does not answer");
  }
  try {
    content = await response.json();
  } catch {
    throw new Fault(response.status || 0, "the page's server sent an invalid answer");
  }
  if (!response.ok) throw new Fault(response.status, content.fault || `status ${response.status}`);
  if (content.now) setClock(content.now);
  return content;
}

/** The stream of the server's events: reports changes, connection and loss, and reconnects by itself. */
export class Events {
  constructor(changed, connected, lost) {
    Object.assign(this, { changed, connected, lost });
    this.heard = Date.now();
    this.source = null;
    setInterval(() => this.watch(), 1000);
  }

  open() {
    this.close();
    this.heard = Date.now();
    const source = this.source = new EventSource("events");
    source.addEventListener("alive", () => this.note());
    source.addEventListener("changed", (event) => {
      this.note();
      this.changed(JSON.parse(event.data).turbines);
    });
    source.onopen = () => { this.note(); this.connected(); };
    source.onerror = () => {
      this.lost();
      // browsers retry by themselves if nobody answered, but not after a refusal
      if (source.readyState === EventSource.CLOSED && source === this.source) this.again();
    };
  }

  close() {
    if (this.source) this.source.close();
    this.source = null;
    clearTimeout(this.timer);
  }

  again() {
    this.close();
    this.timer = setTimeout(() => this.open(), RETRY_MS);
  }

  note() { this.heard = Date.now(); }

  /** Detect a dead connection that never ended, after a closed lid or a changed network. */
  watch() {
    if (this.source && this.source.readyState === EventSource.OPEN && Date.now() - this.heard > SILENT_MS) {
      this.lost();
      this.again();
    }
  }
}
