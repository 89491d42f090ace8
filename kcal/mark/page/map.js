// The map, offline: cameras, landmarks, targets with their 95 % regions. Its selection is the page's.
import {get} from "/page/api.js";
import {latest} from "/page/api.js";

let map = null, layer = null, labels = null, named = [], fitted = "";

function build() {
  map = L.map("map", {zoomSnap: 0.25, maxZoom: 22, zoomControl: false, keyboard: false, fadeAnimation: false});
  map.attributionControl.setPrefix("Leaflet");
  L.control.scale({imperial: false}).addTo(map);
  layer = L.layerGroup().addTo(map);
  labels = mapLabels(map);
  map.setView([0, 0], 2);
}

export const drawMap = latest(async (app) => {
  if (!map) build();
  const data = await get("map");
  named.forEach(labels.remove);
  named = [];
  layer.clearLayers();
  const spots = [];
  if (data.refusal) return;
  const wrong = new Set(app.items.filter((item) => item.residual && !item.residual.used).map((item) => item.name));
  // Where there is no room for all names: what is selected, what is wrong, targets, landmarks, cameras.
  const dot = (name, place, color, sign, rank) => {
    spots.push(place);
    const chosen = name === app.selected;
    const shape = L.circleMarker(place, {radius: chosen ? 8 : 5, color: chosen ? "#000" : "#fff", weight: chosen ? 3 : 1, fillColor: wrong.has(name) ? "#d55e00" : color, fillOpacity: 1});
    named.push(labels.add(shape, (wrong.has(name) ? "⚠ " : sign) + name, chosen ? 0 : wrong.has(name) ? 1 : rank));
    shape.addTo(layer);
    shape.on("click", () => app.select(name));
  };
  for (const camera of data.cameras) {
    spots.push(camera.place);
    const shape = L.circleMarker(camera.place, {radius: 4, color: "#fff", weight: 1, fillColor: "#000", fillOpacity: 1});
    named.push(labels.add(shape, camera.name, 4));
    shape.addTo(layer);
  }
  for (const item of data.landmarks) dot(item.name, item.place, "#0072b2", "■ ", 3);
  for (const item of data.targets) {
    L.polyline(item.line, {color: "#a15c00", weight: item.name === app.selected ? 4 : 2, opacity: 0.8}).addTo(layer);
    if (item.ring) L.polygon(item.ring, {color: "#111827", weight: 1, fillOpacity: 0.15, interactive: false}).addTo(layer);
    if (item.place) dot(item.name, item.place, "#e69f00", "● ", 2);
  }
  // The list selects by keyboard what the map selects by pointer.
  layer.eachLayer((shape) => shape.getElement()?.setAttribute("tabindex", "-1"));
  const key = spots.map((spot) => spot.map((v) => v.toFixed(4)).join()).join(" ");
  if (spots.length > 2 && key !== fitted) {
    fitted = key;
    map.fitBounds(spots, {padding: [24, 24], maxZoom: 19, animate: false});
  }
  labels.place();
});
