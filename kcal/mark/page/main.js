// The page: what is selected, what a click, a drag and a key do. The server knows everything that lasts.
import {Actions, AWAY, Refused, get, latest, post} from "/page/api.js";
import {followOthers} from "/page/windows.js";
import {View} from "/page/view.js";
import {listen} from "/page/keys.js";
import {drawPanel, drawTable} from "/page/panel.js";
import {drawMap} from "/page/map.js";

const SIDES = ["left", "right"];
const other = (side) => (side === "left" ? "right" : "left");
const byId = (id) => document.getElementById(id);

// Pictures stand side by side or above each other, whichever shows them larger.
function arrange([width, height]) {
  const main = document.querySelector("main");
  main.style.setProperty("--aspect", Math.min(width / height, 2));
  const across = main.clientWidth - document.querySelector("aside").clientWidth, down = main.clientHeight;
  main.classList.toggle("stacked", Math.min(across / width, down / 2 / height) > 1.1 * Math.min(across / 2 / width, down / height));
}

class App {
  constructor(about) {
    this.about = about;
    this.frame = 0;
    this.items = [];
    this.survey = {};
    this.rig = {promises: [], history: [], warnings: []};
    this.selected = null;
    this.side = "left";
    this.linked = true;
    this.interpolated = false;
    this.byKeyboard = false;
    this.curves = {};
    this.proposals = {};
    this.dragged = null;
    this.version = -1;
    this.views = {};
    const fitting = () => arrange(about.images.left.size);
    fitting();
    addEventListener("resize", fitting);
    for (const side of SIDES) this.views[side] = new View(side, about.images[side], this);
    followOthers(this);
    this.actions = new Actions(about.files.log, (state) => this.answered(state), (text, kept) => this.failed(text, kept));
    this.askCurve = latest(async (side, u, v, key) => {
      const found = await post("curve", {side, frame: this.frame, u, v});
      if (key !== this.key()) return;
      this.curves = found.refusal ? {} : {[other(side)]: found};
      if (found.refusal) this.refuse(found.refusal, found.solved);
      this.draw();
    });
    this.askPosition = latest(async (left, right, matched) => {
      const strip = ({u, v, cov, how, frame}) => ({u, v, cov, how, frame});
      const found = await post("position", {left: strip(left), right: strip(right), matched});
      if (this.dragged) { this.dragged.item.position = found; this.draw(); byId("worth").textContent = found.refusal || found.text; }
    });
    for (const side of SIDES) this.handle(this.views[side]);
  }

  key() { return this.selected + "/" + this.frame; }
  frameName() { return this.about.frames[this.frame]; }
  item(name = this.selected) { return this.items.find((item) => item.name === name) || null; }
  markOf(side, item = this.item()) {
    if (!item) return null;
    if (this.dragged && this.dragged.side === side && this.dragged.item.name === item.name) return this.dragged.mark;
    return item[side];
  }

  say(text, bad = false) {
    this.said = bad ? "bad" : "";
    byId("status").textContent = text;
    byId("status").classList.toggle("bad", bad);
  }
  // Why something cannot be had now, which may change with the next landmark.
  refuse(text, solved = true) { this.say(text); this.said = solved ? "refusal" : "no rig"; }
  // What was said of an earlier item or rig no longer holds.
  settle(...kinds) { if (kinds.includes(this.said)) this.say(""); }

  answered(state) {
    this.settle("bad");
    this.take(state);
    this.others.postMessage(state.version);
  }
  failed(text, kept) {
    this.say(text, true);
    // The page shows what was asked for; the server knows what there is.
    if (!kept) this.refresh();
  }
  inside(side, u, v) {
    const [width, height] = this.about.images[side].size;
    if (u >= -0.5 && v >= -0.5 && u <= width - 0.5 && v <= height - 0.5) return true;
    this.say("that is outside the picture: nothing was marked", true);
    return false;
  }

