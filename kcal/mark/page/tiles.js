// Tiles of one camera's images: levels from the server, gray or in color, made visible with the present contrast.
import {raw} from "/page/api.js";

export const TILE = 512;
const KEPT = 80;

export class Tiles {
  constructor(side, image, loaded) {
    this.side = side;
    this.image = image;
    this.loaded = loaded;
    this.kept = new Map();
    this.contrast = null;
    this.version = 0;
  }
  // null: as stored (deep images: their own span); [low, high]: stretched.
  stretch(span) {
    this.contrast = span;
    this.version += 1;
    if (this.image.deep) this.kept.clear();
  }
  get(frame, level, x, y) {
    const key = frame + "/" + level + "/" + x + "/" + y;
    let tile = this.kept.get(key);
    if (!tile) {
      tile = {levels: null, canvas: null, version: -1};
      this.kept.set(key, tile);
      this.fetch(tile, key, frame, level, x, y);
      if (this.kept.size > KEPT) this.kept.delete(this.kept.keys().next().value);
    } else {
      this.kept.delete(key);
      this.kept.set(key, tile);
    }
    if (!tile.levels) return null;
    if (tile.version !== this.version) this.paint(tile);
    return tile.canvas;
  }
  async fetch(tile, key, frame, level, x, y) {
    const query = {side: this.side, frame, level, x, y};
    if (this.image.deep && this.contrast) [query.low, query.high] = this.contrast;
    try {
      const answer = await raw("tile", query);
      tile.width = Number(answer.headers.get("X-Width"));
      tile.height = Number(answer.headers.get("X-Height"));
      tile.channels = Number(answer.headers.get("X-Channels"));
      tile.levels = new Uint8Array(await answer.arrayBuffer());
      this.loaded();
    } catch (error) {
      this.kept.delete(key);
    }
  }
  paint(tile) {
    const table = new Uint8ClampedArray(256);
    const [low, high] = this.contrast && !this.image.deep ? this.contrast : [0, 255];
    for (let i = 0; i < 256; i++) table[i] = (i - low) * 255 / Math.max(high - low, 1);
    const {levels, channels} = tile, green = channels === 3 ? 1 : 0, blue = channels === 3 ? 2 : 0;
    const colors = new Uint32Array(tile.width * tile.height);
    for (let i = 0, k = 0; i < colors.length; i++, k += channels) colors[i] = 0xff000000 | (table[levels[k + blue]] << 16) | (table[levels[k + green]] << 8) | table[levels[k]];
    tile.canvas = tile.canvas || new OffscreenCanvas(tile.width, tile.height);
    tile.canvas.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(colors.buffer), tile.width, tile.height), 0, 0);
    tile.version = this.version;
  }
  // Levels between which 98 % of the loaded pixels of a part of the image lie; of colors, those of the green.
  span(frame, level, left, top, right, bottom) {
    const counts = new Uint32Array(256);
    let total = 0;
    const size = TILE << level;
    for (let y = Math.max(0, Math.floor(top / size)); y * size < bottom; y++) {
      for (let x = Math.max(0, Math.floor(left / size)); x * size < right; x++) {
        const tile = this.kept.get(frame + "/" + level + "/" + x + "/" + y);
        if (!tile || !tile.levels) continue;
        const {levels, channels} = tile, green = channels === 3 ? 1 : 0;
        const u0 = Math.max(0, Math.floor((left - x * size) >> level)), u1 = Math.min(tile.width, Math.ceil((right - x * size) / (1 << level)));
        const v0 = Math.max(0, Math.floor((top - y * size) >> level)), v1 = Math.min(tile.height, Math.ceil((bottom - y * size) / (1 << level)));
        for (let v = v0; v < v1; v++) for (let u = u0; u < u1; u++) { counts[levels[(v * tile.width + u) * channels + green]] += 1; total += 1; }
      }
    }
    if (!total) return null;
    const at = (share) => { let sum = 0; for (let i = 0; i < 256; i++) { sum += counts[i]; if (sum > share * total) return i; } return 255; };
    const low = at(0.01), high = at(0.99);
    return high > low ? [low, high] : [low - 1, low + 1];
  }
}

// Stretch both images to the gray levels that they show now, or show them as they are again.
export function stretchContrast(app) {
  const button = document.getElementById("contrast"), pressed = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", pressed);
  for (const [side, view] of Object.entries(app.views)) {
    const level = view.level(), image = app.about.images[side];
    const [left, top] = view.image(0, 0), [right, bottom] = view.image(view.canvas.width, view.canvas.height);
    let span = pressed ? view.tiles.span(app.frame, level, left, top, right, bottom) : null;
    if (span && image.deep) { const step = (image.span[1] - image.span[0]) / 255; span = span.map((v) => image.span[0] + v * step); }
    view.tiles.stretch(span);
    view.enlarged = null;
    view.draw();
  }
}
