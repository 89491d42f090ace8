// Requests to the server, and the queue of actions: none is lost while the server is away.
const stored = sessionStorage.getItem("kcal-token");
const token = location.hash.length > 1 ? location.hash.slice(1) : stored;
if (location.hash.length > 1) {
  sessionStorage.setItem("kcal-token", token);
  history.replaceState(null, "", location.pathname);
}

export class Refused extends Error {}
export const AWAY = "the server does not answer: start kcal mark again with the same -o, and open its address";

async function checked(response) {
  if (response.ok) return response;
  let text = response.statusText;
  try { text = (await response.json()).error; } catch (error) { /* no words with it */ }
  const refused = new Refused(text);
  refused.status = response.status;
  throw refused;
}

export async function raw(name, query) {
  const address = "/api/" + name + (query ? "?" + new URLSearchParams(query) : "");
  return checked(await fetch(address, {headers: {"X-Kcal-Token": token}}));
}
export const get = async (name, query) => (await raw(name, query)).json();
export async function post(name, body) {
  const headers = {"X-Kcal-Token": token, "Content-Type": "application/json"};
  return (await checked(await fetch("/api/" + name, {method: "POST", headers, body: JSON.stringify(body)}))).json();
}

// Actions are sent one after the other, again and again until they are answered. The key makes doing them twice harmless.
export class Actions {
  constructor(place, answered, failed) {
    // Each window has a place of its own; a new one takes over what closed ones left.
    const shared = "kcal-unsent:" + place;
    this.place = shared + ":" + crypto.randomUUID();
    this.answered = answered;
    this.failed = failed;
    this.waiting = [];
    for (const name of Object.keys(localStorage).filter((each) => each === shared || each.startsWith(shared + ":"))) {
      this.waiting.push(...JSON.parse(localStorage.getItem(name)));
      localStorage.removeItem(name);
    }
    if (this.waiting.length) this.keep();
    this.sending = false;
    this.ends = new Map();
    if (this.waiting.length) this.send();
  }
  // Ends when this action is answered or refused, however many wait before it.
  push(action) {
    const key = crypto.randomUUID();
    this.waiting.push({key, action});
    this.keep();
    const ended = new Promise((done) => this.ends.set(key, done));
    this.send();
    return ended;
  }
  // The first of those that wait is dealt with.
  shift() {
    const {key} = this.waiting.shift();
    this.keep();
    return () => { const done = this.ends.get(key); this.ends.delete(key); if (done) done(); };
  }
  keep() {
    if (this.waiting.length) localStorage.setItem(this.place, JSON.stringify(this.waiting));
    else localStorage.removeItem(this.place);
  }
  async send() {
    if (this.sending) return;
    this.sending = true;
    while (this.waiting.length) {
      try {
        const state = await post("act", this.waiting[0]);
        const ended = this.shift();
        this.answered(state, this.waiting.length);
        ended();
      } catch (error) {
        // What the server cannot do now, for example because the disk is full, it may do later.
        if (error instanceof Refused && error.status !== 401 && error.status < 500) {
          const ended = this.shift();
          this.failed(error.message, false);
          ended();
          continue;
        }
        const what = error instanceof Refused ? error.message : AWAY;
        this.failed(what + " (" + this.waiting.length + " unsent, kept here)", true);
        await new Promise((done) => setTimeout(done, 1000));
      }
    }
    this.sending = false;
  }
}

// At most one request at a time; of those that come meanwhile, only the last is sent.
export function latest(ask) {
  let busy = false, next = null;
  return async function call(...values) {
    if (busy) { next = values; return; }
    busy = true;
    try { await ask(...values); } catch (error) { if (!(error instanceof Refused)) console.warn(error); }
    busy = false;
    if (next) { const again = next; next = null; call(...again); }
  };
}