  // A new state from the server.
  take(state) {
    const text = JSON.stringify(state);
    if (state.version < this.version) return;
    if (text === this.last && !this.moved) return;
    this.last = text;
    this.moved = false;
    const rigChanged = state.rig.known !== this.rig.known || JSON.stringify(state.rig.promises) !== JSON.stringify(this.rig.promises);
    if (state.rig.text !== this.rig.text || (this.pending && !state.pending)) this.settle("no rig");
    this.version = state.version;
    this.items = state.items;
    this.survey = state.survey;
    this.rig = state.rig;
    const item = this.item();
    if (!item) this.selected = null;
    // Whoever marked a side while its proposal was on the way needs none.
    else for (const side of SIDES) if (item[side]) this.proposals[side] = undefined;
    byId("trouble").textContent = state.trouble;
    byId("trouble").hidden = !state.trouble;
    byId("undo").disabled = !state.undo;
    byId("redo").disabled = !state.redo;
    document.documentElement.dataset.version = state.version;
    document.documentElement.dataset.pending = state.pending;
    this.pending = state.pending;
    this.draw();
    drawPanel(this);
    drawTable(this);
    if (rigChanged) this.settle("refusal");
    if (state.pending) this.poll();
    else { drawMap(this); if (rigChanged) this.guide(); }
  }
  poll() {
    clearTimeout(this.timer);
    this.timer = setTimeout(async () => {
      try { this.take(await get("state")); } catch (error) { this.poll(); }
    }, 250);
  }
  draw() {
    const proposed = SIDES.some((side) => this.proposals[side] && !this.proposals[side].refusal);
    for (const id of ["accept", "reject"]) byId(id).disabled = !proposed;
    for (const side of SIDES) this.views[side].draw();
  }
  act(action) { return this.actions.push(action); }

  select(name, look = true) {
    if (name !== this.selected) this.settle("refusal", "no rig", "bad");
    this.selected = name;
    this.curves = {};
    this.proposals = {};
    const item = this.item();
    if (item) {
      const frame = this.about.frames.indexOf((item.left || item.right || {}).frame);
      if (item.kind === "target" && frame >= 0 && frame !== this.frame) this.show(frame);
      if (look) {
        for (const side of SIDES) {
          const mark = item[side];
          if (mark && this.views[side].scale > this.views[side].ratio * 1.5) this.views[side].look(mark.u, mark.v);
        }
      }
    }
    drawPanel(this);
    drawTable(this);
    drawMap(this);
    this.draw();
    this.guide();
  }

