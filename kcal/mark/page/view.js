// One image on a canvas: zoom, pan, tiles, the grid of pixels, and what is drawn over it. Pixel (u, v) has its center there.
import {TILE, Tiles} from "/page/tiles.js";
import {raw} from "/page/api.js";
import {drawOverlay} from "/page/overlay.js";

export class View {
  constructor(side, image, app) {
    this.side = side;
    this.app = app;
    this.canvas = document.getElementById(side);
    this.context = this.canvas.getContext("2d", {alpha: false});
    this.loupe = document.getElementById(side + "-loupe").getContext("2d", {alpha: false});
    [this.width, this.height] = image.size;
    this.top = image.top;
    this.tiles = new Tiles(side, image, () => this.draw());
    this.center = [this.width / 2, this.height / 2];
    this.scale = 0;
    this.whole = true;
    this.names = new Map();
    this.pointer = null;
    this.enlarged = null;
    this.frames = [];
    new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
    this.resize();
  }
  resize() {
    const box = this.canvas.parentElement.getBoundingClientRect();
    this.ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(box.width * this.ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * this.ratio));
    if (this.whole) this.fit();
    this.draw();
  }
  fit() {
    this.whole = true;
    this.scale = Math.min(this.canvas.width / this.width, this.canvas.height / this.height);
    this.center = [(this.width - 1) / 2, (this.height - 1) / 2];
    this.draw();
  }
  // Canvas pixels of an image position, and back.
  screen(u, v) { return [(u - this.center[0]) * this.scale + this.canvas.width / 2, (v - this.center[1]) * this.scale + this.canvas.height / 2]; }
  image(x, y) { return [(x - this.canvas.width / 2) / this.scale + this.center[0], (y - this.canvas.height / 2) / this.scale + this.center[1]]; }
  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [(event.clientX - box.left) * this.ratio, (event.clientY - box.top) * this.ratio];
  }
  zoom(factor, x = this.canvas.width / 2, y = this.canvas.height / 2) {
    this.whole = false;
    const [u, v] = this.image(x, y);
    const least = 0.5 * Math.min(this.canvas.width / this.width, this.canvas.height / this.height);
    this.scale = Math.max(least, Math.min(this.scale * factor, 120));
    this.center = [u - (x - this.canvas.width / 2) / this.scale, v - (y - this.canvas.height / 2) / this.scale];
    this.draw();
  }
  look(u, v, scale) {
    this.whole = false;
    this.center = [u, v];
    if (scale) this.scale = scale;
    this.draw();
  }
  draw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame((now) => { this.asked = false; this.paint(); this.count(now); });
  }
  count(now) {
    this.frames.push(now);
    if (this.frames.length > 120) this.frames.shift();
  }
  level() { return Math.max(0, Math.min(this.top, Math.floor(Math.log2(1 / this.scale)))); }
  paint() {
    const c = this.context, level = this.level();
    c.fillStyle = "#3a3f47";
    c.fillRect(0, 0, this.canvas.width, this.canvas.height);
    // The coarsest tile is there first and stays behind what is still loading.
    if (level < this.top) this.paintLevel(this.top);
    this.paintLevel(level);
    if (this.app.interpolated && this.scale >= 2) this.paintEnlarged();
    if (this.scale >= 8 * this.ratio && !(this.app.interpolated)) this.paintGrid();
    drawOverlay(this, c);
    this.paintLoupe();
  }
  paintLevel(level) {
    const c = this.context, size = TILE * 2 ** level;
    c.imageSmoothingEnabled = this.scale * 2 ** level < 1;
    const [left, top] = this.image(0, 0), [right, bottom] = this.image(this.canvas.width, this.canvas.height);
    const end = [Math.ceil(this.width / size), Math.ceil(this.height / size)];
    for (let y = Math.max(0, Math.floor((top + 0.5) / size)); y < end[1] && y * size - 0.5 < bottom; y++) {
      for (let x = Math.max(0, Math.floor((left + 0.5) / size)); x < end[0] && x * size - 0.5 < right; x++) {
        const tile = this.tiles.get(this.app.frame, level, x, y);
        if (!tile) continue;
        const [x0, y0] = this.screen(x * size - 0.5, y * size - 0.5);
        const step = 2 ** level * this.scale;
        c.drawImage(tile, x0, y0, tile.width * step, tile.height * step);
      }
    }
  }
  paintGrid() {
    const c = this.context;
    const [left, top] = this.image(0, 0), [right, bottom] = this.image(this.canvas.width, this.canvas.height);
    c.strokeStyle = "rgba(255, 255, 255, 0.28)";
    c.lineWidth = 1;
    c.beginPath();
    for (let u = Math.ceil(left - 0.5) + 0.5; u < right; u++) { const [x] = this.screen(u, 0); c.moveTo(Math.round(x) + 0.5, 0); c.lineTo(Math.round(x) + 0.5, this.canvas.height); }
    for (let v = Math.ceil(top - 0.5) + 0.5; v < bottom; v++) { const [, y] = this.screen(0, v); c.moveTo(0, Math.round(y) + 0.5); c.lineTo(this.canvas.width, Math.round(y) + 0.5); }
    c.stroke();
  }
  // The crop that the library enlarges ten times, around the middle of the view.
  paintEnlarged() {
    const [u, v] = this.center.map(Math.round), wanted = this.app.frame + "/" + u + "/" + v;
    if (!this.enlarged || this.enlarged.key !== wanted) this.fetchEnlarged(wanted, u, v);
    const found = this.enlarged;
    if (!found || !found.canvas || found.frame !== this.app.frame) return;
    const [x, y] = this.screen(found.left - 0.5, found.top - 0.5), step = this.scale / found.factor;
    this.context.imageSmoothingEnabled = false;
    this.context.drawImage(found.canvas, x, y, found.canvas.width * step, found.canvas.height * step);
  }
  async fetchEnlarged(key, u, v) {
    const frame = this.app.frame;
    this.enlarged = {...(this.enlarged || {}), key};
    let answer, levels;
    try {
      answer = await raw("enlarged", {side: this.side, frame, u: Math.max(u, 0), v: Math.max(v, 0)});
      levels = new Uint8Array(await answer.arrayBuffer());
    } catch (error) {
      // Asked for again when the view is drawn next.
      if (this.enlarged.key === key) this.enlarged.key = null;
      return;
    }
    const size = (name) => Number(answer.headers.get(name));
    const tile = {width: size("X-Width"), height: size("X-Height"), channels: size("X-Channels"), levels, canvas: null};
    this.tiles.paint(tile);
    if (this.enlarged.key === key) this.enlarged = {key, frame, canvas: tile.canvas, left: size("X-Left"), top: size("X-Top"), factor: size("X-Factor")};
    this.draw();
  }
  paintLoupe() {
    const c = this.loupe, across = 14, size = c.canvas.width, scale = size / across;
    const selected = this.app.markOf(this.side);
    c.canvas.hidden = !this.pointer && !selected;
    if (c.canvas.hidden) return;
    const [u, v] = this.pointer ? this.image(...this.pointer) : [selected.u, selected.v];
    // It does not stand on what it shows.
    const [x0, y0] = this.screen(u, v), room = c.canvas.clientWidth + 26;
    c.canvas.classList.toggle("aside", x0 > this.canvas.width - room * this.ratio && y0 > this.canvas.height - room * this.ratio);
    c.fillStyle = "#3a3f47";
    c.fillRect(0, 0, size, size);
    c.imageSmoothingEnabled = this.app.interpolated;
    for (let y = Math.floor((v - across) / TILE); y <= Math.floor((v + across) / TILE); y++) {
      for (let x = Math.floor((u - across) / TILE); x <= Math.floor((u + across) / TILE); x++) {
        if (x < 0 || y < 0 || x * TILE >= this.width || y * TILE >= this.height) continue;
        // From afar, tiles of full size are loaded only once the pointer rests on something.
        if (this.level() > 2 && !this.tiles.kept.has(this.app.frame + "/0/" + x + "/" + y)) continue;
        const tile = this.tiles.get(this.app.frame, 0, x, y);
        if (tile) c.drawImage(tile, (x * TILE - 0.5 - u) * scale + size / 2, (y * TILE - 0.5 - v) * scale + size / 2, tile.width * scale, tile.height * scale);
      }
    }
    c.strokeStyle = "#fff";
    c.lineWidth = 3;
    for (const color of ["#000", "#fff"]) {
      c.strokeStyle = color;
      c.lineWidth = color === "#000" ? 3 : 1;
      c.beginPath();
      c.moveTo(size / 2, 0); c.lineTo(size / 2, size / 2 - 14); c.moveTo(size / 2, size / 2 + 14); c.lineTo(size / 2, size);
      c.moveTo(0, size / 2); c.lineTo(size / 2 - 14, size / 2); c.moveTo(size / 2 + 14, size / 2); c.lineTo(size, size / 2);
      c.stroke();
    }
  }
}
