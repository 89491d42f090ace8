// Marks, the epipolar curve with its band, proposals: every kind has a shape of its own beside its color.
export const COLORS = {landmark: "#56b4e9", target: "#ffb000", feature: "#2fd6a8", wrong: "#ff6a2b", curve: "#ffffff", proposal: "#f0e442"};

function outlined(c, path, color, width = 2) {
  c.lineJoin = "round";
  for (const [stroke, line] of [["rgba(0, 0, 0, 0.75)", width + 2.5], [color, width]]) {
    c.strokeStyle = stroke;
    c.lineWidth = line;
    c.beginPath();
    path();
    c.stroke();
  }
}

function symbol(c, kind, x, y, r) {
  if (kind === "landmark") c.rect(x - r, y - r, 2 * r, 2 * r);
  else if (kind === "target") c.arc(x, y, r, 0, 2 * Math.PI);
  else if (kind === "feature") { c.moveTo(x, y - r); c.lineTo(x + r, y + r * 0.8); c.lineTo(x - r, y + r * 0.8); c.closePath(); }
  else { c.moveTo(x, y - r); c.lineTo(x + r, y); c.lineTo(x, y + r); c.lineTo(x - r, y); c.closePath(); }
}

const font = (ratio) => `600 ${12 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
function text(c, words, x, y, ratio) {
  c.font = font(ratio);
  c.lineWidth = 4;
  c.strokeStyle = "rgba(0, 0, 0, 0.8)";
  c.strokeText(words, x, y);
  c.fillStyle = "#fff";
  c.fillText(words, x, y);
}

// Two sigmas of a covariance, to scale.
function ellipse(c, view, mark) {
  const [uu, uv, vv] = mark.cov, mean = (uu + vv) / 2, root = Math.hypot((uu - vv) / 2, uv);
  const [x, y] = view.screen(mark.u, mark.v);
  c.ellipse(x, y, Math.max(2 * view.scale * Math.sqrt(mean + root), 0.5), Math.max(2 * view.scale * Math.sqrt(Math.max(mean - root, 0)), 0.5), 0.5 * Math.atan2(2 * uv, uu - vv), 0, 2 * Math.PI);
}

export function drawOverlay(view, c) {
  const app = view.app, ratio = view.ratio;
  const curve = app.curves[view.side];
  if (curve) {
    const shifted = (sign) => curve.pixels.map(([u, v], i) => {
      const [a, b] = [curve.pixels[Math.max(i - 1, 0)], curve.pixels[Math.min(i + 1, curve.pixels.length - 1)]];
      const length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1, d = sign * curve.band[i];
      return view.screen(u - d * (b[1] - a[1]) / length, v + d * (b[0] - a[0]) / length);
    });
    c.fillStyle = "rgba(255, 255, 255, 0.22)";
    c.beginPath();
    shifted(1).forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
    shifted(-1).reverse().forEach(([x, y]) => c.lineTo(x, y));
    c.fill();
    c.setLineDash([7 * ratio, 4 * ratio]);
    outlined(c, () => curve.pixels.forEach(([u, v], i) => { const [x, y] = view.screen(u, v); if (i) c.lineTo(x, y); else c.moveTo(x, y); }), COLORS.curve, 1.2);
    c.setLineDash([]);
    const [x, y] = view.screen(...curve.pixels[0]);
    text(c, "∞", x + 4 * ratio, y - 4 * ratio, ratio);
  }
  // Names stand beside their marks: on no mark, on no other name, and not below the loupe.
  const taken = takenRoom(view.canvas.width, view.canvas.height), named = [], loupe = view.loupe.canvas;
  if (!loupe.hidden) taken.take([loupe.offsetLeft, loupe.offsetTop, loupe.offsetLeft + loupe.offsetWidth, loupe.offsetTop + loupe.offsetHeight].map((v) => v * ratio));
  for (const item of app.items) {
    const mark = app.markOf(view.side, item);
    if (!mark || (item.kind === "target" && mark.frame !== app.frameName())) continue;
    const [x, y] = view.screen(mark.u, mark.v);
    if (x < -50 || y < -50 || x > view.canvas.width + 50 || y > view.canvas.height + 50) continue;
    const wrong = item.residual && !item.residual.used, chosen = item.name === app.selected;
    const color = wrong ? COLORS.wrong : COLORS[item.kind], r = (chosen ? 11 : 7) * ratio;
    outlined(c, () => symbol(c, item.kind, x, y, r), color, chosen ? 2.5 : 1.5);
    if (chosen) {
      outlined(c, () => { c.moveTo(x - 26 * ratio, y); c.lineTo(x - r, y); c.moveTo(x + r, y); c.lineTo(x + 26 * ratio, y); c.moveTo(x, y - 26 * ratio); c.lineTo(x, y - r); c.moveTo(x, y + r); c.lineTo(x, y + 26 * ratio); }, color, 1.2);
      if (view.scale > 4) outlined(c, () => ellipse(c, view, mark), "#fff", 1);
    }
    if (wrong) outlined(c, () => { c.moveTo(x - r, y - r); c.lineTo(x + r, y + r); c.moveTo(x + r, y - r); c.lineTo(x - r, y + r); }, color, 2);
    let words = item.name + (wrong ? " – wrong?" : "");
    if (chosen && item.position && item.position.text) words += "  " + item.position.text;
    taken.take([x - r, y - r, x + r, y + r]);
    if (chosen) { taken.take([x - 26 * ratio, y - 2, x + 26 * ratio, y + 2]); taken.take([x - 2, y - 26 * ratio, x + 2, y + 26 * ratio]); }
    named.push({key: item.name, words, x, y, r, rank: chosen ? 0 : wrong ? 1 : 2});
  }
  c.font = font(ratio);
  for (const {key, words, x, y, r, rank} of named.sort((a, b) => a.rank - b.rank)) {
    // What is selected has arms, and may be named farther away.
    const width = c.measureText(words).width, height = 14 * ratio, reaches = rank ? [r / ratio + 3] : [29, 48, 70];
    const offsets = reaches.flatMap((reach) => aroundDot(reach * ratio, width, height));
    const box = ([dx, dy]) => [x + dx - width / 2, y + dy - height / 2, x + dx + width / 2, y + dy + height / 2];
    // Where it was before, if there still is room.
    const found = [view.names.get(key) ?? 0, ...offsets.keys()].find((k) => k < offsets.length && taken.free(box(offsets[k])));
    // Others wait until there is room; what is selected or wrong is named all the same.
    if (found === undefined && rank === 2) continue;
    view.names.set(key, found ?? 0);
    taken.take(box(offsets[found ?? 0]));
    const [left, top] = box(offsets[found ?? 0]);
    text(c, words, left, top + 11 * ratio, ratio);
  }
  const found = app.proposals[view.side];
  if (found && !found.refusal) {
    const [x, y] = view.screen(found.u, found.v);
    c.setLineDash([4 * ratio, 3 * ratio]);
    outlined(c, () => symbol(c, "proposal", x, y, 13 * ratio), COLORS.proposal, 2.5);
    c.setLineDash([]);
    outlined(c, () => { c.moveTo(x - 4, y); c.lineTo(x + 4, y); c.moveTo(x, y - 4); c.lineTo(x, y + 4); }, COLORS.proposal, 1.2);
    text(c, `σ ${found.sigma.toFixed(2)} px · Enter accepts, R rejects`, x + 16 * ratio, y + 4 * ratio, ratio);
  }
  if (document.activeElement === view.canvas && app.byKeyboard) {
    const [x, y] = [view.canvas.width / 2, view.canvas.height / 2];
    outlined(c, () => { c.moveTo(x - 16, y); c.lineTo(x + 16, y); c.moveTo(x, y - 16); c.lineTo(x, y + 16); }, "#fff", 1);
  }
}
