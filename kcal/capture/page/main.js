// Asks the server what was found, and draws it: the frame with the board, and the view to take next as an outline.
const stored = sessionStorage.getItem("kcal-token");
const token = location.hash.length > 1 ? location.hash.slice(1) : stored;
if (location.hash.length > 1) {
  sessionStorage.setItem("kcal-token", token);
  history.replaceState(null, "", location.pathname);
}
const byId = (id) => document.getElementById(id);
const ask = (name, method = "GET") => fetch("/api/" + name, {method, headers: {"X-Kcal-Token": token}});
const NEXT = "#e69f00", SEEN = "#009e73", KEPT = "#0072b2";

function svg(into, name, attributes, text) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  into.append(made);
}

function drawView(state, frame) {
  const canvas = byId("view"), [width, height] = state.size;
  if (!width) return;
  const scale = frame ? frame.width / width : Math.min(1, 1280 / width);
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const pen = canvas.getContext("2d");
  if (frame) pen.drawImage(frame, 0, 0);
  else { pen.fillStyle = "#2b2f36"; pen.fillRect(0, 0, canvas.width, canvas.height); }
  const at = ([u, v]) => [(u + 0.5) * scale, (v + 0.5) * scale];
  pen.fillStyle = SEEN;
  for (const corner of state.corners) { const [x, y] = at(corner); pen.beginPath(); pen.arc(x, y, 3.5, 0, 7); pen.fill(); }
  if (state.next && !state.finished) {
    // White below the color: it shows on dark and on bright.
    for (const [color, line] of [["#ffffffb0", 8], [NEXT, 4]]) {
      pen.strokeStyle = color;
      pen.lineWidth = line;
      pen.beginPath();
      state.next.outline.forEach((corner, i) => (i ? pen.lineTo(...at(corner)) : pen.moveTo(...at(corner))));
      pen.closePath();
      pen.stroke();
    }
    pen.fillStyle = NEXT;
    for (const corner of state.next.first) { const [x, y] = at(corner); pen.beginPath(); pen.arc(x, y, 10, 0, 7); pen.fill(); }
  }
}

function drawHistory(state) {
  const out = byId("history");
  out.textContent = "";
  const all = state.history;
  if (!all.length) return;
  const views = all.map((p) => p[0]), most = Math.max(...views, 10), least = Math.min(...views);
  const values = [...all.map((p) => p[1]), state.until], low = Math.log(Math.min(...values)) - 0.15, high = Math.log(Math.max(...values)) + 0.15;
  const x = (n) => 8 + ((n - least) / Math.max(1, most - least)) * 260, y = (v) => 94 - ((Math.log(v) - low) / (high - low)) * 84;
  svg(out, "line", {x1: 8, x2: 268, y1: y(state.until), y2: y(state.until), stroke: "#b3400a", "stroke-dasharray": "4 3"});
  svg(out, "text", {x: 272, y: y(state.until) + 4}, "goal");
  svg(out, "polyline", {points: all.map(([n, v]) => `${x(n)},${y(v)}`).join(" "), fill: "none", stroke: KEPT, "stroke-width": 2});
  for (const [n, v] of all) svg(out, "circle", {cx: x(n), cy: y(v), r: 3, fill: KEPT});
  svg(out, "text", {x: 8, y: 108}, `${least} views`);
  svg(out, "text", {x: 232, y: 108}, `${most}`);
}

function drawWhere(state) {
  const out = byId("where"), [width, height] = state.size;
  out.textContent = "";
  if (!width) return;
  out.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const points = (outline) => outline.map((corner) => corner.join(",")).join(" "), line = width / 160;
  for (const outline of state.outlines) svg(out, "polygon", {points: points(outline), fill: KEPT, "fill-opacity": 0.18, stroke: KEPT, "stroke-width": line});
  if (state.next && !state.finished) svg(out, "polygon", {points: points(state.next.outline), fill: "none", stroke: NEXT, "stroke-width": 2 * line});
}

function drawHolds(state) {
  const out = byId("holds");
  out.textContent = "";
  for (const [sine, text] of [[0.5, "30°"], [0.866, "60°"]]) {
    svg(out, "circle", {cx: 0, cy: 0, r: 48 * sine, fill: "none", stroke: "#c3c8d0"});
    svg(out, "text", {x: 2, y: -48 * sine - 1}, text);
  }
  for (const [x, y, roll] of state.holds) {
    const turn = (roll * Math.PI) / 180, px = 48 * x, py = 48 * y;
    svg(out, "circle", {cx: px, cy: py, r: 2.5, fill: KEPT});
    svg(out, "line", {x1: px, y1: py, x2: px + 8 * Math.cos(turn), y2: py + 8 * Math.sin(turn), stroke: KEPT, "stroke-width": 1.5});
  }
}

function show(state, frame) {
  byId("count").textContent = `${state.views} of at most ${state.most} views`;
  byId("message").textContent = state.message;
  const words = byId("words");
  words.textContent = state.finished || (state.next ? state.next.words[0].toUpperCase() + state.next.words.slice(1) : "Show the board to the camera.");
  if (!state.finished && state.next) {
    const more = document.createElement("small");
    more.textContent = "Match the orange outline; the dot is the board's first corner." + (state.next.sigma ? ` Expected then: ± ${state.next.sigma.toFixed(3)} px.` : "");
    words.append(more);
  }
  document.querySelector("#next h2").textContent = state.finished ? "Finished" : "Photograph next";
  document.body.classList.toggle("done", Boolean(state.finished));
  const last = state.history[state.history.length - 1];
  byId("sigma").textContent = last ? `± ${last[1].toFixed(3)} px, goal ± ${state.until} px` : "known after four views";
  const list = byId("warnings");
  list.textContent = "";
  for (const text of state.warnings) { const item = document.createElement("li"); item.textContent = text; list.append(item); }
  drawView(state, frame);
  drawHistory(state);
  drawWhere(state);
  drawHolds(state);
  document.documentElement.dataset.views = state.views;
}

byId("stop").addEventListener("click", () => ask("stop", "POST"));
for (let going = true; going; ) {
  try {
    const state = await (await ask("state")).json();
    if (state.error) throw new Error(state.error);
    const picture = await ask("picture");
    show(state, picture.status === 200 ? await createImageBitmap(await picture.blob()) : null);
    going = !(state.stopped || state.finished);
    if (!going) { byId("message").textContent = state.finished ? "finished: see the terminal" : "stopped: everything kept is on the disk"; byId("stop").disabled = true; }
  } catch (error) {
    byId("message").textContent = error instanceof TypeError ? "kcal capture has ended" : error.message;
  }
  await new Promise((done) => setTimeout(done, 250));
}
