// Requests to the server, and the queue of actions: none is lost while the server is away.
const stored = sessionStorage.getItem("kcal-token");
const token = location.hash.length > 1 ? location.hash.slice(1) : stored;
if (location.hash.length > 1) {
  sessionStorage.setItem("kcal-token", token);
  history.replaceState(null, "", location.pathname);
}

export class Refused extends Error {}

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
    this.place = "kcal-unsent:" + place;
    this.answered = answered;
    this.failed = failed;
    this.waiting = JSON.parse(localStorage.getItem(this.place) || "[]");
    this.sending = false;
    if (this.waiting.length) this.send();
  }
  push(action) {
    this.waiting.push({key: crypto.randomUUID(), action});
    this.keep();
    return this.send();
  }
  keep() { localStorage.setItem(this.place, JSON.stringify(this.waiting)); }
  async send() {
    if (this.sending) return;
    this.sending = true;
    while (this.waiting.length) {
      try {
        const state = await post("act", this.waiting[0]);
        this.waiting.shift();
        this.keep();
        this.answered(state, this.waiting.length);
      } catch (error) {
        if (error instanceof Refused && error.status !== 401) {
          this.waiting.shift();
          this.keep();
          this.failed(error.message);
          continue;
        }
        const what = error instanceof Refused ? error.message : "the server does not answer: start kcal mark again with the same -o, and open its address";
        this.failed(what + " (" + this.waiting.length + " unsent, kept here)");
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
