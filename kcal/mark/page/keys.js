// The keyboard and the buttons.
import {stretchContrast} from "/page/tiles.js";

const KEYS = [
  ["N", "new target: type its name"], ["F", "new static feature"], ["[ ]", "previous, next item"], ["Space", "mark at the middle of the image in focus"],
  ["Arrows", "move the mark by 0.1 px"], ["Shift+arrows", "move it by 1 px"], ["Alt+arrows", "move the image"],
  ["S", "snap the mark again"], ["Enter", "accept the proposal"], ["R", "reject it"], ["Delete", "remove the mark in this image"],
  ["X", "other image"], ["+ −", "zoom"], ["0", "whole image"], ["Z", "20× at the selected item"], ["I", "×10 interpolated or raw pixels"],
  ["C", "stretch contrast to what is shown"], ["K", "linked zoom"], ["U, Ctrl+Z", "undo"], ["Ctrl+Y", "redo"], [", .", "previous, next frame"],
  ["A", "find the points of the reference again"], ["Shift+click", "mark exactly there, without snapping"], ["?", "this list"],
];
const byId = (id) => document.getElementById(id);

export function listen(app) {
  const view = () => app.views[app.side];
  const step = (event) => (event.shiftKey ? 1 : 0.1);
  const moves = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};
  const again = () => { const name = app.about.reference.find((n) => { const item = app.item(n); return !item || !item.left || !item.right; }); if (name) app.again(name); else app.say("all points of the reference are marked"); };
  const remove = async (side = app.side) => {
    const item = app.item();
    if (!item || !item[side]) return;
    await app.act({do: "take", name: item.name, side});
    app.guide();
  };
  const fit = () => { app.views.left.fit(); app.views.right.fit(); };
  let kind = "target";
  const ask = (what) => {
    kind = what;
    byId("naming-title").textContent = "New " + (kind === "target" ? "target" : "static feature");
    byId("new-name").value = "";
    byId("new-name").placeholder = app.freeName(kind);
    byId("naming").showModal();
    byId("new-name").focus();
  };
  const commands = {
    n: () => ask("target"), f: () => ask("feature"), "[": () => app.next(-1), "]": () => app.next(1),
    s: () => app.snapAgain(), Enter: () => app.accept(), r: () => app.reject(), Delete: () => remove(), Backspace: () => remove(),
    x: () => app.views[app.side === "left" ? "right" : "left"].canvas.focus(), "+": () => app.zoom(view(), 1.5), "=": () => app.zoom(view(), 1.5),
    "-": () => app.zoom(view(), 1 / 1.5), 0: fit, z: () => app.closer(), i: () => app.toggle("interpolated"), c: () => stretchContrast(app),
    k: () => app.toggle("linked"), u: () => app.act({do: "undo"}), ",": () => app.show(app.frame - 1), ".": () => app.show(app.frame + 1),
    a: again, "?": () => byId("keys").showModal(), " ": () => app.place(app.side, ...view().center),
  };
  document.addEventListener("keydown", (event) => {
    if (event.target.matches("input, dialog *, dialog")) return;
    if (event.target.matches("button") && (event.key === "Enter" || event.key === " ")) return;
    app.byKeyboard = true;
    const move = moves[event.key];
    let run = null;
    if (move && event.target.matches("tbody *")) run = () => app.next(move[1] || move[0]);
    else if (move && event.altKey) run = () => app.pan(view(), {others: app.centers()}, move[0] * 40 / view().scale, move[1] * 40 / view().scale);
    else if (move) run = () => app.nudge(move[0] * step(event), move[1] * step(event));
    else if (event.ctrlKey || event.metaKey) run = {z: () => app.act({do: event.shiftKey ? "redo" : "undo"}), y: () => app.act({do: "redo"})}[event.key.toLowerCase()];
    else run = commands[event.key] || commands[event.key.toLowerCase()];
    if (!run) return;
    event.preventDefault();
    run();
  });
  document.addEventListener("pointerdown", () => { app.byKeyboard = false; });
  const press = {"new-target": commands.n, "new-feature": commands.f, undo: commands.u, redo: () => app.act({do: "redo"}), fit, nearer: commands["+"], farther: commands["-"], accept: commands.Enter, reject: commands.r, interpolate: commands.i,
    contrast: commands.c, link: commands.k, again, "take-left": () => remove("left"), "take-right": () => remove("right"), "no-name": () => byId("naming").close(), "show-keys": commands["?"], drop: () => app.selected && app.act({do: "drop", name: app.selected})};
  for (const [id, run] of Object.entries(press)) byId(id).addEventListener("click", run);
  byId("frame").addEventListener("input", (event) => app.show(Number(event.target.value)));
  byId("name-form").addEventListener("submit", (event) => {
    event.preventDefault();
    byId("naming").close();
    app.add(kind, byId("new-name").value.trim());
  });
  byId("edit").addEventListener("submit", async (event) => {
    event.preventDefault();
    const item = app.item(), to = byId("edit-name").value.trim();
    if (!item || !to || to === item.name) return;
    await app.act({do: "rename", name: item.name, to, kind: item.kind});
    app.select(to, false);
  });
  byId("survey").addEventListener("submit", (event) => {
    event.preventDefault();
    const numbers = byId("survey-place").value.split(",").map((text) => Number(text.trim()));
    if (numbers.length !== 4 || !numbers.every(Number.isFinite)) { app.say(`write four numbers: ${app.about.columns.join(", ")}, sigma in meters`, true); return; }
    app.act({do: "survey", name: app.selected, place: {at: numbers.slice(0, 3), sigma: numbers[3]}});
  });
  const list = byId("key-list");
  for (const [key, what] of KEYS) {
    const line = document.createElement("p"), name = document.createElement("kbd");
    name.textContent = key;
    line.append(name, " " + what);
    list.append(line);
  }
}