  // The epipolar curve and the proposal for the side that has no mark yet; for the reference, both.
  guide() { return this.askGuide().catch((error) => this.unanswered(error)); }
  async askGuide() {
    const item = this.item(), key = this.key();
    if (!item || !this.about.cameras && !this.about.reference.length) return;
    if (this.about.reference.includes(item.name)) {
      for (const side of SIDES) {
        if (item[side]) continue;
        const found = await post("again", {name: item.name, side, frame: this.frame, reach: 40});
        if (key !== this.key()) return;
        this.proposed(side, found);
      }
      return;
    }
    const from = SIDES.find((side) => item[side] && !item[other(side)]);
    if (!from) {
      if (item[this.side]) this.askCurve(this.side, item[this.side].u, item[this.side].v, key);
      return;
    }
    const mark = item[from];
    if (item.kind === "target" && mark.frame !== this.frameName()) return;
    this.askCurve(from, mark.u, mark.v, key);
    const found = await post("proposal", {side: from, frame: this.frame, u: mark.u, v: mark.v, how: mark.how});
    if (key === this.key() && !this.item()[other(from)]) this.proposed(other(from), found);
  }
  // A question without an answer is said; what was marked is kept by the actions.
  unanswered(error) { this.say(error instanceof Refused ? error.message : AWAY, true); }
  proposed(side, found) {
    this.proposals[side] = found;
    document.documentElement.dataset.proposal = found.refusal ? "refused" : "there";
    if (found.refusal) this.refuse(`${side}: ${found.refusal}`, found.solved);
    else {
      this.say(`${side}: proposal (${found.how}) with σ ${found.sigma.toFixed(3)} px, correlation ${found.score.toFixed(2)}. Enter accepts it, R rejects it.`);
      const view = this.views[side];
      if (view.scale > 3 * view.ratio) view.look(found.u, found.v);
    }
    this.draw();
  }
  accept() {
    const item = this.item();
    let done = false;
    for (const side of SIDES) {
      const found = this.proposals[side];
      if (!item || !found || found.refusal) continue;
      const again = this.about.reference.includes(item.name);
      const mark = {u: found.u, v: found.v, cov: found.cov, how: again ? "again" : found.how, frame: this.frameName()};
      this.act({do: "put", name: item.name, side, mark, matched: !again && found.how === "match"});
      done = true;
    }
    this.proposals = {};
    this.say(done ? `${item.name}: accepted` : "there is no proposal to accept", false);
    if (done && this.about.reference.includes(item.name)) this.nextOfReference();
    this.draw();
  }
  reject() {
    this.proposals = {};
    document.documentElement.dataset.proposal = "rejected";
    this.say("proposal rejected; mark it by a click");
    this.draw();
    if (this.item() && this.about.reference.includes(this.selected)) this.nextOfReference();
  }
  nextOfReference() {
    const at = this.about.reference.indexOf(this.selected);
    const next = this.about.reference.slice(at + 1).find((name) => { const item = this.item(name); return !item || !item.left || !item.right; });
    if (next) this.again(next);
    else this.say("all points of the reference were shown; rejected ones stay without marks");
  }
  async again(name) {
    if (!this.item(name)) await this.act({do: "add", name, kind: "feature"});
    this.select(name);
  }

  freeName(kind) {
    let number = 1;
    while (this.item(kind + " " + number)) number += 1;
    return kind + " " + number;
  }
  async add(kind, given = "") {
    const name = given || this.freeName(kind), there = this.item(name);
    if (!there) await this.act({do: "add", name, kind});
    this.select(name);
    this.say(`${name}${there ? " is in the list already" : ""}: click it in either image`);
  }
  next(step) {
    if (!this.items.length) return;
    const at = this.items.findIndex((item) => item.name === this.selected);
    this.select(this.items[(at + step + this.items.length) % this.items.length].name);
  }

  // Place the selected item's mark: at the shape that is there, or exactly where it was said.
  async place(side, u, v, snapping = true) {
    if (!this.inside(side, u, v)) return;
    if (!this.item()) await this.add("target");
    const item = this.item();
    if (!item) return;
    const zoom = this.zoomed(side), frame = this.frameName();
    let {sigma, ...mark} = this.byHand(side, {u, v, frame}), words = "";
    if (snapping) {
      let found;
      try { found = await post("snap", {side, frame: this.frame, u, v}); } catch (error) {
        found = {refusal: error instanceof Refused ? error.message : AWAY};
      }
      if (found.refusal) words = `${found.refusal} (kept as clicked, σ ${sigma.toFixed(1)} px)`;
      else {
        mark = {...mark, u: found.u, v: found.v, cov: found.cov, how: found.how};
        sigma = found.sigma;
        words = `${item.name}, ${side}: ${found.how}, σ ${found.sigma.toFixed(3)} px`;
      }
      this.say(words);
    }
    this.side = side;
    this.proposals[side] = undefined;
    await this.act({do: "put", name: item.name, side, mark, zoom});
    await this.guide();
    const kept = this.item(item.name)?.[side];
    if (!kept || 1 / zoom <= this.about.hand_sigma || kept.sigma < 0.99 / zoom) return;
    const far = `${item.name}, ${side}: σ ${kept.sigma.toFixed(1)} px, one pixel of the screen at ${zoom.toFixed(2)}×. Press Z to see it closer, then S to snap it.`;
    this.say(this.proposals[other(side)] && !this.proposals[other(side)].refusal ? `${byId("status").textContent} ${far}` : far);
  }
  // Screen pixels per pixel of the image, and what a mark by hand is worth there: the server sees to the same.
  zoomed(side) { return this.views[side].scale / this.views[side].ratio; }
  byHand(side, at) {
    const sigma = Math.max(this.about.hand_sigma, 1 / this.zoomed(side));
    return {...at, cov: [sigma ** 2, 0, sigma ** 2], how: "hand", sigma};
  }
  nudge(du, dv) {
    const item = this.item(), mark = this.markOf(this.side);
    if (!item || !mark) { this.say("nothing is marked in this image to be moved"); return; }
    const {sigma, ...moved} = this.byHand(this.side, {u: mark.u + du, v: mark.v + dv, frame: mark.frame});
    if (!this.inside(this.side, moved.u, moved.v)) return;
    this.moved = true;
    item[this.side] = {...moved, sigma};
    this.act({do: "put", name: item.name, side: this.side, mark: moved, zoom: this.zoomed(this.side)});
    this.askCurve(this.side, moved.u, moved.v, this.key());
    this.draw();
  }
  snapAgain() { const mark = this.markOf(this.side); if (mark) this.place(this.side, mark.u, mark.v); }

