"use strict";
// What every map draws alike: names of dots, cameras with their fields of view, the coast, north, and where to look.

// What is taken of a picture of some pixels, so that names find room: boxes are [left, top, right, bottom].
function takenRoom(width, height) {
  const CELL = 4, columns = Math.ceil(width / CELL) + 1, rows = Math.ceil(height / CELL) + 1;
  const cells = new Uint8Array(columns * rows);
  const each = (box, told) => {
    for (let y = Math.max(0, Math.floor(box[1] / CELL)); y <= Math.min(rows - 1, Math.floor(box[3] / CELL)); y++) {
      for (let x = Math.max(0, Math.floor(box[0] / CELL)); x <= Math.min(columns - 1, Math.floor(box[2] / CELL)); x++) {
        if (told(y * columns + x)) return false;
      }
    }
    return true;
  };
  return {
    take: (box) => each(box, (cell) => { cells[cell] = 1; }),
    free: (box) => box[0] >= 0 && box[1] >= 0 && box[2] <= width && box[3] <= height && each(box, (cell) => cells[cell]),
  };
}

// The places around a dot in order, as offsets of the name's middle: right, left, above, below, and between.
function aroundDot(reach, width, height) {
  const x = reach + width / 2, y = reach + height / 2, half = width / 2;
  return [[x, 0], [-x, 0], [0, -y], [0, y], [half, -y], [half, y], [-half, -y], [-half, y]];
}

// Names beside the dots of a Leaflet map: none covers another name, a dot or a control. A name that finds no room waits
// until the map is zoomed in, or until its dot is pointed at or reached with the Tab key.
function mapLabels(map) {
  const MOST = 300; // names at once
  const dots = new Set(), labels = [];
  const radius = (shape) => shape.getRadius() + (shape.options.weight || 0) / 2;

  const reachable = (label) => {
    const element = label.shape.getElement();
    if (!element || !label.shape.options.interactive) return;
    element.setAttribute("tabindex", "0");
    element.setAttribute("role", label.shape.getPopup() ? "button" : "img");
    element.setAttribute("aria-label", label.text);
  };
  const asked = (label, on) => {
    label.asked = on;
    const element = label.shape.getTooltip() && label.shape.getTooltip().getElement();
    if (!element) return;
    element.classList.toggle("asked", on);
    element.style.visibility = on || label.room ? "" : "hidden";
  };

  // A dot that names stay clear of.
  function avoid(shape) { dots.add(shape); return shape; }

  // A dot with its name. Names of lower rank are placed first; `at` is the place around the dot that is tried first.
  function add(shape, text, rank, at = 0) {
    const label = {shape, text: null, rank, at, room: true, asked: false, words: document.createElement("span")};
    if (shape.getRadius() > 0) avoid(shape);
    shape.bindTooltip(label.words, {permanent: true, direction: "center", className: "name", opacity: 1});
    shape.on("add", () => reachable(label));
    shape.on("mouseover", () => asked(label, true)).on("mouseout", () => asked(label, false));
    const focus = (event) => asked(label, event.type === "focus");
    shape.on("add", () => {
      const element = shape.getElement();
      if (!element) return;
      element.addEventListener("focus", focus);
      element.addEventListener("blur", focus);
    });
    let before = labels.length;
    while (before > 0 && labels[before - 1].rank > rank) before--;
    labels.splice(before, 0, label);
    rename(label, text);
    return label;
  }

  function rename(label, text) {
    if (label.text === text) return;
    label.text = text;
    label.words.textContent = text;
    label.size = null;
    reachable(label);
  }

  function remove(label) {
    dots.delete(label.shape);
    labels.splice(labels.indexOf(label), 1);
    label.shape.remove();
  }

  function place() {
    const size = map.getSize(), ground = map.getContainer().getBoundingClientRect();
    const {take, free} = takenRoom(size.x, size.y);
    for (const control of map.getContainer().querySelectorAll(".leaflet-control")) {
      const box = control.getBoundingClientRect();
      take([box.left - ground.left, box.top - ground.top, box.right - ground.left, box.bottom - ground.top]);
    }
    for (const shape of dots) {
      if (!map.hasLayer(shape)) continue;
      const {x, y} = map.latLngToContainerPoint(shape.getLatLng()), r = radius(shape);
      take([x - r, y - r, x + r, y + r]);
    }
    const elements = labels.map((label) => (map.hasLayer(label.shape) ? label.shape.getTooltip().getElement() : null));
    // All that is read first, then all that is written: the browser lays the page out once.
    labels.forEach((label, i) => {
      const element = elements[i];
      if (element && !label.size && element.style.display !== "none") label.size = [element.offsetWidth, element.offsetHeight];
    });
    let named = 0;
    labels.forEach((label, i) => {
      const element = elements[i];
      if (!element || element.style.display === "none") return;
      const spot = map.latLngToContainerPoint(label.shape.getLatLng()), [width, height] = label.size;
      const offsets = aroundDot(radius(label.shape) + 5, width, height);
      const box = ([x, y]) => [spot.x + x - width / 2, spot.y + y - height / 2, spot.x + x + width / 2, spot.y + y + height / 2];
      // Where it was before, if there still is room: names do not jump.
      const order = [label.at, ...offsets.keys()];
      const found = named < MOST ? order.find((k) => free(box(offsets[k]))) : undefined;
      label.room = found !== undefined;
      if (label.room) { named++; label.at = found; take(box(offsets[found])); }
      const tooltip = label.shape.getTooltip(), [x, y] = offsets[label.at];
      tooltip.options.offset = L.point(x, y);
      tooltip.update();
      element.style.visibility = label.room || label.asked ? "" : "hidden";
    });
  }

  let waiting = false;
  map.on("zoomend moveend resize layeradd layerremove", () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; place(); });
  });
  return {add, avoid, rename, remove, place};
}

