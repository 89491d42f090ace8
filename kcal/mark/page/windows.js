// Windows on the same marks: they tell each other at once, and ask the server besides, as they may be in two browsers.
import {AWAY, Refused, get, latest} from "/page/api.js";

// Gives the app `others`, whom to tell of a change, and `refresh`, which shows what others changed.
export function followOthers(app) {
  let away = false;
  app.others = new BroadcastChannel("kcal-mark:" + app.about.files.log);
  app.others.onmessage = () => app.refresh();
  app.refresh = latest(async () => {
    if (app.dragged || app.actions.waiting.length) return;
    let state;
    try { state = await get("state"); } catch (error) {
      away = true;
      app.say(error instanceof Refused ? error.message : AWAY, true);
      return;
    }
    if (away) { away = false; app.settle("bad"); }
    // What was done here meanwhile has its own answer.
    if (app.actions.waiting.length) return;
    if (app.version >= 0 && state.version > app.version) app.say("another window changed the marks");
    app.take(state);
  });
  const look = () => { if (!document.hidden) app.refresh(); };
  setInterval(look, 2000);
  document.addEventListener("visibilitychange", look);
}
