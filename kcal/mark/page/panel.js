// The list of items, what the selected one is worth, and what the rig promises.
const byId = (id) => document.getElementById(id);
const SIGNS = {landmark: "■", target: "●", feature: "▲"};
const meters = (value) => (value < 10 ? value.toFixed(2) : value < 100 ? value.toFixed(1) : value.toFixed(0)) + " m";

function cell(row, text, kind) {
  const td = row.insertCell();
  td.textContent = text;
  td.title = text;
  if (kind) td.className = kind;
}
const sigma = (mark) => (mark ? mark.sigma.toFixed(2) : "–");

function worth(item) {
  if (item.residual) {
    const pixels = item.residual.pixels.filter((value) => value !== null);
    const px = pixels.length ? Math.max(...pixels).toFixed(2) + " px" : "";
    return (item.residual.used ? "" : "⚠ wrong? ") + px;
  }
  if (item.position) return item.position.text;
  return item.kind === "landmark" && !item.surveyed ? "not surveyed" : "";
}

export function drawTable(app) {
  const body = byId("rows");
  const focused = body.contains(document.activeElement);
  body.textContent = "";
  for (const item of app.items) {
    const row = body.insertRow(), chosen = item.name === app.selected;
    row.setAttribute("aria-selected", chosen);
    row.tabIndex = chosen || (!app.selected && item === app.items[0]) ? 0 : -1;
    if (item.residual && !item.residual.used) row.className = "wrong";
    cell(row, `${SIGNS[item.kind]} ${item.name}`, item.kind);
    cell(row, sigma(item.left));
    cell(row, sigma(item.right));
    cell(row, worth(item));
    row.addEventListener("click", () => app.select(item.name));
    if (!chosen) continue;
    // Only the list scrolls: the pictures stay where they are.
    const list = byId("things"), head = body.parentElement.tHead.offsetHeight;
    list.scrollTop = Math.min(row.offsetTop - head, Math.max(list.scrollTop, row.offsetTop + row.offsetHeight - list.clientHeight));
    if (focused) row.focus({preventScroll: true});
  }
}

export function drawPanel(app) {
  const item = app.item(), out = byId("worth");
  byId("edit").hidden = !item || (item.surveyed && item.kind === "landmark");
  byId("survey").hidden = !item || item.surveyed || item.kind === "target";
  byId("marks").hidden = !item;
  for (const side of ["left", "right"]) byId("take-" + side).disabled = !item || !item[side];
  out.textContent = "";
  const line = (text) => { const p = document.createElement("div"); p.textContent = text; out.append(p); };
  if (!item) line("Nothing is selected.");
  else {
    if (document.activeElement !== byId("edit-name")) byId("edit-name").value = item.name;
    byId("survey-place").placeholder = `${app.about.columns.join(", ")}, sigma (m)`;
    const how = (mark) => (mark ? `${mark.how} σ ${mark.sigma.toFixed(3)}` : "no mark");
    line(`${item.name} (${item.kind}): left ${how(item.left)}, right ${how(item.right)}`);
    if (item.position) {
      line(item.position.refusal || item.position.text);
      if (item.position.place) line(item.position.place);
      if (item.position.reason) line(item.position.reason);
    }
    if (item.residual) {
      const both = item.residual.pixels.map((value) => (value === null ? "–" : value.toFixed(2))).join(", ");
      line(`residual ${both} px${item.residual.meters === null ? "" : ", survey " + meters(item.residual.meters)}${item.residual.sigmas === null ? "" : ", " + item.residual.sigmas.toFixed(1) + " σ"}`);
      if (item.residual.reason) line("⚠ " + item.residual.reason);
    }
  }
  const rig = app.rig, box = byId("rig");
  box.classList.toggle("enough", rig.enough);
  const known = rig.text || (rig.known ? "the given rig is used" : "");
  byId("rig-text").textContent = app.pending ? `solving the rig … ${known}` : known;
  byId("rig-text").title = rig.warnings.join("; ");
  const table = byId("promises");
  table.textContent = "";
  if (rig.promises.length) {
    const head = table.insertRow();
    for (const text of ["σ of a range at", "marks", "rig", "total"]) { const th = document.createElement("th"); th.textContent = text; head.append(th); }
    for (const promise of rig.promises) {
      const row = table.insertRow();
      for (const text of [promise.distance < 1000 ? `${promise.distance} m` : `${promise.distance / 1000} km`, meters(promise.marks), promise.rig === null ? "not known" : meters(promise.rig), (promise.rig === null ? "at least " : "") + meters(promise.total)]) cell(row, text);
    }
  }
  drawHistory(rig.history);
}

// The total sigma at 1 km by the number of landmarks, on a logarithmic axis.
function drawHistory(history) {
  const svg = byId("history");
  svg.textContent = "";
  const points = history.filter((entry) => entry.promises.length > 1).map((entry) => [entry.count, entry.promises[1].total]);
  svg.style.display = points.length > 1 ? "" : "none";
  if (points.length < 2) return;
  const add = (name, attributes, text) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text) element.textContent = text;
    svg.append(element);
  };
  const first = points[0][0], last = Math.max(points[points.length - 1][0], first + 1);
  const logs = points.map((point) => Math.log10(point[1])), low = Math.min(...logs) - 0.1, high = Math.max(...logs) + 0.1;
  const at = ([count], i) => [30 + 250 * (count - first) / (last - first), 54 - 32 * (logs[i] - low) / (high - low)];
  const spots = points.map(at);
  add("polyline", {points: spots.map((spot) => spot.join(",")).join(" "), fill: "none", stroke: "#0072b2", "stroke-width": 2});
  spots.forEach(([x, y], i) => {
    add("circle", {cx: x, cy: y, r: 2.5, fill: "#0072b2"});
    if (i === 0 || i === points.length - 1) add("text", {x: x - 8, y: y - 6}, meters(points[i][1]));
    add("text", {x: x - 3, y: 66}, String(points[i][0]));
  });
  add("text", {x: 2, y: 9}, "σ at 1 km by number of landmarks");
}