// The cameras, and the part of the ground that each sees, where that is known.
function drawCameras(cameras, labels, fields, dots) {
  const colors = ["#2b6cb0", "#dd7a1f"]; // those of kcal.report.figures
  cameras.forEach((camera, i) => {
    const color = colors[i % colors.length], others = cameras.filter((other) => other !== camera);
    if (camera.field) {
      L.polygon(camera.field, {color, weight: 1, opacity: 0.7, fillOpacity: 0.06, smoothFactor: 0.2, interactive: false}).addTo(fields);
    }
    const dot = L.circleMarker(camera.place, {radius: 6, color: "#fff", weight: 1.5, fillColor: color, fillOpacity: 1});
    // Cameras are close to each other: their names go outward.
    labels.add(dot, camera.name, 1, others.some((other) => other.place[1] > camera.place[1]) ? 1 : 0);
    dot.addTo(dots);
  });
}

// An arrow to the north: up, on these maps.
function addNorth(map) {
  const North = L.Control.extend({onAdd: () => {
    const box = L.DomUtil.create("div", "north"), name = "http://www.w3.org/2000/svg";
    const node = (parent, kind, attributes) => {
      const made = parent.appendChild(document.createElementNS(name, kind));
      for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
      return made;
    };
    const drawn = node(box, "svg", {viewBox: "0 0 20 40", width: 20, height: 40, role: "img", "aria-label": "North is up"});
    node(drawn, "polygon", {points: "10,0 16,20 10,16 4,20", fill: "#374151"});
    node(drawn, "text", {x: 10, y: 36, "text-anchor": "middle"}).textContent = "N";
    return box;
  }});
  new North({position: "topleft"}).addTo(map);
}

// Coastlines, which are some 2 km off: shown while that is less than a fifth of the map's width.
function drawCoast(map, lines, layer) {
  if (!lines.length) return;
  const coast = L.polyline(lines, {color: "#4a7a96", weight: 1.2, smoothFactor: 0.5, interactive: false, attribution: "coast: Natural Earth ± 2 km"}).addTo(layer);
  const judge = () => {
    const size = map.getSize(), wide = map.containerPointToLatLng([0, size.y / 2]).distanceTo(map.containerPointToLatLng([size.x, size.y / 2]));
    coast.setStyle({opacity: wide > 10000 ? 0.9 : 0});
  };
  map.on("zoomend resize", judge);
  map.whenReady(judge);
}

// Show all of some bounds beside the controls, or below and above them, whichever shows it larger.
function fitClear(map, bounds, options = {}) {
  const size = map.getSize(), free = 24;
  const across = (corner) => Math.max(0, ...[...map.getContainer().querySelectorAll(corner + " .leaflet-control")].map((e) => e.offsetWidth));
  const down = (corner) => map.getContainer().querySelector(corner).offsetHeight;
  const [left, right] = [".leaflet-top.leaflet-left", ".leaflet-top.leaflet-right"].map((corner) => (across(corner) ? across(corner) + 10 : 0) + free);
  const top = Math.max(down(".leaflet-top.leaflet-left"), down(".leaflet-top.leaflet-right")) + free;
  const bottom = Math.max(down(".leaflet-bottom.leaflet-left"), down(".leaflet-bottom.leaflet-right")) + free;
  const zoom = (x, y) => (x < size.x && y < size.y ? map.getBoundsZoom(bounds, false, L.point(x, y)) : -1);
  const beside = zoom(left + right, free + bottom) >= zoom(2 * free, top + bottom);
  map.fitBounds(bounds, {...options, paddingTopLeft: beside ? [left, free] : [free, top], paddingBottomRight: [beside ? right : free, bottom]});
}