  show(frame) {
    this.frame = Math.max(0, Math.min(frame, this.about.frames.length - 1));
    this.curves = {};
    this.proposals = {};
    byId("frame").value = this.frame;
    byId("frame-name").textContent = this.frameName();
    this.draw();
    this.guide();
  }

  handle(view) {
    const canvas = view.canvas, side = view.side;
    let start = null;
    canvas.addEventListener("focus", () => { this.side = side; this.draw(); });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(view, Math.exp(-event.deltaY * 0.002), ...view.at(event));
    }, {passive: false});
    canvas.addEventListener("pointerdown", (event) => {
      canvas.focus({preventScroll: true});
      canvas.setPointerCapture(event.pointerId);
      const [x, y] = view.at(event), mark = this.markOf(side);
      const near = (m) => { const [a, b] = view.screen(m.u, m.v); return Math.hypot(a - x, b - y) < 14 * view.ratio; };
      start = {x, y, center: [...view.center], others: this.centers(), moved: false, mark: mark && near(mark) ? mark : null};
      if (!start.mark) start.hit = this.items.find((item) => item[side] && near(item[side]));
    });
    canvas.addEventListener("pointermove", (event) => {
      const [x, y] = view.at(event);
      view.pointer = [x, y];
      const [u, v] = view.image(x, y);
      byId(side + "-place").textContent = `${u.toFixed(2)}, ${v.toFixed(2)}   ${(view.scale / view.ratio).toFixed(2)}×`;
      if (start && event.buttons) {
        if (Math.hypot(x - start.x, y - start.y) > 4 * view.ratio) start.moved = true;
        if (start.moved && start.mark) this.drag(side, start.mark, (x - start.x) / view.scale, (y - start.y) / view.scale);
        else if (start.moved) this.pan(view, start, (start.x - x) / view.scale, (start.y - y) / view.scale);
      }
      view.draw();
    });
    canvas.addEventListener("pointerup", (event) => {
      const begun = start;
      start = null;
      if (!begun || event.button !== 0) return;
      if (this.dragged) { this.drop(); return; }
      if (begun.moved) return;
      if (begun.hit) { this.select(begun.hit.name, false); return; }
      const item = this.item();
      if (begun.mark || (item && item[side])) { this.say(`${item.name} is marked in the ${side} image: drag it, or press N for another target`); return; }
      this.place(side, ...view.image(...view.at(event)), !event.shiftKey);
    });
    canvas.addEventListener("pointerleave", () => { view.pointer = null; view.draw(); });
  }
  centers() { return Object.fromEntries(SIDES.map((side) => [side, [...this.views[side].center]])); }
  pan(view, start, du, dv) {
    for (const side of this.linked ? SIDES : [view.side]) this.views[side].look(start.others[side][0] + du, start.others[side][1] + dv);
  }
  zoom(view, factor, x, y) {
    const before = [...view.center], scale = view.scale;
    view.zoom(factor, x, y);
    if (!this.linked) return;
    const far = this.views[other(view.side)];
    far.scale = view.scale * far.ratio / view.ratio;
    // Both keep what they show in their middle: the offset between them is that of the point looked at.
    const target = this.partner(view, x, y);
    if (target && factor > 1) { const [u, v] = view.image(x ?? view.canvas.width / 2, y ?? view.canvas.height / 2); far.look(target[0] + view.center[0] - u, target[1] + view.center[1] - v); }
    else far.look(far.center[0] + view.center[0] - before[0], far.center[1] + view.center[1] - before[1]);
    if (scale === view.scale) far.draw();
  }
  // Where the other image shows what is at this place: the selected item's mark or proposal, if the place is near it.
  partner(view, x, y) {
    const side = view.side, far = other(side), mark = this.markOf(side);
    if (x === undefined || !mark) return null;
    const [a, b] = view.screen(mark.u, mark.v);
    if (Math.hypot(a - x, b - y) > 60 * view.ratio) return null;
    const [u, v] = view.image(x, y), found = this.markOf(far) || this.proposals[far];
    return found && !found.refusal ? [found.u + u - mark.u, found.v + v - mark.v] : null;
  }
  closer() {
    const item = this.item();
    for (const side of SIDES) {
      const view = this.views[side], found = (item && item[side]) || this.proposals[side];
      if (found && !found.refusal) view.look(found.u, found.v, 20 * view.ratio);
      else if (this.curves[side]) { const line = this.curves[side].pixels; view.look(...line[Math.min(3, line.length - 1)], 20 * view.ratio); }
    }
  }
  drag(side, from, du, dv) {
    const item = this.item();
    this.dragged = {side, item, mark: this.byHand(side, {u: from.u + du, v: from.v + dv, frame: this.frameName()})};
    const far = item[other(side)];
    if (far) this.askPosition(...(side === "left" ? [this.dragged.mark, far] : [far, this.dragged.mark]), null);
    this.askCurve(side, this.dragged.mark.u, this.dragged.mark.v, this.key());
    this.draw();
  }
  drop() {
    const {side, item, mark} = this.dragged;
    this.dragged = null;
    if (!this.inside(side, mark.u, mark.v)) { this.draw(); drawPanel(this); return; }
    item[side] = mark;
    this.moved = true;
    const {sigma, ...put} = mark;
    this.act({do: "put", name: item.name, side, mark: put, zoom: this.zoomed(side)});
    this.guide();
  }

  toggle(name) {
    this[name] = !this[name];
    byId(name === "linked" ? "link" : "interpolate").setAttribute("aria-pressed", this[name]);
    this.draw();
  }
}

async function start() {
  const about = await get("about");
  const app = new App(about);
  window.kcal = app;
  listen(app);
  byId("frame").max = about.frames.length - 1;
  byId("time").hidden = about.frames.length < 2;
  byId("again").hidden = !about.reference.length;
  byId("frame-name").textContent = about.frames[0];
  app.take(await get("state"));
  if (!app.selected && app.items.length) app.select((app.items.find((item) => !item.left || !item.right) || app.items[0]).name);
  if (about.notes.length) app.say(about.notes.join("; "), true);
  else if (app.actions.waiting.length === 0 && !byId("status").textContent) app.say(about.cameras ? "Choose an item in the list, or press N for a new target; click it in one image. The key ? lists all keys." : "No cameras were given: marks are snapped and saved, but no geometry helps. Start with --rig or --cameras for it.");
}
start().catch((error) => {
  byId("status").textContent = error.message;
  byId("status").classList.add("bad");
});
