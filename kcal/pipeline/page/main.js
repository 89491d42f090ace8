"use strict";
(function () {
  const map = L.map("map", {maxZoom: 22, zoomSnap: 0.25});
  map.attributionControl.setPrefix("kcal, Leaflet");
  L.control.scale({imperial: false, maxWidth: 200}).addTo(map);
  const status = document.getElementById("status");
  const shown = new Map();
  const MOST = 300; // points of a trail
  let placed = false;
  // Leaflet takes texts as HTML; a node with a text is shown as it is.
  const text = (value) => { const s = document.createElement("span"); s.textContent = value; return s; };
  const source = new EventSource("/events" + location.hash.replace("#", "?token="));
  source.onerror = () => { status.textContent = "connection lost; trying again"; };
  source.addEventListener("site", (event) => {
    for (const camera of JSON.parse(event.data).cameras) {
      L.circleMarker(camera.place, {radius: 6, color: "#fff", weight: 1.5, fillColor: "#1d4ed8", fillOpacity: 1})
        .bindTooltip(() => text(camera.name)).addTo(map);
      if (!placed) map.setView(camera.place, 14);
      placed = true;
    }
  });
  source.addEventListener("tracks", (event) => {
    const told = JSON.parse(event.data);
    const now = new Set();
    for (const track of told.tracks) {
      now.add(track.name);
      let one = shown.get(track.name);
      if (!one) {
        one = {
          dot: L.circleMarker(track.place, {radius: 5, color: "#111827", weight: 2, fillColor: "#fff", fillOpacity: 1}),
          circle: L.circle(track.place, {radius: 0, color: "#111827", weight: 1, fillOpacity: 0.1, interactive: false}),
          trail: L.polyline([], {color: "#c02a6b", weight: 1.5, interactive: false}),
        };
        Object.values(one).forEach((shape) => shape.addTo(map));
        one.dot.bindTooltip(text(track.name), {permanent: true, direction: "right"});
        shown.set(track.name, one);
      }
      one.dot.setLatLng(track.place);
      one.circle.setLatLng(track.place);
      one.circle.setRadius(track.radius);
      one.trail.addLatLng(track.place);
      if (one.trail.getLatLngs().length > MOST) one.trail.setLatLngs(one.trail.getLatLngs().slice(-MOST));
      one.dot.setTooltipContent(text(track.name + ", " + track.text));
    }
    for (const [name, one] of shown) {
      if (now.has(name)) continue;
      Object.values(one).forEach((shape) => shape.remove());
      shown.delete(name);
    }
    status.textContent = told.tracks.length + (told.tracks.length === 1 ? " track" : " tracks") + ", moment " + told.sequence;
    document.documentElement.dataset.sequence = told.sequence;
  });
})();
