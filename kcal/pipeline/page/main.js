"use strict";
(function () {
  const map = L.map("map", {maxZoom: 22, zoomSnap: 0.25});
  map.attributionControl.setPrefix("kcal, Leaflet");
  L.control.scale({imperial: false, maxWidth: 140}).addTo(map);
  const [fields, cameras, regions, trails] = [0, 1, 2, 3].map(() => L.layerGroup().addTo(map));
  addNorth(map);
  const labels = mapLabels(map);
  const status = document.getElementById("status"), count = document.getElementById("count"), clock = document.getElementById("clock");
  const shown = new Map(), ended = [];
  const MOST = 300, KEPT = 60; // points of a trail; seconds for which it stays once its target is lost
  let before = {};
  let places = [], own = true, touched = false;

  const say = (words, lost) => {
    status.textContent = words;
    document.documentElement.classList.toggle("lost", lost);
  };
  const counted = (number, word) => number + " " + word + (number === 1 ? "" : "s");
  // Until the reader moves the map, it keeps all targets in view.
  map.on("movestart", () => { touched = touched || !own; });
  const look = (spots) => {
    own = true;
    fitClear(map, L.latLngBounds(spots).pad(0.05), {maxZoom: 18, animate: false});
    own = false;
  };

  const source = new EventSource("/events" + location.hash.replace("#", "?token="));
  source.onopen = () => say("running", false);
  source.onerror = () => {
    say(source.readyState === EventSource.CLOSED ? "not connected: open the address that kcal live printed last" : "connection lost; trying again", true);
  };
  source.addEventListener("end", (event) => {
    // Otherwise the browser would ask again, and take the end for a failure.
    source.close();
    say(JSON.parse(event.data).words, false);
  });
  source.addEventListener("site", (event) => {
    const site = JSON.parse(event.data);
    // After a lost connection it comes again.
    if (places.length) return;
    places = site.cameras.map((camera) => camera.place);
    look(places.concat(L.latLng(places[0]).toBounds(600).getNorthEast(), L.latLng(places[0]).toBounds(600).getSouthWest()));
    drawCoast(map, site.coast, fields);
    drawCameras(site.cameras, labels, fields, cameras);
  });
  // Where targets have been before this page was opened.
  source.addEventListener("trails", (event) => { before = JSON.parse(event.data); });
  source.addEventListener("tracks", (event) => {
    const told = JSON.parse(event.data);
    const now = new Set();
    for (const track of told.tracks) {
      now.add(track.name);
      let one = shown.get(track.name);
      if (!one) {
        one = {
          region: L.polygon(track.region, {color: "#111827", weight: 1.5, fillOpacity: 0.15, smoothFactor: 0.2, interactive: false}).addTo(regions),
          trail: L.polyline(before[track.name] || [], {color: "#c02a6b", weight: 2.5, opacity: 0.8, interactive: false}).addTo(trails),
          dot: L.circleMarker(track.place, {radius: 5, color: "#111827", weight: 2, fillColor: "#fff", fillOpacity: 1}),
        };
        one.label = labels.add(one.dot, track.text, 0);
        one.dot.addTo(map);
        shown.set(track.name, one);
      }
      one.dot.setLatLng(track.place);
      one.region.setLatLngs(track.region);
      one.trail.addLatLng(track.place);
      if (one.trail.getLatLngs().length > MOST) one.trail.setLatLngs(one.trail.getLatLngs().slice(-MOST));
      labels.rename(one.label, track.text);
    }
    for (const [name, one] of shown) {
      if (now.has(name)) continue;
      labels.remove(one.label);
      one.region.remove();
      one.trail.setStyle({opacity: 0.35});
      ended.push({trail: one.trail, time: told.time});
      shown.delete(name);
    }
    while (ended.length && !(told.time - ended[0].time >= 0 && told.time - ended[0].time < KEPT)) ended.shift().trail.remove();
    const spots = told.tracks.map((track) => track.place);
    if (!touched && spots.some((spot) => !map.getBounds().contains(spot))) look(places.concat(spots));
    labels.place();
    count.textContent = counted(told.tracks.length, "target");
    clock.textContent = told.clock;
    document.documentElement.dataset.sequence = told.sequence;
  });
})();
