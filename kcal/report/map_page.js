"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const map = L.map("map", {preferCanvas: false, maxZoom: 22, zoomSnap: 0.25, worldCopyJump: false});
  map.attributionControl.setPrefix("kcal, Leaflet");
  L.control.scale({imperial: false, maxWidth: 140}).addTo(map);
  const text = (value) => document.createTextNode(value);
  // Leaflet takes attributions as HTML: this is the HTML that shows a text.
  const attribution = (value) => { const s = document.createElement("span"); s.append(text(value)); return s.innerHTML; };
  const node = (parent, name, attributes) => {
    const made = parent.appendChild(document.createElementNS("http://www.w3.org/2000/svg", name));
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  };
  addNorth(map);
  const head = (azimuth) => {
    const box = document.createElement("div");
    node(node(box, "svg", {viewBox: "-6 -6 12 12"}), "path",
      {d: "M0,0 L-4,6 L4,6 Z", fill: "#c02a6b", transform: "rotate(" + Number(azimuth) + ")"});
    return box;
  };
  const overlays = {};
  const layer = (name) => overlays[name] || (overlays[name] = L.layerGroup().addTo(map));
  const labels = mapLabels(map);

  if (data.image) {
    L.imageOverlay(data.image.uri, data.image.bounds, {attribution: attribution(data.image.name)}).addTo(map);
  }
  if (data.tiles) {
    const Local = L.GridLayer.extend({createTile: function (at) {
      const tile = document.createElement("img");
      const uri = data.tiles.images[at.z + "/" + at.x + "/" + at.y];
      if (uri) tile.src = uri;
      return tile;
    }});
    new Local({minNativeZoom: data.tiles.zooms[0], maxNativeZoom: data.tiles.zooms[1], attribution: attribution(data.tiles.name)}).addTo(map);
  }
  if (data.online) {
    L.tileLayer(data.online.url, {maxNativeZoom: 19, attribution: attribution(data.online.attribution)}).addTo(map);
  }
  // What would only clutter at this zoom: [marker, end, end, least distance in pixels].
  const small = [];
  const tidy = () => {
    for (const [shape, from, to, least] of small) {
      const far = map.latLngToContainerPoint(from).distanceTo(map.latLngToContainerPoint(to)) >= least;
      const element = shape.getElement && shape.getElement();
      if (element) element.style.display = far ? "" : "none";
      const tip = shape.getTooltip();
      if (tip && tip.getElement()) tip.getElement().style.display = far ? "" : "none";
    }
  };
  if (data.coast.length) drawCoast(map, data.coast, layer("coastline"));
  drawCameras(data.cameras, labels, layer("fields of view"), layer("cameras"));
  for (const arc of data.arcs) {
    L.polyline(arc.line, {color: "#4b5563", weight: 1, dashArray: "5 4", smoothFactor: 0.2, interactive: false}).addTo(layer("range arcs"));
    const end = L.circleMarker(arc.line[arc.line.length - 1], {radius: 0, weight: 0, opacity: 0, interactive: false});
    labels.add(end, arc.name, 2);
    small.push([end.addTo(layer("range arcs")), data.cameras[0].place, end.getLatLng(), 50]);
  }
  for (const ring of data.regions) {
    L.polygon(ring, {color: "#111827", weight: 1.5, fillOpacity: 0.2, interactive: false}).addTo(layer("95 % regions"));
  }
  for (const line of data.bearings) {
    L.polyline(line, {color: "#8a5a00", weight: 1.5, dashArray: "3 4", interactive: false}).addTo(layer("bearings only"));
  }
  for (const arrow of data.arrows) {
    L.polyline(arrow.line, {color: "#c02a6b", weight: 1.6, interactive: false}).addTo(layer("true positions"));
    const tip = L.marker(arrow.line[1], {interactive: false, keyboard: false,
      icon: L.divIcon({className: "head", iconSize: [12, 12], html: head(arrow.azimuth)})});
    small.push([tip.addTo(layer("true positions")), arrow.line[0], arrow.line[1], 16]);
  }
  for (const spot of data.truth) {
    labels.avoid(L.circleMarker(spot, {radius: 5, color: "#fff", weight: 1, fillColor: "#c02a6b", fillOpacity: 1, interactive: false})).addTo(layer("true positions"));
  }
  for (const spot of data.points) {
    const shape = L.circleMarker(spot.place, {radius: 6, color: "#111827", weight: 2, fillColor: "#fff", fillOpacity: 1});
    const rows = document.createElement("table");
    for (const [name, value] of spot.rows) {
      const row = rows.insertRow();
      row.insertCell().append(text(name));
      row.insertCell().append(text(value));
    }
    shape.bindPopup(rows);
    // Targets keep their names, those of cameras and arcs give way.
    labels.add(shape, spot.name, 0);
    shape.addTo(layer("estimated positions"));
  }
  L.control.layers(null, overlays, {collapsed: map.getSize().x < 600}).addTo(map);
  map.on("zoomend moveend overlayadd", tidy);
  fitClear(map, data.bounds);
  map.whenReady(() => { tidy(); labels.place(); document.documentElement.dataset.drawn = data.points.length + "/" + document.querySelectorAll("#map path").length; });
})();
